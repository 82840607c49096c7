"""Interrupts from the keyboard, where what is half done would be of no use."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let an interrupt wait until all within is done; as a decorator, until the function is. Only the main thread has any."""
    before, waiting = signal.getsignal(signal.SIGINT), list[Any]()
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, lambda *given: waiting.append(given))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if waiting:
            before(*waiting[0])
