"""Interrupts from the keyboard while a model learns."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Interrupts:
    """Lets an interrupt wait until what a step has shown is learned: half of it would leave arrays that do not fit each other.

    A second interrupt does not wait. Only the main thread has any.
    """

    def __init__(self) -> None:
        self._wait, self._waiting = False, list[Any]()
        self._pass_on: Any = None

    @contextmanager
    def taken(self) -> Iterator[None]:
        """While a model learns: take interrupts, and pass them on at once unless they are :meth:`held`."""
        self._pass_on = signal.getsignal(signal.SIGINT)
        if not callable(self._pass_on) or threading.current_thread() is not threading.main_thread():
            yield
            return

        def take(*given: Any) -> None:
            if self._wait and not self._waiting:
                self._waiting.append(given)
            else:
                self._waiting.clear()
                self._pass_on(*given)

        signal.signal(signal.SIGINT, take)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, self._pass_on)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let an interrupt wait until all within is done."""
        self._wait = True
        try:
            yield
        finally:
            self._wait = False
            if self._waiting:
                self._pass_on(*self._waiting.pop())
