"""The `Environment` of both domains."""

from typing import Any

from combrel_envs import rendering

rendering.import_dm_control()

import dm_env  # noqa: E402
from dm_control.rl import control  # noqa: E402


class TerminatingEnvironment(control.Environment):
    """An `Environment` in which an end on the last step of the time limit terminates the episode, as on any other step."""

    def step(self, action: Any) -> dm_env.TimeStep:
        """Updates the environment using the action and returns a `TimeStep`."""
        time_step = super().step(action)
        if time_step.last() and self.task.get_termination(self.physics) is not None:
            return time_step._replace(discount=0.0)
        return time_step
