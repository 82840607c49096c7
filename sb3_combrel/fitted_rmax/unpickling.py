"""What Stable-Baselines3 has pickled in a model's file is looked at before it reads it: a pickle may run any program."""

from __future__ import annotations

import base64
import io
import pickle
import sys
from collections.abc import Container, Mapping
from typing import Any

from gymnasium.spaces import Space
from stable_baselines3.common.policies import BasePolicy

from sb3_combrel.models.base import Model

SERIALIZED = ":serialized:"
#: Names that the pickles of observation spaces, of arrays and of buffers need: none of them does anything else.
NAMES = {
    "collections": {"deque", "OrderedDict"},
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    "numpy.random._pickle": {"__bit_generator_ctor", "__generator_ctor", "__randomstate_ctor"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random._mt19937": {"MT19937"},
    "numpy.random.bit_generator": {"SeedSequence", "__pyx_unpickle_SeedSequence"},
}
#: Classes whose subclasses a user may have passed, if whoever reads the file has imported them.
KINDS = BasePolicy, Model, Space


def check_pickles(attributes: Mapping[str, Any], custom_objects: Container[str]) -> None:
    """Read what is pickled in a model's file without running anything but what spaces, arrays and buffers need.

    :param attributes: what the file has of each, as JSON has it
    :param custom_objects: names that are not read, as they are replaced
    :raises ValueError: if a pickle asks for something else
    """
    for name, value in attributes.items():
        if isinstance(value, dict) and SERIALIZED in value and name not in custom_objects:
            try:
                _Careful(io.BytesIO(base64.b64decode(value[SERIALIZED]))).load()
            except _Refused as error:
                wanted = f"pass what it should be, custom_objects={{{name!r}: ...}}, or import its class first"
                raise ValueError(f"{name} is pickled and asks for {error}, which may run a program; {wanted}") from error


class _Refused(ValueError):
    """A pickle asks for something that is not needed."""


class _Careful(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """A class or a function that a pickle asks for."""
        if name in NAMES.get(module.replace("numpy.core.", "numpy._core."), ()):
            return super().find_class(module, name)
        # Importing a module runs it: only what is there already is considered.
        found: Any = sys.modules.get(module)
        for part in name.split("."):
            found = getattr(found, part, None)
        if isinstance(found, type) and issubclass(found, KINDS):
            return found
        raise _Refused(f"{module}.{name}")
