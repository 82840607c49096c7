"""The local linear model: effects by weighted linear regression on the instances near a state."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_combrel.common.compiled import EntryPoint
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.linear_regression import n_products
from sb3_combrel.common.periodic import differences
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.models.base import NO_PAIRS, InstanceTransfer, ModelSettings
from sb3_combrel.models.compiled_model import MIN_CHANGE, CompiledModel
from sb3_combrel.models.fit_arrays import FitScratch, Kernel, LinearFits
from sb3_combrel.models.fit_updates import LEAST_SCALE, enter, leave, recount_pairs, recount_totals, refit_changed
from sb3_combrel.models.linear_prediction import NearestLists, interpolate_prior, join_transferred, predict_own
from sb3_combrel.models.linear_rows import update_rows
from sb3_combrel.planning.mdp import FiniteMDP

# Grid points count as known with this fraction of the weight that exact states need: where nothing leads they would stay
# optimistic, and make the states beside them look good, for ever. Only once an episode has ended or rewards have differed:
# until then to know how states change is not to know what is there.
ON_GRID = 0.5
# Until then, whenever this fraction of all pairs is known (the first time, and later ones), which is looked at every so many
# transitions, known is decided by a kernel of half the squared breadth: a broad one would never find a small goal. To demand
# more weight instead would send the agent to where it has been first.
EXPLORED, EXPLORED_AGAIN, CHECKED_EVERY = 0.9, 0.99, 50
# Whatever a file says.
MAX_NARROWING = 2.0**20

_enter, _leave, _recount = EntryPoint(enter), EntryPoint(leave), EntryPoint(recount_pairs)
_update_rows, _predict_own = EntryPoint(update_rows), EntryPoint(predict_own)
_refit_changed, _recount_totals = EntryPoint(refit_changed), EntryPoint(recount_totals)
_join_transferred, _interpolate_prior = EntryPoint(join_transferred), EntryPoint(interpolate_prior)


class LocalLinear(CompiledModel):
    """Local linear regression, one model for each action, incremental (Atkeson, Moore & Schaal 1997).

    An instance at distance d (unit coordinates) weighs exp(-d^2 / breadth^2); these weights decide what is known, as in
    the kernel average. The effect at a state is fitted, as a linear function of the state, to its ``n_neighbors`` nearest
    instances with a kernel that is narrower where they lie closer: as broad as makes the last of them weigh 0.05. The bias
    of a kernel average is of the order of the breadth, that of a linear fit of the order of its square, so a broad kernel,
    which needs few instances, predicts well. Predicted effects stay within the range of the effects seen. Rewards and ends,
    which jump from one state to the next, are kernel averages with a narrower kernel. One successor a pair: the mean.

    A row of the finite MDP leads from a grid point to where its action, held until the cell is left, for ``max_model_steps``
    at most, leads by the pair's fit: values interpolated once a cell are nearer to the truth than those interpolated once a
    step (Munos & Moore 2002). Where an instance near the point has ended an episode it is one step.

    On the grid, the sums of each pair's regression are kept, and it is solved again where new instances contradict it. A
    pair's kernel narrows when it has half as many again as ``n_neighbors``, and is broader again when less than half of them
    are left: with ``max_instances``, the nearest instance of the same action is replaced.

    With a prior (a transfer method with ``use="prior"``), fits are made to what the prior's effects leave over, and pairs
    that it claims to know are modelled before their own instances suffice. The prior's effects are those at the grid points,
    interpolated between them; its rewards and ends count until the own instances suffice.

    Parameters: see :class:`~sb3_combrel.models.base.Model`.
    """

    takes_prior = True
    accepts_visited = True

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        super().__init__(mdp, settings, transfer)
        self._prior = transfer if transfer is not None and transfer.use == "prior" else None
        grid = self.grid
        d, n_points, n_pairs, n_near = grid.n_variables, grid.n_points, len(self.known), settings.n_neighbors
        breadth = float(settings.model_breadth)
        self._kernel = Kernel(
            scale=-1.0 / breadth**2,
            reach=-np.log(settings.min_weight) * breadth**2,
            outcome_scale=-1.0 / min(breadth, float(settings.outcome_breadth)) ** 2,
            n_neighbors=n_near,
            counting_scale=-1.0 / breadth**2,
        )
        self._plain_kernel = tuple(self._kernel)
        self._set_fits(
            LinearFits(
                sums=np.zeros((n_pairs, n_products(d))),
                outcome=np.zeros((n_pairs, 3 + 2 * d)),
                fit=np.zeros((n_pairs, d + d * d)),
                row=np.zeros((n_pairs, d + 2)),
                unexplained=np.full(n_pairs, np.inf),
                reach=np.full(n_pairs, self._kernel.reach),
                scale=np.full(n_pairs, self._kernel.scale),
                n_counted=np.zeros(n_pairs, dtype=np.int32),
                n_ended=np.zeros(n_pairs, dtype=np.int32),
                limit=np.full(n_pairs, n_near + n_near // 2, dtype=np.int32),
                total=self.own_weight,
                last_total=self.last_weight,
                refitted=np.zeros(n_pairs, dtype=np.bool_),
                clipped=np.zeros(n_pairs, dtype=np.bool_),
                known=self.known,
                claimed=np.zeros(n_pairs, dtype=np.bool_),
                target=np.empty((self.n_actions, self.instances.capacity, d)),
                prior=np.zeros((n_pairs, d + 2)),
                effect_range=np.zeros((3, self.n_actions, d)),
                effect_scale=np.ones((self.n_actions, d)),
            )
        )
        self._scratch = FitScratch(
            at=np.empty(d),
            state=np.empty(d),
            counted=np.empty(d),
            away=np.empty(d),
            step=np.empty(d),
            products=np.empty((2, n_products(d))),
            factor=np.empty((d, d)),
            item=np.empty(n_near, dtype=np.int32),
            nearest=np.empty(n_near),
            along=np.empty((d, int(grid.arrays.shape.max()))),
            span=np.empty((3, d), dtype=np.int64),
            point=np.empty(n_points, dtype=np.int64),
            distance=np.empty(n_points),
            full_reach=np.full(n_points, self._kernel.reach),
        )
        self._plain_scratch = tuple(self._scratch)
        self._corners = np.empty(d), np.empty(2**d, dtype=np.int64), np.empty(2**d)
        # The range of effects when rows were last brought in line with it.
        self._range_before = self.fits.effect_range[:2].copy()
        self._planned = self.mdp.gamma, settings.max_model_steps, self._prior is not None
        self._renew_targets()
        self._near = NearestLists.empty(self.n_actions, n_near, d)
        self._plain_near = tuple(self._near)
        self._prior_version = -1
        # Whether an outcome has told states apart.
        self._informed, self._first_reward = False, np.nan
        self._narrowing = 1.0
        # Transitions so far; with ``max_instances`` there are fewer instances.
        self._n_added = 0
        self._no_prior = np.zeros((self.n_actions, d + 2)), np.zeros(self.n_actions, dtype=np.bool_)
        self._all_actions = np.arange(self.n_actions)
        self._own_room = 1
        self._make_prediction(1)

    def _set_fits(self, fits: LinearFits) -> None:
        self.fits, self._plain_fits = fits, tuple(fits)

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> np.ndarray:
        """As :meth:`Model.add`; with a transfer method, pairs of low weight that changed little may wait (``outdated``)."""
        informed = self._inform(reward, terminated)
        slot, left = self._slot_for(state, action)
        min_change = 0.0 if self._giver is None else MIN_CHANGE * self.exploration_threshold
        n_changed = _enter.call(
            self._plain_instances,
            self._plain_fits,
            self.grid.plain,
            self._plain_kernel,
            (self._threshold_on_grid(), min_change),
            (action, slot, state, next_state, reward, terminated),
            self._prior_effects(state[None], np.array([action]))[0],
            self._plain_scratch,
        )
        changed = self._scratch.point[:n_changed] + action * self.grid.n_points
        self._n_added += 1
        forgotten = self._narrow_known()
        if len(left) + len(informed) + len(forgotten) == 0:
            return changed
        return np.unique(np.concatenate([left, informed, forgotten, changed]))

    def _slot_for(self, state: np.ndarray, action: int) -> tuple[int, np.ndarray]:
        """Where a new instance goes, and the pairs whose rows are to be updated because another has made room."""
        instances = self._instances
        size = int(instances.size[action])
        if self.settings.max_instances is not None and size >= self.settings.max_instances:
            apart = differences(instances.state[action, :size], state, instances.periodic)
            slot = int((apart**2).sum(axis=1).argmin())
            self._forget_range_of(action, slot)
            n = _leave.call(instances, self.fits, self.grid.arrays, self._kernel, action, slot, self._scratch)
            return slot, self._scratch.point[:n] + action * self.grid.n_points
        if size == instances.capacity:
            self.instances = instances.with_room(action)
            target = np.empty((self.n_actions, self.instances.capacity, self.grid.n_variables))
            target[:, : instances.capacity] = self.fits.target
            self._set_fits(self.fits._replace(target=target))
        return size, NO_PAIRS

    def _prior_at(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the prior predicts of all actions at a state, as in ``LinearFits``, and whether it claims to know."""
        if self._prior is None:
            return self._no_prior
        states = np.repeat(state[None], self.n_actions, axis=0)
        given = self._prior.prior(states, self._all_actions)
        effects = self._prior_effects(states, self._all_actions)
        return np.column_stack([effects, given.reward, given.end]), self._claims(given)

    def _claims(self, given: PriorPredictions) -> np.ndarray:
        return given.weight >= self.settings.exploration_threshold

    def _prior_effects(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The prior's effects, multilinear between the grid points: shape (n, n_variables); without a prior, rows of zeros.

        Finer ones would be confirmed by instances at a wall, but not at the grid points beside, which lead through the wall.
        """
        if self._prior is None:
            return self._no_prior[0]
        found = np.empty((len(actions), self.grid.n_variables))
        _interpolate_prior.call(self.fits.prior, self.grid.plain, states, actions, self._corners, found)
        return found

    def renew_prior(self) -> np.ndarray:
        if self._prior is None or self._prior.prior_version() == self._prior_version:
            return NO_PAIRS
        self._prior_version = self._prior.prior_version()
        fits, n_points = self.fits, self.grid.n_points
        points = self.grid.points()
        for action in range(self.n_actions):
            pairs = slice(action * n_points, (action + 1) * n_points)
            given = self._prior.prior(points, np.full(n_points, action))
            fits.prior[pairs] = np.column_stack([given.effect, given.reward, given.end])
            fits.claimed[pairs] = self._claims(given)
        self._recount()
        return np.arange(len(self.known))

    def _recount(self) -> None:
        """Compute sums and fits of all pairs from the instances."""
        self._renew_targets()
        grid, threshold = self.grid.arrays, self._threshold_on_grid()
        _recount.call(self.instances, self.fits, grid, self._kernel, threshold, self._scratch)

    def _renew_targets(self) -> None:
        """Compute what the prior leaves over of each instance's effect, and the range of effects."""
        fits, instances = self.fits, self.instances
        for action, size in enumerate(instances.size.tolist()):
            effects = instances.effect[action, :size]
            fits.target[action, :size] = effects
            # One after the other, as they came.
            fits.effect_range[2, action] = np.cumsum(np.abs(effects), axis=0)[-1] if size else 0.0
            mean_size = fits.effect_range[2, action] / max(1, size)
            fits.effect_scale[action] = np.maximum(2.0 * mean_size, LEAST_SCALE / self.grid.arrays.cells)
            if self._prior is not None and size:
                fits.target[action, :size] -= self._prior_effects(instances.state[action, :size], np.full(size, action))
            self._renew_range(action, effects)

    def _renew_range(self, action: int, effects: np.ndarray) -> None:
        """Compute the range of an action's effects from those of its instances, and of the prior."""
        if self._prior is not None:
            of_action = slice(action * self.grid.n_points, (action + 1) * self.grid.n_points)
            effects = np.vstack([effects, self.fits.prior[of_action, : self.grid.n_variables]])
        self.fits.effect_range[0, action] = effects.min(axis=0, initial=np.inf)
        self.fits.effect_range[1, action] = effects.max(axis=0, initial=-np.inf)

    def _forget_range_of(self, action: int, slot: int) -> None:
        """Take an instance out of the range of effects, as it is after loading."""
        effects = self._instances.effect[action, : self._instances.size[action]]
        low, high = self.fits.effect_range[:2, action]
        if ((effects[slot] <= low) | (effects[slot] >= high)).any():
            self._renew_range(action, np.delete(effects, slot, axis=0))

    def _threshold_on_grid(self) -> float:
        return (ON_GRID if self._informed else 1.0) * self.exploration_threshold

    def _inform(self, reward: float, terminated: bool) -> np.ndarray:
        """Note an outcome; the pairs that become known because it is the first that differs."""
        if self._informed:
            return NO_PAIRS
        self._first_reward = reward if np.isnan(self._first_reward) else self._first_reward
        self._informed = terminated or abs(reward - self._first_reward) > 1e-9 * abs(reward)
        if not self._informed:
            return NO_PAIRS
        if self._narrowing > 1.0:
            self._set_narrowing(1.0)
            self._recount_totals()
        return self.lower_threshold(self.exploration_threshold)

    def _narrow_known(self) -> np.ndarray:
        """Narrow the kernel that decides what is known while no outcome has told states apart; what is no longer known."""
        explored = EXPLORED if self._narrowing == 1.0 else EXPLORED_AGAIN
        if self._informed or self._n_added % CHECKED_EVERY or self.known.mean() < explored:
            return NO_PAIRS
        self._set_narrowing(2.0 * self._narrowing)
        self._recount_totals()
        forgotten = np.flatnonzero(self.known & (self.own_weight < self._threshold_on_grid()))
        self.known[forgotten] = False
        self._refit_claimed(forgotten)
        return forgotten

    def _refit_claimed(self, pairs: np.ndarray) -> None:
        """Have pairs that the prior claims fitted anew: with what is known changes what the prior is used for."""
        self.fits.unexplained[pairs[self.fits.claimed[pairs]]] = np.inf

    def _set_narrowing(self, narrowing: float) -> None:
        """Let known be decided by a kernel whose squared breadth is so many times smaller."""
        self._narrowing = narrowing
        self._kernel = self._kernel._replace(counting_scale=narrowing * self._kernel.scale)
        self._plain_kernel = tuple(self._kernel)

    def _recount_totals(self) -> None:
        _recount_totals.call(self.instances, self.fits, self.grid.arrays, self._kernel, self._scratch)

    def lower_threshold(self, threshold: float) -> np.ndarray:
        self.exploration_threshold = threshold
        newly_known = np.flatnonzero(~self.known & (self.own_weight >= self._threshold_on_grid()))
        self.known[newly_known] = True
        self._refit_claimed(newly_known)
        return newly_known

    def end_episode(self) -> np.ndarray:
        """Fit all pairs again that have had instances since the last time."""
        changed = np.empty(len(self.known), dtype=np.int64)
        effect_range = self.fits.effect_range[:2]
        range_has_changed = (effect_range != self._range_before).any(axis=(0, 2))
        n = _refit_changed.call(self.fits, self.grid.arrays, self._scratch, range_has_changed, changed)
        self._range_before = effect_range.copy()
        return changed[:n]

    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        mdp, grid, scratch = self.mdp, self.grid.plain, (self.mdp.plain_scratch, self._plain_scratch)
        return int(_update_rows.call(self._plain_fits, mdp.plain, grid, self._planned, pairs, transferred, *scratch))

    def _predict_own(self, state: np.ndarray) -> float:
        of_model = self.fits.target, self.fits.effect_range, *self._prior_at(state)
        near, prediction, threshold = self._plain_near, self._plain_prediction, self.exploration_threshold
        return float(
            _predict_own.call(self._plain_instances, of_model, state, self._plain_kernel, threshold, near, prediction)
        )

    def _join_transferred(self, given: TransferredInstances) -> None:
        _join_transferred.call(tuple(given), self.exploration_threshold, self._plain_prediction)

    def get_state(self) -> dict[str, np.ndarray]:
        return {
            **super().get_state(),
            "reach": self.fits.reach.copy(),
            "limit": self.fits.limit.astype(np.float64),
            # The instance that has told states apart may have been replaced.
            "narrowing": np.array([self._narrowing, float(self._informed), float(self._n_added)]),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Compute sums and fits from the instances; pairs that were known stay known."""
        instances = Instances.from_rows(self.n_actions, state["instances"][:, :-1], self.grid.arrays.periodic)
        self.instances = instances
        fits = self.fits
        for row in state["instances"]:
            self._inform(row[-3], row[-2] > 0.5)
        narrowing, informed, n_added = state["narrowing"].tolist()
        self._informed = self._informed or informed > 0.5
        self._n_added = int(n_added)
        self._set_narrowing(min(max(1.0, narrowing), MAX_NARROWING))
        # Whatever a file says, or another ``model_breadth`` or ``n_neighbors`` than when it was saved.
        fits.reach[:] = np.clip(state["reach"], 0.0, self._kernel.reach)
        fits.limit[:] = np.clip(state["limit"], fits.limit, np.iinfo(np.int32).max)
        fits.known[:] = state["known"] > 0.5
        self._set_fits(fits._replace(target=np.empty_like(instances.effect)))
        if len(self.renew_prior()) == 0:
            self._recount()
        fits.total[:] = state["total"]
        self.update_all_rows()
        self._range_before = fits.effect_range[:2].copy()
