"""COMBREL: transfer through many mappings, chosen state by state by compliance (Fachantidis et al.)."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite, check_positive
from sb3_combrel.common.compiled import SameTypes
from sb3_combrel.common.transferred import Supply
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.compliance import ComplianceScratch, RewardCounts, standstill_compliance, transition_compliance
from sb3_combrel.transfer.mapping_transfer import (
    DEFAULT_BREADTH,
    DEFAULT_FADING,
    MappingsLike,
    SourceLike,
    VirtualSourceTransfer,
)
from sb3_combrel.transfer.nearest_transitions import Ballots, find_voters, note_neighbor, vote

RELEVANCE_RENEWAL = 1.2
# Within an episode votes are held whenever this many times as much has been seen as at the last time: every transition
# changes some choices, and to plan anew with each would cost more than all the rest.
RENEWAL_GROWTH = 1.2
NO_DRAWS = np.empty(0)


class COMBREL(VirtualSourceTransfer):
    """
    COmpliance-aware transfer for Model-Based REinforcement Learning: finds by itself how two tasks correspond.

    Paper: Fachantidis, Partalas, Taylor & Vlahavas, "Transfer learning with probabilistic mapping selection" (Algorithm
    1). Each mapping makes a virtual source task. For a state and an action, the nearest recorded target transitions with
    that action vote: the mapping with the highest mean compliance translates the source instances that are missing.
    Because compliance depends only on the state mapping and on the one source action that the target action maps to,
    any number of action mappings costs nothing.

    :param source: source instances, a path to them, or a list of several, which then compete
    :param mappings: "injective" (each source variable stands for one target variable, the other target variables are
        left alone), "surjective", "all", "balanced", these with "signed_" before them (variables may be mirrored as well),
        "paper_mountain_car", "paper_icub", a list of mappings or a ``MappingSet``. The paper uses sets without unmapped
        variables, which help much less.
    :param n_neighbors: how many of the nearest target transitions vote; k of Algorithm 1 (the paper: 3)
    :param choice: "best": the mapping with the highest mean compliance is chosen, as in the paper; or "drawn": one is
        drawn, each with a probability in proportion to its mean compliance. Where many mappings comply about equally
        well none of them then settles everything wrongly: what one hides another shows.
    :param voting_radius: how far, in unit coordinates, a target transition may be and still vote. Where none is near enough
        nothing is transferred: what nobody has seen stays worth exploring, and what has been seen need not be tried with
        every action. None: the nearest vote however far they are, as in the paper.
    :param measured: which transitions vote: "online": those of all episodes, from the first step on (the default, which
        works best); or "first_episode": those of the first episode, after its end, as in the paper
    :param max_transitions: target transitions that vote, at most
    :param min_compliance: a mapping transfers nothing where its mean compliance does not exceed this many times that of
        the guess that nothing ever changes; so a source that has nothing to do with the target is left alone. 0: any
        mapping that has evidence may transfer, as in the paper.
    :param breadth: kernel breadth of transferred instances, in unit coordinates; the paper names none
    :param fading: factor on ``breadth`` for each episode that runs into its time limit (the paper: none, 1). Whatever
        the source, pairs that it settled wrongly are explored in the end.
    :param believe_terminal: whether a source instance that ended its episode ends the target's too. The paper does not
        say. What is wrong with it the target's own transitions soon tell; without it nothing leads to an end at first.
    :param relevance: order the instances by relevance (Eq. 7), not by distance. The paper finds it harmful.
    :param relevance_fraction: mu of Eq. 4: the part of the weight over which distances are averaged
    :param bandwidths: (start, outcome, reward) bandwidths of compliance, delta_sa, delta_s' and delta_r of Eq. 2; None:
        from the data. The paper names none.
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    def __init__(
        self,
        source: SourceLike,
        mappings: MappingsLike = "injective",
        *,
        n_neighbors: int = 3,
        choice: str = "best",
        voting_radius: float | None = None,
        measured: str = "online",
        max_transitions: int = 3000,
        min_compliance: float = 0.8,
        breadth: float = DEFAULT_BREADTH,
        fading: float = DEFAULT_FADING,
        believe_terminal: bool = True,
        relevance: bool = False,
        relevance_fraction: float = 0.5,
        bandwidths: tuple[float, float, float] | None = None,
    ):
        check_count("n_neighbors", n_neighbors)
        check_count("max_transitions", max_transitions)
        check_finite("min_compliance", min_compliance)
        if voting_radius is not None:
            check_positive("voting_radius", voting_radius)
        if min_compliance < 0.0:
            raise ValueError(f"min_compliance must be at least 0, got {min_compliance!r}")
        if choice not in ("best", "drawn"):
            raise ValueError(f'choice must be "best" or "drawn", got {choice!r}')
        if measured not in ("online", "first_episode"):
            raise ValueError(f'measured must be "online" or "first_episode", got {measured!r}')
        super().__init__(
            source,
            mappings,
            breadth=breadth,
            fading=fading,
            believe_terminal=believe_terminal,
            relevance=relevance,
            relevance_fraction=relevance_fraction,
            bandwidths=bandwidths,
        )
        self.n_neighbors = n_neighbors
        self.choice = choice
        self.voting_radius = voting_radius
        self.measured = measured
        self.max_transitions = max_transitions
        self.min_compliance = min_compliance

    def bind(self, target: TargetTask, rng: np.random.Generator) -> None:
        super().bind(target, rng)
        n_rows, n_actions = len(self._table.index), len(self._instances.count)
        n_points = len(target.sample_states)
        self._compliance_scratch = ComplianceScratch.for_mappings(self._table, self._instances)
        self._table_of_one = np.empty((n_rows, n_actions))
        # Where in that table the candidates of each action stand.
        places = self._ways.row * n_actions + self._ways.action
        self._places = np.split(places, self._ways.first[1:-1])
        self._rewards = RewardCounts.of_instances(self._instances)
        self._ballots = Ballots.empty(int(np.diff(self._ways.first).max()))
        self._near = np.full((target.n_actions, n_points, self.n_neighbors), -1, dtype=np.int64)
        # An empty place counts as a neighbour at the limit: whoever is farther away does not enter.
        self._limit = np.inf if self.voting_radius is None else float(self.voting_radius) ** 2
        self._distance = np.full((target.n_actions, n_points, self.n_neighbors), self._limit)
        self._choice = np.full(target.n_actions * n_points, -1, dtype=np.int64)
        self._vote_due = np.zeros(target.n_actions * n_points, dtype=np.bool_)
        self._renewal_due = 0.0
        self._transition_compliance, self._note_neighbor, self._vote, self._find_voters = map(
            SameTypes, (transition_compliance, note_neighbor, vote, find_voters)
        )
        self._first_episode = True
        self._switches = 0
        self._choice_at = np.empty(target.n_actions, dtype=np.int64)
        self._near_at = np.empty((target.n_actions, self.n_neighbors), dtype=np.int64)
        self._distance_at = np.empty((target.n_actions, self.n_neighbors))
        # Nothing is asked before the first transition. To draw here would take from the chance of a model that is loaded.
        self._draws_at = np.zeros(target.n_actions) if self.choice == "drawn" else NO_DRAWS

    # ---------------------------------------------------------------- observing

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        # Anew with each transition, not with each question: a prediction asked for twice is the same, and leaves no trace.
        self._draws_at = self._draws(len(self._choice_at))
        if self._seen.n >= self.max_transitions or not (self._first_episode or self.measured == "online"):
            return
        i = self._seen.add(state, action, reward, next_state - state)
        if self.measured == "online":
            self._enfranchise(i)
            if self.relevance and self._seen.n >= max(50, RELEVANCE_RENEWAL * self._merit_of):
                self._renew_relevance()

    def end_episode(self, truncated: bool) -> None:
        super().end_episode(truncated)
        # An episode's end is time to renew what has changed.
        self._renewal_due = 0.0
        if self._first_episode and self.measured == "first_episode":
            for i in range(self._seen.n):
                self._enfranchise(i)
            if self.relevance:
                self._renew_relevance()
        self._first_episode = False

    def _enfranchise(self, i: int) -> None:
        """Let transition ``i`` vote: a vote is due at the sample states that have it among their nearest (line 18)."""
        assert self.target is not None
        self._ballots = self._ballots.with_room(i)
        action, n_points = int(self._seen.actions[i]), len(self.target.sample_states)
        self._note_neighbor(
            i,
            self._seen.states[i],
            self.target.sample_states,
            self._near[action],
            self._distance[action],
            self._vote_due[action * n_points : (action + 1) * n_points],
        )

    def renewed(self, known: np.ndarray) -> np.ndarray:
        faded = super().renewed(known)
        if len(faded) or self._seen.n < self._renewal_due:
            return faded
        self._renewal_due = RENEWAL_GROWTH * self._seen.n
        return self._hold_votes(np.flatnonzero(self._vote_due & ~known))

    def _hold_votes(self, pairs: np.ndarray) -> np.ndarray:
        """Renew the choices of ``pairs`` (lines 17-20); those that changed."""
        near = self._near.reshape(-1, self.n_neighbors)
        self._measure(near[pairs])
        changed = pairs.copy()
        n_changed = self._vote(changed, near, self._ballots, self._ways.first, self._draws(len(pairs)), self._choice)
        self._vote_due[pairs] = False
        self._switches += n_changed
        return changed[:n_changed]

    def _measure(self, voters: np.ndarray) -> None:
        """Compliance with every mapping of those of these transitions that have not voted yet (lines 9-13)."""
        voters = voters[voters >= 0]
        for i in set(voters[~self._ballots.measured[voters]].tolist()):
            action, reward = int(self._seen.actions[i]), float(self._seen.rewards[i])
            self._transition_compliance(
                self._seen.states[i],
                self._seen.effects[i],
                reward,
                self._instances,
                self._table,
                self._bandwidths,
                self._compliance_scratch,
                self._table_of_one,
            )
            compliance = self._table_of_one.ravel()[self._places[action]]
            self._ballots.compliance[i, : len(compliance)] = compliance
            standstill = standstill_compliance(self._seen.effects[i], reward, self._rewards, self._bandwidths)
            self._ballots.least[i] = self.min_compliance * standstill
            self._ballots.measured[i] = True

    def _draws(self, n: int) -> np.ndarray:
        """Random numbers for so many elections, if the choice is drawn."""
        return self._rng.random(n) if self.choice == "drawn" else NO_DRAWS

    def saved_arrays(self) -> dict[str, np.ndarray]:
        own = {
            "first_episode": np.array([float(self._first_episode)]),
            "renewal_due": np.array([float(self._renewal_due)]),
            "switches": np.array([float(self._switches)]),
            "choice": self._choice.astype(np.float64),
            "vote_due": self._vote_due.astype(np.float64),
        }
        return {**super().saved_arrays(), **own, "draws_at": self._draws_at}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        assert self.target is not None
        self._first_episode = bool(saved["first_episode"][0] > 0.5)
        super().restore(saved)
        first, last = self._ways.first[:-1, None], self._ways.first[1:, None] - 1
        chosen = saved["choice"].astype(np.int64).reshape(self.target.n_actions, -1)
        self._choice[:] = np.where(chosen < 0, -1, np.clip(chosen, first, last)).ravel()
        self._vote_due[:] = saved["vote_due"] > 0.5
        self._draws_at = np.clip(saved["draws_at"], 0.0, 1.0)
        self._renewal_due = float(saved["renewal_due"][0])
        self._switches = int(saved["switches"][0])
        if self.relevance and self._seen.n:
            self._renew_relevance()

    def _note(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray) -> None:
        super()._note(state, action, reward, effect)
        if self._may_vote:
            self._enfranchise(self._seen.n - 1)

    @property
    def _may_vote(self) -> bool:
        """Whether the transitions seen so far vote."""
        return self.measured == "online" or not self._first_episode

    # ---------------------------------------------------------------- supplying

    def supply(self, pairs: np.ndarray, own_weight: np.ndarray, known: np.ndarray) -> Supply:
        assert self.target is not None
        chosen = np.where(known, -1, self._choice[pairs])
        if (chosen < 0).all():
            return self._nothing_for(len(pairs))
        first = np.maximum(chosen, 0)
        states = self.target.sample_states[pairs % len(self.target.sample_states)]
        self._supply = self._draw(states, own_weight, first, np.where(chosen < 0, first, first + 1), self._supply)
        return self._supply

    def supply_at(self, state: np.ndarray, own_weight: np.ndarray) -> Supply:
        missing = own_weight < self._rules.threshold
        if self._seen.n == 0:
            return self._nothing_for(len(own_weight))
        n_voting = self._seen.n if self._may_vote else 0
        transitions = self._seen.states, self._seen.actions, n_voting
        self._find_voters(state, missing, *transitions, self._limit, self._near_at, self._distance_at)
        self._measure(self._near_at)
        actions = np.arange(len(own_weight))
        self._vote(actions, self._near_at, self._ballots, self._ways.first, self._draws_at, self._choice_at)
        first = np.maximum(self._choice_at, 0)
        return self._draw_at(state, own_weight, first, first + (self._choice_at >= 0))

    @property
    def makes_choices(self) -> bool:
        return True

    def choices(self) -> np.ndarray:
        return self._choice.copy()

    def chosen_compliance(self, pairs: np.ndarray) -> np.ndarray:
        """
        Mean compliance of the chosen mapping with the nearest transitions (line 19 of Algorithm 1).

        :param pairs: pairs of the sample, int64, shape (n,)
        :return: float64, shape (n,); NaN where nothing is chosen
        """
        near = self._near.reshape(-1, self.n_neighbors)[pairs]
        self._measure(near)
        voting = (near >= 0) & (self._choice[pairs] >= 0)[:, None]
        chosen = np.maximum(self._choice[pairs], 0)[:, None]
        first = self._ways.first[pairs // self._near.shape[1]][:, None]
        compliance = self._ballots.compliance[np.maximum(near, 0), np.maximum(chosen - first, 0)]
        n_voting = voting.sum(axis=1)
        total = np.where(voting, compliance, 0.0).sum(axis=1)
        return np.where(n_voting > 0, total / np.maximum(n_voting, 1), np.nan)

    def statistics(self) -> dict[str, float]:
        chosen = self._choice[self._choice >= 0]
        shares = np.bincount(chosen) / max(len(chosen), 1)
        shares = shares[shares > 0.0]
        return {
            **super().statistics(),
            "transfer/switches": self._switches,
            "transfer/choice_entropy": float(-(shares * np.log(shares)).sum()),
            "transfer/distinct_mappings": len(shares),
            "transfer/target_transitions": self._seen.n,
        }
