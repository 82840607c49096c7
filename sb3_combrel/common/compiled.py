"""How the inner loops are compiled: on first use, cached on disk, with a word to the user while it lasts."""

import gc
import sys
from typing import Any

from numba import njit
from numba.core import event

# The loops allocate nothing, so they run without numba's reference counting: its atomic increments at every call with
# an array cost more than the loops themselves, and so does wrapping every array that comes in from Python.
_njit: Any = njit
_options: dict[str, Any] = dict(cache=True, _nrt=False, error_model="numpy", no_cfunc_wrapper=True)
compiled = _njit(**_options)

# The same for functions that only compiled code calls: each array that may come in from Python costs time to compile.
# Calling one from Python would crash; a test compiles its ``py_func`` anew.
inner = _njit(**_options, no_cpython_wrapper=True)

# The same for functions that have one caller: they are compiled as a part of it, not once more for themselves.
part = _njit(**_options, no_cpython_wrapper=True, inline="always")

# The same for small functions called in the innermost loops: a call costs more than what they do.
inlined = _njit(**_options, no_cpython_wrapper=True, forceinline=True)

# ``inner``, for loops whose sums may be taken in any order, as vector registers do.
inner_fast = _njit(**_options, no_cpython_wrapper=True, fastmath={"reassoc", "contract", "nsz", "arcp"})

# A variable that starts as a plain 0 and is passed to another compiled function would have that function compiled twice,
# for the constant and for the variable: such variables start as np.int64(0).


class SameTypes:
    """A compiled function for a caller that hands over arguments of the same types every time.

    On each call numba looks at the types of all arguments, and tuples of arrays take it longer than our loops take.
    Here only the first call does. What comes from outside must be brought to its type before.

    :param function: made by :data:`compiled`
    """

    def __init__(self, function: Any):
        self.function = function
        self._entry: Any = None

    def __call__(self, *arguments: Any) -> Any:
        if self._entry is None:
            types = tuple(self.function.typeof_pyval(argument) for argument in arguments)
            self.function.compile(types)
            self._entry = self.function.overloads[types].entry_point
        return self._entry(*arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return SameTypes, (self.function,)


class _FirstUse(event.Listener):
    """Accompanies the compilation of our loops: says once, on stderr, what goes on, and holds garbage collection back.

    A compiler makes millions of objects that stay for a while. To look through them, and through all that PyTorch has
    loaded, again and again takes a tenth of the time or more; to let them lie takes 10 MB.
    """

    def __init__(self) -> None:
        self.announced = False
        self.depth = 0
        self.collects = False

    def on_start(self, event: Any) -> None:
        if not _is_ours(event):
            return
        if not self.announced:
            self.announced = True
            print(
                "sb3_combrel: compiling inner loops for this machine, once (up to half a minute) ...",
                file=sys.stderr,
                flush=True,
            )
        # Compiling a loop compiles what it calls.
        if self.depth == 0:
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        if not _is_ours(event):
            return
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()


def _is_ours(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("sb3_combrel.")


event.register("numba:compile", _FirstUse())
