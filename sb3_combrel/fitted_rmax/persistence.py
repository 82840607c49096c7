"""Saving and loading of Fitted R-Max by Stable-Baselines3's methods, with all that is needed to learn on."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv

from sb3_combrel.common.serialisation import damage_text, to_plain
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.saving import ParametersError, check_tensors, read_model, write_model
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.transfer.by_name import describe_transfer

# No other algorithm has arguments of these names; a user may have excluded one or two of them from a file.
OWN_ARGUMENTS = ("model_breadth", "min_fraction", "min_weight", "exploration_threshold", "planning_tolerance")

SelfPersistentAlgorithm = TypeVar("SelfPersistentAlgorithm", bound="PersistentAlgorithm")


class PersistentAlgorithm(BaseAlgorithm):
    """What :class:`~sb3_combrel.FittedRMax` is, apart from learning: it can be saved, loaded, and given parameters."""

    policy: FittedRMaxPolicy  # type: ignore[assignment]
    #: The transfer method in use, bound to the task; None if there is none.
    transfer: Any
    _rng: np.random.Generator
    _generator_state: dict[str, Any] | None

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all attributes of the object and the model's parameters in a zip-file, which is written completely or not at all.

        A transfer method is saved as plain data, with its source instances; one of your own by what ``Transfer.arguments``
        returns. What cannot be written so is left out, with a warning, and must be passed to :meth:`load`.

        A model saved at the end of an episode and loaded learns on as this one would, bit for bit. In the middle of an episode
        its planning is completed first. Not saved but computed again are ``TIMBREL``'s random draws, and lists shortened by an
        instance that ``max_instances`` has since removed.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        """
        written, content = copy.copy(self), io.BytesIO()
        for name in (*FittedRMaxSettings.names(), "seed"):
            setattr(written, name, to_plain(getattr(self, name)))
        written.transfer = describe_transfer(self.policy.transfer)
        written._generator_state = dict(self._rng.bit_generator.state)
        super(PersistentAlgorithm, written).save(content, exclude, include)
        write_model(path, content)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfPersistentAlgorithm],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfPersistentAlgorithm:
        """
        Load the model from a zip-file.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on (if registered in Gymnasium, can be a str; can be None
            if you only need prediction from a trained model)
        :param device: device on which the tensors of the policy go
        :param custom_objects: objects that replace those of the file
        :param print_system_info: whether to print system info from the saved model and the current system info
        :param force_reset: force a call to ``reset()`` before training
        :param kwargs: arguments of the constructor to change; ``transfer=`` where a transfer method could not be saved.
            Without ``seed=`` the random number generator continues from its saved state.
        :return: new model instance with loaded parameters
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if the file is damaged or was not saved by this class
        """
        content = read_model(path, OWN_ARGUMENTS, FittedRMaxPolicy, [*(custom_objects or {}), *kwargs])
        environment = maybe_make_env(env, verbose=0) if isinstance(env, str) else env
        if "seed" in kwargs:
            kwargs["_generator_state"] = kwargs["_chance"] = None
        try:
            return super().load(content, environment, device, custom_objects, print_system_info, force_reset, **kwargs)
        except Exception as error:
            # A file of the user's that was passed as an argument is missing.
            if isinstance(error, OSError) and "transfer" in kwargs:
                raise
            # Damaged content makes the libraries below raise errors of any kind.
            raise ValueError(f"{path} cannot be loaded as a model of FittedRMax: {damage_text(error)}") from error

    def set_parameters(
        self,
        load_path_or_dict: str | Path | io.BufferedIOBase | dict[str, Any],  # type: ignore[override]
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Load parameters from the file of a saved model, or from what :meth:`get_parameters` returned.

        :param load_path_or_dict: path of the file, an open file, or a dict of a dict of tensors, ``{"policy": {...}}``
        :param exact_match: whether all parameters must be given; otherwise those that are not given stay as they are, and
            those that the model does not have are ignored
        :param device: not used; the work is done on the CPU
        :raises ValueError: if parameters are missing, unknown, of another shape or type, or not finite; nothing has changed
            then
        """
        if not isinstance(exact_match, bool):
            raise ValueError(f"exact_match must be True or False, got {exact_match!r}")
        parameters = self._parameters_of(load_path_or_dict, exact_match)
        try:
            super().set_parameters(parameters, exact_match, device)
        except RuntimeError as error:
            raise ParametersError(f"load_path_or_dict: {' '.join(str(error).split())}") from error

    def _parameters_of(self, given: Any, exact_match: bool) -> dict[str, Any]:
        """
        Read the argument of :meth:`set_parameters`.

        :raises ValueError: if it is neither a model's file nor a dict of dicts of tensors, or has other names
        """
        if isinstance(given, str | Path) or hasattr(given, "read"):
            content = read_model(given, OWN_ARGUMENTS, FittedRMaxPolicy)
            given = load_from_zip_file(content, load_data=False, device="cpu")[1]
        if not isinstance(given, dict):
            raise ValueError(
                f"load_path_or_dict must be the file of a saved model or a dict as get_parameters returns it, got {given!r}"
            )
        names = self._get_torch_save_params()[0]
        if (exact_match and set(given) != set(names)) or not set(given) <= set(names):
            raise ValueError(f"load_path_or_dict must have parameters of {names}, got {list(given)}")
        for tensors in given.values():
            check_tensors(tensors)
        return given

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rng", "_episode_rewards", "_episode_numbers", "_last_states", "_progress"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
