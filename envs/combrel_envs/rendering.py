"""dm_control with or without OpenGL: the choice of a rendering backend, and a clear error if there is none."""

import contextlib
import ctypes
import importlib
import os
import sys
from typing import Any

_ADVICE = (
    "Rendering needs OpenGL, and none could be started (MUJOCO_GL={gl!r}: {reason}). "
    "On a machine without a display install Mesa's EGL (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri) "
    "and set MUJOCO_GL=egl before Python starts, or install libosmesa6 and set MUJOCO_GL=osmesa."
)
_FORKED = (
    "Rendering hangs in a process that was forked after its parent had drawn: start workers by spawn or forkserver, such as "
    "multiprocessing.get_context('spawn'), SubprocVecEnv(..., start_method='spawn') or AsyncVectorEnv(..., context='spawn')."
)
#: Why OpenGL doesn't start in this process, once that is known.
_failure: Exception | None = None
#: The process in which it has started.
_started_in: int | None = None


class RenderingError(RuntimeError):
    """No picture can be drawn, because OpenGL is missing, doesn't start, or was started before the process was forked."""


def import_dm_control() -> None:
    """Import dm_control; call this before the first import of it.

    dm_control reads ``MUJOCO_GL`` when it is imported, and fails at once if that backend doesn't start. It is then imported
    without a renderer, and the error raised when a picture is requested. Without a display EGL is the default on Linux, unless
    set.
    """
    global _failure
    if "dm_control.mujoco" in sys.modules:
        return
    chosen = os.environ.get("MUJOCO_GL")
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if chosen is None and sys.platform.startswith("linux") and not has_display:
        os.environ["MUJOCO_GL"] = _headless_backend()
    _import_triton()
    try:
        importlib.import_module("dm_control.mujoco")
    except Exception as error:
        # The kind of exception depends on backend and driver: ImportError, AttributeError and RuntimeError all occur.
        if isinstance(error, ModuleNotFoundError) and error.name in ("dm_control", "mujoco"):
            advice = f"{error.name} is missing; install it with pip install 'sb3-combrel[envs]'"
            raise ModuleNotFoundError(advice, name=error.name) from error
        _failure = error
        _import_without_renderer(chosen)


def open_gl(physics: Any) -> None:
    """Start OpenGL for a ``dm_control.mujoco.Physics``, if it isn't started; a RenderingError says what to install or set."""
    global _failure, _started_in
    if _started_in not in (None, os.getpid()):
        raise RenderingError(_FORKED)
    # No second attempt after a failure: with some drivers it ends the process.
    if _failure is None:
        try:
            _ = physics.contexts
            _started_in = os.getpid()
        except Exception as error:
            # Smaller pictures can be drawn in this process.
            if "framebuffer is not complete" in str(error):
                size = physics.model.vis.global_
                raise RenderingError(
                    f"width and height must be smaller: {size.offwidth} x {size.offheight} pixels are too many here ({error})"
                ) from error
            _failure = error
    if _failure is not None:
        raise RenderingError(_ADVICE.format(gl=os.environ.get("MUJOCO_GL"), reason=_failure)) from _failure


def _import_triton() -> None:
    """Import triton, if there, before Mesa: each has an LLVM, and PyTorch, importing it after Mesa's, ends the process."""
    # It is often not installed; where it is broken, PyTorch reports that itself.
    with contextlib.suppress(Exception):
        importlib.import_module("triton")


def _headless_backend() -> str:
    for backend, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        with contextlib.suppress(OSError):
            ctypes.CDLL(library)
            return backend
    return "disable"


def _import_without_renderer(chosen: str | None) -> None:
    os.environ["MUJOCO_GL"] = "disable"
    try:
        importlib.import_module("dm_control.mujoco")
    finally:
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen
