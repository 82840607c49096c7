"""What is saved of a policy: arrays from which all else is rebuilt."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_combrel.common.instances import InstanceArrays
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.saving import misfit
from sb3_combrel.models.kernel_average import KernelModel
from sb3_combrel.planning.corrections import CorrectionArrays
from sb3_combrel.planning.sweeping import Planner
from sb3_combrel.transfer.base import TargetTask, Transfer


class RestorablePolicy(BasePolicy):
    """
    The part of :class:`FittedRMaxPolicy` that saves and restores.

    Its ``state_dict`` holds float64 tensors made from the arrays of the compiled code: the instances, the values of the
    grid points, which pairs are known, and the corrections. Everything else is rebuilt from these.
    """

    model: KernelModel
    planner: Planner
    corrections: CorrectionArrays
    transfer: Transfer | None
    scaling: StateScaling
    rng: np.random.Generator
    n_actions: int
    n_truncated: int
    _task: TargetTask

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        for name, array in self._saved_arrays().items():
            # Column by column: a file of it becomes a tenth smaller.
            destination[prefix + name] = th.as_tensor(np.array(array, dtype=np.float64, order="F"), device=self.device)

    def _saved_arrays(self) -> dict[str, np.ndarray]:
        instances = self.model.instances
        by_action = []
        for action, count in enumerate(instances.count):
            columns = [
                np.full((count, 1), action),
                instances.state[action, :count],
                instances.effect[action, :count],
                instances.reward[action, :count, None],
                instances.terminated[action, :count, None],
                self.model.arrays.members[action, :count, None] > 0,
            ]
            by_action.append(np.hstack(columns))
        n = int(self.corrections.count[0])
        of_transfer = {} if self.transfer is None else self.transfer.saved_arrays()
        return {
            **{f"transfer_{name}": array for name, array in of_transfer.items()},
            "instances": np.vstack(by_action),
            "values": self.planner.values,
            "known": self.model.arrays.known,
            "total": self.model.arrays.total,
            "lowest_value": np.array([self.planner.bounds[0]]),
            "n_truncated": np.array([float(self.n_truncated)]),
            "corrections": np.column_stack([self.corrections.key[:n], self.corrections.value[:n], self.corrections.state[:n]]),
        }

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        saved = {}
        ours = self._saved_shapes().keys()
        for name in ours:
            if prefix + name in state_dict:
                saved[name] = state_dict[prefix + name].detach().cpu().numpy().astype(np.float64)
            else:
                missing_keys.append(prefix + name)
        unexpected_keys.extend(k for k in state_dict if strict and k.startswith(prefix) and k[len(prefix) :] not in ours)
        if self.transfer is None and any(name.startswith(prefix + "transfer_") for name in state_dict):
            error_msgs.append("these are parameters of a model with a transfer method: pass the same one, transfer=...")
        if len(saved) == len(ours):
            problem = misfit(saved, self._saved_shapes())
            if problem:
                error_msgs.append(problem)
            else:
                self._restore(saved)

    def _saved_shapes(self) -> dict[str, tuple[int | None, ...]]:
        """Shapes that saved arrays must have; None for any number of rows."""
        d, n_points = self.scaling.n_variables, self.model.grid.n_points
        n_pairs = n_points * self.n_actions
        of_transfer = {} if self.transfer is None else self.transfer.saved_arrays()
        return {
            **{f"transfer_{k}": (None, *a.shape[1:]) if a.ndim > 1 else a.shape for k, a in of_transfer.items()},
            "instances": (None, 2 * d + 4),
            "corrections": (None, d + 2),
            "values": (n_points,),
            "known": (n_pairs,),
            "total": (n_pairs,),
            "lowest_value": (1,),
            "n_truncated": (1,),
        }

    def _restore(self, saved: dict[str, np.ndarray]) -> None:
        model, d = self.model, self.scaling.n_variables
        self.n_truncated = int(saved["n_truncated"][0])
        rows = saved["instances"]
        actions = np.clip(rows[:, 0], 0, self.n_actions - 1).astype(np.int64)
        order = np.argsort(actions, kind="stable")
        rows, actions = rows[order], actions[order]
        fresh = KernelModel(
            model.grid,
            self.n_actions,
            model_breadth=model.model_breadth,
            min_weight=model.min_weight,
            min_fraction=model.min_fraction,
            exploration_threshold=model.full_threshold,
            gamma=model.gamma,
            transfer=model.transfer,
            max_instances=model.max_instances,
        )
        if self.transfer is not None:
            self.transfer.bind(self._task, self.rng)
            prefix = "transfer_"
            self.transfer.restore({name.removeprefix(prefix): a for name, a in saved.items() if name.startswith(prefix)})
        fresh.instances = InstanceArrays.of_rows(
            self.n_actions, actions, rows[:, 1 : 1 + d], rows[:, 1 + d : 1 + 2 * d], rows[:, -3], rows[:, -2] > 0.5
        )
        fresh.lower_threshold(self.n_truncated)
        fresh.restore(rows[:, -1] > 0.5, saved["known"] > 0.5, saved["total"])
        self.model = self.planner.model = fresh
        self.planner.bounds = (float(saved["lowest_value"][0]), self.planner.bounds[1])
        self.planner.restore(saved["values"])
        corrections = saved["corrections"]
        self.corrections = CorrectionArrays.of_rows(corrections[:, 0].astype(np.int64), corrections[:, 1], corrections[:, 2:])
