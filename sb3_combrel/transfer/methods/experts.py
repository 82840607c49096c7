"""Mappings as experts: a bandit over the source's policy, seen through mappings, and the agent (Talvitie & Singh 2007)."""

from __future__ import annotations

from dataclasses import KW_ONLY, astuple, dataclass, field
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_count, check_finite, check_positive
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.sources.recipes import checked_source
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import MappingsLike, SourceLike, load_sources, loaded, resolved_sets
from sb3_combrel.transfer.prior.prior_sets import is_factored
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH
from sb3_combrel.transfer.source_policy import SourcePolicy

MAX_MAPPINGS = 2**53  # numbers of mappings are saved as float64
AGENT = 0  #: the number of the learning agent among those who may act; the experts come after it


class Expert(NamedTuple):
    """A mapping that gives a policy for the target; ``source``: number of the source task that it is to."""

    source: int
    mapping: InterTaskMapping


@dataclass
class Episode:
    """An episode: who acts (agent or expert), sum of rewards, steps, and how many of them an expert decided."""

    arm: int
    total: float = 0.0
    steps: int = 0
    acted: int = 0
    asked: bool = False  # for an action, whose transition has not come yet: others are past data
    own: bool = False  # whether the last transition was the answer to that


@dataclass(repr=False, eq=False)
class MappingExperts(Transfer):
    """Every mapping gives a policy, and what acts in an episode, one of these or the agent, is chosen by the returns so far.

    Paper: Talvitie & Singh, "An experts algorithm for transfer learning" (IJCAI 2007). An expert is a mapping: a target state
    is seen as one of the source, whose greedy action decides among the target actions that map to it, at random if there are
    several. If none does, the best source action to which one maps; where the source has no data, the agent decides. The value
    function is planned from the source's instances (:class:`~sb3_combrel.transfer.source_policy.SourcePolicy`). The agent
    learns from every transition; nothing else is transferred.

    Who acts is chosen by UCB1 (Auer, Cesa-Bianchi & Fischer 2002) at the start of each episode, once the agent and each expert
    have acted in one: whoever has the highest mean return + (largest - least return so far) * ``exploration`` * sqrt(2
    ln(episodes) / own episodes).

    What differs from the paper: its ATEASE, for tasks without episodes, follows each expert for about its mixing time and
    drops those that break their promise; here that is UCB1 and ``patience``. The learning agent takes part: its mean is that
    of the later half of its episodes. The paper's experts are given; here they are drawn from a set of mappings.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=MappingExperts(source, max_experts=5))
        model.learn(total_timesteps=5_000)

    :param source: source instances, a path to them, or a list of several, see
        :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`
    :param mappings: the set that the experts are drawn from, see there
    :param max_experts: experts at most; of a larger set so many are drawn without replacement, all mappings being equally
        likely
    :param exploration: factor on the bonus for what has been tried seldom. 1 is UCB1's, which outweighs all differences of
        returns for hundreds of episodes; 0: always the best so far
    :param patience: an expert acts in an episode for at most this many times the steps of the agent's last own episode, then
        the agent takes over. The return of all of it counts for the expert. None: no limit
    :param gamma: discount factor of the source's value function, below 1
    :param source_breadth: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if source or mappings do not fit the target
    """

    use = "actions"

    source: SourceLike
    mappings: MappingsLike = "injective"
    _: KW_ONLY
    max_experts: int = 10
    exploration: float = 0.2
    patience: float | None = 1.0
    gamma: float = 0.99
    source_breadth: float = DEFAULT_SOURCE_BREADTH
    # They depend on the source alone, and are planned once.
    _policies: list[SourcePolicy] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.source = checked_source(self.source)
        check_count("max_experts", self.max_experts)
        check_finite("exploration", self.exploration, min=0.0)
        if self.patience is not None:
            check_positive("patience", self.patience)
        check_positive("gamma", self.gamma, max=1.0)
        if self.gamma == 1.0:
            raise ValueError(f"gamma must be below 1, got {self.gamma!r}")
        check_positive("source_breadth", self.source_breadth)
        if is_factored(self.mappings):
            raise ValueError(f"mappings must be a set of mappings, one an expert, no factored ones, got {self.mappings!r}")

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        again = self.task is not None and self.rng is rng
        super().bind(task, rng)
        if again:
            # The same agent in other unit coordinates: neither experts nor returns depend on them.
            return
        self.source, self.mappings = loaded(self.source, self.mappings, task)
        self.sources = load_sources(self.source)
        self._sets = resolved_sets(self.sources, self.mappings, task)
        self.n_mappings = sum(mappings.n_mappings for mappings in self._sets)
        if self.n_mappings > MAX_MAPPINGS:
            raise ValueError(f"mappings must hold at most {MAX_MAPPINGS:,} mappings to draw from; list those of interest")
        if not self._policies:
            self._policies = [SourcePolicy(each, float(self.gamma), float(self.source_breadth)) for each in self.sources]
        # Source coordinates that a mapping does not determine are typical ones.
        self._typical = [np.median(source.scaling.to_unit(source.states), axis=0) for source in self.sources]
        self._numbers = np.empty(0, dtype=np.int64)
        self.experts: list[Expert] = []
        self._ended: list[Episode] = []
        self._playing: dict[int, Episode] = {}  # by number of the environment

    def action(self, state: np.ndarray) -> int | None:
        playing = self._playing.get(self.environment)
        if playing is None:
            playing = self._playing[self.environment] = Episode(self._choose())
        playing.asked = True
        if playing.arm == AGENT or playing.acted >= self._most_steps():
            return None
        action = self.expert_action(playing.arm, state)
        playing.acted += action is not None
        return action

    def expert_action(self, number: int, state: np.ndarray) -> int | None:
        """Return what expert ``number``, from 1 on, does at a state, unit coordinates; None where its source has no data."""
        source, mapping = self.experts[number - 1]
        seen = mapping.target_to_source(state, self.sources[source].n_variables)
        q = self._policies[source].q_values(np.where(np.isnan(seen), self._typical[source], seen))
        q[~np.isin(np.arange(len(q)), mapping.action)] = -np.inf
        best = int(q.argmax())
        if q[best] == -np.inf:
            return None
        actions = mapping.target_actions(best)
        return int(actions[0] if len(actions) == 1 else self.rng.choice(actions))

    def _most_steps(self) -> float:
        if self.patience is None:
            return np.inf
        return self.patience * next((each.steps for each in reversed(self._ended) if each.arm == AGENT), np.inf)

    def _choose(self) -> int:
        if len(self._numbers) == 0:
            every = self.n_mappings <= self.max_experts
            drawn = np.arange(self.n_mappings) if every else self.rng.choice(self.n_mappings, self.max_experts, replace=False)
            self._set_experts(drawn)
        acting = {playing.arm for playing in self._playing.values()}
        returns = self._returns()
        if not returns[AGENT]:
            return AGENT  # several environments: nobody else acts before it is known how long the agent takes
        untried = [k for k, of_arm in enumerate(returns) if not of_arm and k not in acting]
        return untried[0] if untried else best_by_ucb1(returns, float(self.exploration))

    def _set_experts(self, numbers: np.ndarray) -> None:
        self._numbers = numbers
        last = np.cumsum([mappings.n_mappings for mappings in self._sets])
        self.experts = []
        for number in numbers.tolist():
            source = int(np.searchsorted(last, number, side="right"))
            self.experts.append(Expert(source, self._sets[source][number - int(last[source])]))

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        playing = self._playing.get(self.environment)
        if playing is None:
            return
        playing.own, playing.asked = playing.asked, False
        if playing.own:
            playing.total += reward
            playing.steps += 1

    def end_episode(self, truncated: bool) -> None:
        if self.environment in self._playing and self._playing[self.environment].own:
            self._ended.append(self._playing.pop(self.environment))

    def break_off(self) -> None:
        self._playing.clear()

    def mean_returns(self) -> np.ndarray:
        """Return the mean return of the agent, of the later half of its episodes, and of each expert; NaN before the first."""
        return np.array([mean_return(k, of_arm) if of_arm else np.nan for k, of_arm in enumerate(self._returns())])

    def _returns(self) -> list[list[float]]:
        return [[each.total for each in self._ended if each.arm == k] for k in range(1 + len(self.experts))]

    def _best(self) -> int:
        means = self.mean_returns()
        return AGENT if np.isnan(means).all() else int(np.nanargmax(means))

    def _all_episodes(self) -> list[Episode]:
        """The episodes that have ended, and those that go on."""
        return [*self._ended, *self._playing.values()]

    def mapping_steps(self) -> int:
        """Return how many steps of the target experts have taken that are not the best of all who may act."""
        best = self._best()
        return sum(each.acted for each in self._all_episodes() if each.arm != best)

    def statistics(self) -> dict[str, float]:
        means, best = self.mean_returns(), self._best()
        return {
            "transfer/experts": len(self.experts),
            "transfer/best_expert": best,
            "transfer/expert_steps": sum(each.acted for each in self._all_episodes()),
            "transfer/steps_to_find_mapping": self.mapping_steps(),
            "transfer/expert_episodes": sum(each.arm != AGENT for each in self._ended),
            "transfer/agent_return": float(means[AGENT]),
            "transfer/best_return": float(means[best]),
        }

    def get_state(self) -> dict[str, np.ndarray]:
        episodes = [(each.arm, each.total, each.steps, each.acted) for each in self._ended]
        playing = [(number, *astuple(one)) for number, one in self._playing.items()]
        return {
            "experts": self._numbers[:, None].astype(np.float64),
            "episodes": np.array(episodes, dtype=np.float64).reshape(-1, 4),
            "playing": np.array(playing, dtype=np.float64).reshape(-1, 7),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._set_experts(state["experts"][:, 0].astype(np.int64))
        self._ended, self._playing = [], {}
        for arm, total, steps, acted in state["episodes"].tolist():
            self._ended.append(Episode(int(arm), total, int(steps), int(acted)))
        for environment, arm, total, steps, acted, asked, own in state["playing"].tolist():
            self._playing[int(environment)] = Episode(int(arm), total, int(steps), int(acted), bool(asked), bool(own))


def mean_return(arm: int, returns: list[float]) -> float:
    """The mean of all returns of an expert, of the later half of those of the agent, which gets better."""
    return float(np.mean(returns[len(returns) // 2 :] if arm == AGENT else returns))


def best_by_ucb1(returns: list[list[float]], exploration: float) -> int:
    """Choose by UCB1, on returns in parts of their range; who has none is left out; of equals, the first."""
    everything = [total for of_arm in returns for total in of_arm]
    bonus = (max(everything) - min(everything)) * exploration

    def score(k: int, of_arm: list[float]) -> float:
        return mean_return(k, of_arm) + bonus * np.sqrt(2.0 * np.log(len(everything)) / len(of_arm)) if of_arm else -np.inf

    return int(np.argmax([score(k, of_arm) for k, of_arm in enumerate(returns)]))
