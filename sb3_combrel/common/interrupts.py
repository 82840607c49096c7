"""Interrupts from the keyboard while a model learns."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Interrupts:
    """As a context, lets an interrupt wait until all within is done: half a step would leave arrays that do not fit.

    A second interrupt does not wait. Only the main thread has any.
    """

    def __init__(self) -> None:
        self._wait, self._waiting = False, list[Any]()
        self._pass_on: Any = None

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Take interrupts, which are passed on at once unless they are to wait: while a model learns."""
        self._pass_on = signal.getsignal(signal.SIGINT)
        if not callable(self._pass_on) or threading.current_thread() is not threading.main_thread():
            yield
            return
        signal.signal(signal.SIGINT, self._take)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, self._pass_on)

    def _take(self, *given: Any) -> None:
        if self._wait and not self._waiting:
            self._waiting.append(given)
        else:
            self._waiting.clear()
            self._pass_on(*given)

    def __enter__(self) -> None:
        self._wait = True

    def __exit__(self, *_: object) -> None:
        self._wait = False
        if self._waiting:
            self._pass_on(*self._waiting.pop())
