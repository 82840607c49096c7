"""Saving and loading of Fitted R-Max by Stable-Baselines3's methods, with all that is needed to learn on."""

from __future__ import annotations

import copy
import io
import json
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.save_util import load_from_zip_file, open_path
from stable_baselines3.common.type_aliases import GymEnv

from sb3_combrel.common.checks import check_boolean
from sb3_combrel.common.files import write_whole
from sb3_combrel.common.serialisation import damage_text, to_plain
from sb3_combrel.common.version import __version__
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.fitted_rmax.unpickling import check_pickles
from sb3_combrel.sources.transitions import full_id
from sb3_combrel.transfer.by_name import check_argument_names, describe_transfer

# The digits of real numbers hardly compress: higher levels take longer and gain a hundredth.
COMPRESSION = 1

# Arguments by which what was learned is laid out: where the layout is another, a new model takes the instances. Those that
# values depend on, the model does not. And those on which nothing depends that has been computed.
NOT_TO_CHANGE = {"degree", "max_instances", "model_breadth", "periodic", "resolution", "transfer"}
OF_VALUES = {"gamma", "max_value"}
OF_NOTHING = {"max_instances", "planning_tolerance"}
# The version of a file that names none, as those of other algorithms do not.
BEFORE = "before 0.2"


class ParametersError(ValueError, RuntimeError):
    """Parameters that do not fit a model; a RuntimeError as well, since that is what PyTorch raises."""


