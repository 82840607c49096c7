"""The policy of Fitted R-Max: the agent behind Stable-Baselines3's ``predict`` and ``state_dict``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_combrel.common.task import Task
from sb3_combrel.fitted_rmax.agent import OF_TRANSFER, FittedRMaxAgent
from sb3_combrel.fitted_rmax.scales import FoundScales
from sb3_combrel.fitted_rmax.settings import MODELS, FittedRMaxSettings
from sb3_combrel.models.base import Model
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import describe_transfer, restore_transfer


class FittedRMaxPolicy(BasePolicy):
    """Acts on the action values of a :class:`~sb3_combrel.fitted_rmax.agent.FittedRMaxAgent`, :attr:`agent`.

    Its ``state_dict`` consists of float64 tensors made from :meth:`FittedRMaxAgent.get_state`; all else is rebuilt from these.

    :param observation_space: a one-dimensional Box
    :param action_space: Discrete
    :param lr_schedule: not used; SB3 passes one to every policy
    :param transfer: a transfer method of the policy's own; or what a file has of one
    :param model_class: the model of the dynamics; None: the one for ``degree``
    :param state_names: for display; ``action_names``: the same
    :param rng: generator of all random numbers of learning
    :param settings: arguments of :class:`FittedRMaxSettings`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        *,
        transfer: Transfer | dict[str, Any] | None = None,
        model_class: type[Model] | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        rng: np.random.Generator | None = None,
        **settings: Any,
    ):
        super().__init__(observation_space, action_space, normalize_images=False)
        if model_class is not None and not (isinstance(model_class, type) and issubclass(model_class, Model)):
            raise ValueError(f"model_class must be a subclass of Model or None, got {model_class!r}")
        given = FittedRMaxSettings(**settings)
        self.scales = FoundScales(observation_space, given.bounds, given.periodic)
        states, actions = (() if names is None else names for names in (state_names, action_names))
        task = Task(self.scales.scaling, int(action_space.n), states, actions, self.scales.bounds, self.scales.are_given)
        self.agent = FittedRMaxAgent(given, task, restore_transfer(transfer), rng, model_class)
        #: Observations, raw units, to unit coordinates.
        self.to_unit = self.scales.to_unit
        self._first_action = int(action_space.start)

    def take_in(self, past: SourceInstances) -> None:
        """Learn from past transitions of the same variables and actions, in their order, or from none."""
        before = self._learned()
        # As Stable-Baselines3 hands over an environment's: rewards that differ by their rounding alone tell no states apart.
        rewards = past.rewards.astype(np.float32).astype(np.float64)
        try:
            for observations in (past.states, past.next_states):
                self.to_unit(observations, note=True)
            self.follow_scales(episode_ended=True)
            states, next_states = self.to_unit(past.states), self.to_unit(past.next_states)
            each = states, past.actions.tolist(), rewards.tolist(), next_states, past.terminated.tolist()
            self.agent.take_in(list(zip(*each, strict=True)))
        except BaseException:
            # An interrupt must not leave a part of them behind, which a second attempt would double.
            self._replace_learned(before)
            raise

    def follow_scales(self, episode_ended: bool) -> bool:
        """Compute all anew in other unit coordinates if the observations so far ask for that; whether they do."""
        if self.scales.fixed or not (episode_ended or self.scales.went_beyond):
            return False
        # No other thread may see new scales with old instances.
        with self.agent.lock:
            before, scaling = self.scales.scaling, self.scales.renewed(episode_ended, self.agent.transfers)
            if scaling is not None:
                try:
                    self.scales.warn_of_surprises(before, self.agent.task.state_names, self.agent.model.n_instances)
                    self.agent.rescale(scaling, self.scales.bounds)
                except BaseException:
                    self.scales.scaling = self.agent.task.scaling
                    raise
        return scaling is not None

    @property
    def transfer(self) -> Any:
        """The transfer method, bound to the task; None if there is none. Which class it is, the user knows, not the type."""
        return self.agent.transfer

    def _get_constructor_parameters(self) -> dict[str, Any]:
        spaces_of_both = dict(observation_space=self.observation_space, action_space=self.action_space)
        settings, model_class = self.agent.settings, self.agent.model_class
        parameters = {**spaces_of_both, **vars(settings), "transfer": describe_transfer(self.transfer)}
        # A class is pickled by its name, and imported by who reads it: only one of the user's own has to be.
        return parameters if model_class is MODELS[settings.degree] else {**parameters, "model_class": model_class}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The best known actions; without ``deterministic`` optimistic actions first, as in learning."""
        agent = self.agent
        with agent.lock:
            states = self.to_unit(observation.cpu().numpy())  # type: ignore[union-attr]
            chosen = [agent.act(state, explore=False) if deterministic else agent.sample_action(state) for state in states]
        actions = np.array(chosen, dtype=np.int64) + self._first_action
        return th.as_tensor(actions, device=observation.device)  # type: ignore[union-attr]

    def _learned(self) -> dict[str, np.ndarray]:
        with self.agent.lock:
            return {**self.agent.get_state(), "scales": self.scales.get_state()}

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, th.Tensor]:  # type: ignore[override]
        """What has been learned, float64 tensors by name."""
        # Column by column: a file of it becomes a tenth smaller.
        arrays = {name: np.array(array, dtype=np.float64, order="F") for name, array in self._learned().items()}
        return {name: th.as_tensor(array, device=self.device) for name, array in arrays.items()}

    def load_state_dict(  # type: ignore[override]
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> None:
        """Load parameters as PyTorch does; without ``strict`` those that are not given stay as they are.

        :raises RuntimeError: if parameters do not fit; nothing has changed then
        """
        expected = self.state_dict()
        # Older files do not have it: there where one arrives decides how episodes end.
        given = {**({"ends": th.tensor([0.0, 1.0])} if strict else expected), **state_dict}
        problems = [problem for name, tensor in expected.items() if (problem := _misfit(name, given.get(name), tensor))]
        unknown = [name for name in given if strict and name not in expected]
        if unknown:
            problems.append(f"unknown are {', '.join(unknown)}")
        if self.transfer is None and any(name.startswith(OF_TRANSFER) for name in unknown):
            problems.insert(0, "these are parameters of a model with a transfer method: pass the same one, transfer=...")
        if problems:
            raise RuntimeError(f"parameters do not fit: {'; '.join(problems)}")
        fixed = self.scales.scaling if self.scales.fixed else None
        # Row by row again: for arrays in another order all would be compiled once more.
        arrays = {name: given[name].detach().cpu().numpy().astype(np.float64, order="C") for name in expected}
        self._replace_learned(arrays)
        if fixed is not None and fixed != self.scales.scaling:
            # The user gives other bounds than those of the file.
            self.scales.scaling = fixed
            self.agent.rescale(fixed, fixed)

    def _replace_learned(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`_learned` returned, in place of what was learned."""
        with self.agent.lock:
            self.scales.set_state(arrays["scales"])
            self.agent.set_state(arrays, self.scales.scaling, self.scales.bounds)


def _misfit(name: str, tensor: Any, expected: th.Tensor) -> str:
    """Say in what a saved tensor differs from what a new agent has by that name; arrays may differ in their rows."""
    if tensor is None:
        return f"{name} is missing"
    if not isinstance(tensor, th.Tensor) or tensor.dtype not in (th.float64, th.float32):
        return f"{name} must be a tensor of floating-point numbers, got {getattr(tensor, 'dtype', type(tensor).__name__)}"
    fixed = 1 if expected.ndim > 1 else 0
    if tensor.ndim != expected.ndim or tensor.shape[fixed:] != expected.shape[fixed:]:
        shape = ", ".join(["any"] * fixed + [str(n) for n in expected.shape[fixed:]])
        return f"{name} must have shape ({shape}), got {tuple(tensor.shape)}"
    return "" if th.isfinite(tensor).all() else f"{name} must have finite numbers only"
