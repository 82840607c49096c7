"""How the inner loops are compiled: on first use, cached on disk, with a message while it lasts.

Compiled functions take arrays and NamedTuples of arrays. Those that Python calls are each an :func:`entry_point`. Numba
finds the types of arrays and plain tuples in C, of each NamedTuple in Python: functions that are called at every environment
step take plain tuples, and make NamedTuples of them.

Sums are taken in a fixed order, but for those of :data:`compiled_fast`: there results are the same to the last bit on one
machine only.
"""

import gc
import hashlib
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core import event

PACKAGE = Path(__file__).absolute().parent.parent


def remove_outdated(package: Path = PACKAGE, cache: str = str(getattr(config, "CACHE_DIR", ""))) -> None:
    """Remove compiled code that is older than any source file in the folders that have some, before the first call.

    Numba compiles a function again when its own file has changed, not when a file has changed whose functions it calls.

    :param package: absolute; it and the folders within it, with the cache beside each source file
    :param cache: where Numba keeps the compiled code of each folder instead, as ``NUMBA_CACHE_DIR`` says; "" for none
    """
    newest = 0.0
    indices: list[Path] = []
    for folder in {file.parent for file in package.rglob("*.py")}:
        found = list(folder.glob("__pycache__/*.nbi"))
        if cache:
            # The name that Numba gives there.
            found += Path(cache).glob(f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}/*.nbi")
        if found:
            newest = max(newest, *(file.stat().st_mtime for file in folder.glob("*.py")))
            indices += found
    for index in indices:
        try:
            if index.stat().st_mtime < newest:
                index.unlink()
        except OSError:
            # Another process was quicker, or the folder cannot be written to.
            continue


_remove_outdated_once = lru_cache(1)(remove_outdated)

_njit: Any = njit
# One option that is not in Numba's documentation, _nrt: no reference counts, which take a third of the time of a fit and half
# of a step's. A function that allocates does not compile.
_options: dict[str, Any] = dict(cache=True, error_model="numpy", _nrt=False)
compiled = _njit(**_options)

# Small functions called in the innermost loops, where a call costs more than what they do, and functions with one caller: they
# are compiled as a part of what calls them.
inlined = _njit(**_options, inline="always")

# ``compiled``, for loops whose sums may be taken in any order, as vector registers do.
compiled_fast = _njit(**_options, fastmath={"reassoc", "contract", "nsz", "arcp"})

# A variable that starts as a plain 0, say, and is passed to another compiled function would have that function compiled twice,
# for the constant and for the variable: such variables start as np.int64(0).


class EntryPoint:
    """A compiled function for callers from Python: ``function.call(...)``.

    Its first call may have to compile; it then prints a message, and garbage collection waits.
    """

    def __init__(self, function: Any):
        self.function = function
        #: Calls the function; the function itself from the second call on, which is the quickest way to call it.
        self.call = self._first_call

    def _first_call(self, *arguments: Any) -> Any:
        _remove_outdated_once()
        collects = gc.isenabled()
        gc.disable()
        try:
            with event.install_listener("numba:compile", _announcement):
                result = self.function(*arguments)
        finally:
            if collects:
                gc.enable()
        self.call = self.function
        return result


def entry_point(function: Any) -> EntryPoint:
    """Compile a function that only Python calls; as a decorator."""
    return EntryPoint(compiled(function))


class _Announcement(event.Listener):
    """Prints once, to stderr, that functions of this package are being compiled."""

    printed = False

    def on_start(self, event: Any) -> None:
        # Other threads may be compiling functions of their own, which need not have a module.
        module = getattr(event.data["dispatcher"].py_func, "__module__", None) or ""
        if not self.printed and module.startswith("sb3_combrel."):
            self.printed = True
            message = "sb3_combrel: compiling inner loops for this machine, once (up to a minute) ..."
            print(message, file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        pass


_announcement = _Announcement()
