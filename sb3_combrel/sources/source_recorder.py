"""The callback that records source instances while an SB3 algorithm learns."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.common.scaling import Bounds
from sb3_combrel.sources.recording import log_step, raw_states
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.sources.transitions import (
    TransitionLog,
    Transitions,
    count_actions,
    describe_origin,
    limits_of_task,
    task_names,
)


class SourceRecorder(BaseCallback):
    """Callback that records every transition while an SB3 algorithm learns; read them from :meth:`source_instances`.

    Under ``VecNormalize`` the original states and rewards are recorded.

    :param max_instances: how many to keep at most, a uniform random sample of all; None for all
    :param bounds: ``(low, high)`` of the states; None: those of the observation space, or the range of what is recorded
    :param seed: seed of the sample
    :param verbose: SB3's verbosity
    """

    def __init__(
        self, max_instances: int | None = None, bounds: Bounds | None = None, seed: int | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.bounds, self.seed = bounds, seed
        self.log = TransitionLog(max_instances, seed)
        self._states: NDArray[Any] | None = None

    def _on_training_start(self) -> None:
        # Refuse spaces now, not after hours of learning.
        self._limits = limits_of_task(self.training_env, self.bounds)
        self._n_actions = count_actions(self.training_env.action_space)
        self._names = task_names(self.training_env)
        self._origin = describe_origin(self.training_env, type(self.model).__name__, self.model.seed)
        self._states = raw_states(self.training_env, self.model._last_obs)  # type: ignore[attr-defined]
        self._n_seen = self.model.num_timesteps

    def _on_step(self) -> bool:
        missing = {"actions", "new_obs", "rewards", "dones", "infos"} - set(self.locals)
        if missing or self._states is None:
            raise ValueError(
                f"{type(self).__name__} cannot record {type(self.model).__name__}: its callbacks have no {sorted(missing)}; "
                "record the trained model with SourceInstances.record(model, env)"
            )
        n_new, self._n_seen = self.num_timesteps - self._n_seen, self.num_timesteps
        if n_new != self.training_env.num_envs:
            raise ValueError(
                f"{type(self).__name__} must be called at every step, got one call for {n_new} steps: pass it to "
                "learn(callback=...) itself; fewer instances are kept with max_instances=..."
            )
        step = (self.locals["new_obs"], self.locals["rewards"], self.locals["dones"], self.locals["infos"])
        self._states = log_step(self.log, self.training_env, self._states, self.locals["actions"], step)
        return True

    def transitions(self) -> Transitions:
        """:meth:`source_instances` as :class:`~sb3_combrel.sources.transitions.Transitions`."""
        if self._states is None:
            raise ValueError("nothing has been recorded yet: pass the recorder to learn(callback=...) first")
        origin = {**self._origin, "recorded_while_learning": True, "n_seen": self.log.n_seen}
        return self.log.transitions(self._limits, self._n_actions, self._names, origin)

    def source_instances(self) -> SourceInstances:
        """What has been recorded so far; ``ValueError`` if nothing has been."""
        return SourceInstances(*self.transitions())