class SavedAlgorithm(BaseAlgorithm):
    """What :class:`~sb3_combrel.FittedRMax` is, apart from learning: it can be saved, loaded, and given parameters."""

    policy: FittedRMaxPolicy  # type: ignore[assignment]
    #: The transfer method in use, bound to the task; None if there is none.
    transfer: Any
    _rng: np.random.Generator
    _generator_state: dict[str, Any] | None
    _prediction_state: dict[str, Any] | None
    #: Version of this package that has saved the model.
    package_version: str

    def save(
        self, path: str | Path | io.BufferedIOBase, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """
        Save all attributes of the object and the model's parameters in a zip-file, which is written completely or not at all.

        A transfer method is saved as plain data, with its source instances; one of your own by what ``Transfer.arguments``
        returns. What cannot be written so is left out, with a warning, and must be passed to :meth:`load`.

        A loaded model predicts what this one does, and learns on as this one would, bit for bit. Not saved but computed again
        are ``TIMBREL``'s random draws; and instances that ``max_instances`` has removed leave no trace, which until then they
        have where pairs of the grid were fitted to them.

        :param path: of the file; .zip is added if it has no suffix
        :param exclude: names of attributes that are excluded as well
        :param include: names of excluded attributes that are included
        :raises OSError: if the file cannot be written
        :raises ValueError: if ``path`` is neither of these
        """
        if not (Path(path).name if isinstance(path, str | Path) else hasattr(path, "write")):
            raise ValueError(f"path must be the name of a file, or an open file, got {path!r}")
        written, archive = copy.copy(self), io.BytesIO()
        for name in (*FittedRMaxSettings.names(), "seed"):
            setattr(written, name, to_plain(getattr(self, name)))
        written.transfer = describe_transfer(self.policy.transfer)
        written.package_version = __version__
        written._generator_state = dict(self._rng.bit_generator.state)
        written._prediction_state = dict(self.policy.agent.prediction_rng.bit_generator.state)
        super(SavedAlgorithm, written).save(archive, exclude, include)
        content = _zipped_anew(archive, zipfile.ZIP_DEFLATED).getvalue()
        if isinstance(path, str | Path):
            target = Path(path)
            write_whole(target if target.suffix else target.with_name(f"{target.name}.zip"), content)
        else:
            open_path(path, "w").write(content)

    @classmethod
    def load(  # type: ignore[override]
        cls,
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Load the model from a zip-file.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on, or its name; None suffices for predictions
        :param device: device on which the tensors of the policy go
        :param custom_objects: objects that replace those of the file
        :param print_system_info: whether to print system info from the saved model and the current system info
        :param force_reset: force a call to ``reset()`` before training
        :param kwargs: arguments of the constructor to change; ``transfer=`` where a transfer method could not be saved, or the
            saved one once more; ``instances=`` for more past data. Without ``seed=`` the random number generators continue
            from their saved states.
        :return: new model instance with loaded parameters
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if the file is damaged, was not saved by this class, or does not fit the other arguments
        """
        check_argument_names(cls, kwargs)
        environment = maybe_make_env(full_id(env), verbose=0)
        instances = kwargs.pop("instances", None)
        laid_out = sorted(kwargs.keys() & NOT_TO_CHANGE)
        if "seed" in kwargs:
            kwargs["_generator_state"] = None
        with _naming(path, laid_out):
            archive = _read(path)
            saved = _attributes_in(archive)
            check_pickles(saved, custom_objects or ())
            model = super().load(
                archive, environment, device, custom_objects, print_system_info, force_reset, **kwargs  # type: ignore[arg-type]
            )
        if "transfer" in kwargs:
            _check_same_transfer(model.policy.transfer, saved.get("transfer"), path)
        agent, changed = model.policy.agent, _changed_settings(model, saved)
        if changed - OF_VALUES:
            agent.rescale(agent.task.scaling, agent.task.bounds)
        elif changed:
            agent.plan_anew()
        _check_room(int(agent.model.instances.size.max()), agent.settings.max_instances)
        return model if instances is None else cast(Any, model).load_instances(instances)

    def set_parameters(
        self,
        load_path_or_dict: str | Path | io.BufferedIOBase | dict[str, Any],  # type: ignore[override]
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """Load parameters from the file of a saved model, or from what :meth:`get_parameters` returned.

        :param load_path_or_dict: path of the file, an open file, or a dict of a dict of tensors, ``{"policy": {...}}``
        :param exact_match: False: tensors that are not given stay as they are, and unknown ones are ignored
        :param device: not used; the work is done on the CPU
        :raises ValueError: if parameters are missing, unknown, of another shape or type, or not finite; nothing is changed
        """
        check_boolean("exact_match", exact_match)
        given: Any = load_path_or_dict
        if isinstance(given, str | Path) or hasattr(given, "read"):
            with _naming(given):
                given = load_from_zip_file(_read(given), load_data=False, device="cpu")[1]
        known = "load_path_or_dict must be a saved model's file or a dict of dicts of tensors as get_parameters returns it"
        if not isinstance(given, dict):
            raise ParametersError(f"{known}, got {type(given).__name__}")
        names = self._get_torch_save_params()[0]
        if (exact_match and set(given) != set(names)) or not set(given) <= set(names):
            raise ParametersError(f"{known}, with parameters of {names}, got those of {list(given)}")
        if not all(isinstance(each, Mapping) for each in given.values()):
            raise ParametersError(f"{known}; not all of these are dicts")
        try:
            super().set_parameters(given, exact_match, device)
        except RuntimeError as error:
            raise ParametersError(f"load_path_or_dict: {' '.join(str(error).split())}") from error

    def _excluded_save_params(self) -> list[str]:
        own = ["_rng", "_episode_rewards", "_last_states", "_interrupts", "_progress"]
        return [*super()._excluded_save_params(), *own]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []


def _attributes_in(archive: Any) -> dict[str, Any]:
    """What Stable-Baselines3 has written of a model's attributes to an open file, or one of that name, as JSON has it."""
    with zipfile.ZipFile(archive) as content:
        return dict(json.loads(content.read("data")))


def _changed_settings(model: Any, saved: dict[str, Any]) -> set[str]:
    """The arguments that are others than those of the model that was saved, and on which what it has computed depends."""
    names = (name for name in FittedRMaxSettings.names() if name in saved and name not in OF_NOTHING)
    return {name for name in names if json.dumps(to_plain(getattr(model, name))) != json.dumps(saved[name])}


def _check_same_transfer(transfer: Any, saved: Any, path: object) -> None:
    """:raises ValueError: if a method, once it is bound, is not the one that was saved, as far as that is described"""
    if not isinstance(saved, dict) or saved.get("arguments") is None:
        return
    if json.dumps(describe_transfer(transfer), sort_keys=True) != json.dumps(saved, sort_keys=True):
        raise ValueError(
            f"transfer must be the method that {path} was saved with, with the same source and arguments, as what it has "
            f"learned is kept, got {transfer!r} for {saved.get('method')}: leave it out, or make a new model with the "
            f"instances: FittedRMax(env, instances={str(path)!r}, transfer=...)"
        )


def _check_room(most: int, max_instances: int | None) -> None:
    """:raises ValueError: if a model has more instances of an action, at ``most``, than it may keep"""
    if max_instances is not None and most > max_instances:
        raise ValueError(
            f"max_instances must be at least {most}, as many as the model has of one action, got {max_instances}"
            "; or make a new model with them: FittedRMax(env, instances=..., max_instances=...)"
        )


def _zipped_anew(archive: Any, compression: int) -> io.BytesIO:
    """The same archive with another compression; its checksums are compared."""
    content = io.BytesIO()
    with zipfile.ZipFile(archive) as given, zipfile.ZipFile(content, "w", compression, compresslevel=COMPRESSION) as written:
        for name in given.namelist():
            written.writestr(name, given.read(name))
    content.seek(0)
    return content


def _read(path: str | Path | io.BufferedIOBase) -> io.BytesIO:
    """The archive as Stable-Baselines3 makes it, not compressed: it seeks to and fro in it, and compares no checksums."""
    if isinstance(path, str | Path) and not any(each.exists() for each in (Path(path), Path(f"{path}.zip"))):
        raise FileNotFoundError(f"there is no model file {path}, looked for in {Path.cwd()}; write one with: model.save(path)")
    file = open_path(path, "r", suffix="zip")
    try:
        return _zipped_anew(file, zipfile.ZIP_STORED)
    finally:
        if isinstance(path, str | Path):
            file.close()


@contextmanager
def _naming(path: object, changed: Sequence[str] = ()) -> Iterator[None]:
    """:param changed: arguments that a model may not be able to change
    :raises ValueError: that names the file, whatever reading it raised: of damaged content libraries raise anything
    """
    try:
        yield
    except (FileNotFoundError, PermissionError):
        raise
    except Exception as error:
        version, policy = _origin(path)
        # A policy may be one of the user's own.
        if version == BEFORE and policy and not policy.startswith(f"{__name__.partition('.')[0]}."):
            raise ValueError(f"{path} is a model of another algorithm, of {policy}: load it with its own class") from error
        if "spaces do not match" in str(error) or str(error).startswith("env must have"):
            raise ValueError(f"{path} is a model of another task than env: {error}") from error
        if "was saved with the transfer method" in str(error):
            raise ValueError(f"{path}: {error}") from error
        wrong = f"is not the file of a model of FittedRMax, is damaged, or does not fit ({damage_text(error)})"
        if changed:
            wrong += f"; leave out {', '.join(changed)}, or make a new model: FittedRMax(env, instances={str(path)!r}, ...)"
        if version not in ("", __version__):
            wrong += f"; it was saved by sb3_combrel {version}, which can load it, and this is {__version__}"
        raise ValueError(f"{path} {wrong}") from error


def _origin(path: object) -> tuple[str, str]:
    """The version of this package that has saved a file, and the module of its policy; empty where nothing is known."""
    if isinstance(path, str | Path) and not Path(path).exists():
        path = f"{path}.zip"
    try:
        data = _attributes_in(path)
        return data.get("package_version", BEFORE), data.get("policy_class", {}).get("__module__", "")
    except Exception:
        # Damaged content makes libraries raise anything.
        return "", ""
