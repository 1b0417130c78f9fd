"""Ctrl-C ends every command, at whatever moment it comes."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

INTERRUPTED = "helio: interrupted; files written so far are complete"
AGAIN_SECONDS = 0.05
"""Delay after which an interrupt that was lost is raised again."""


@contextmanager
def not_lost() -> Iterator[None]:
    """Raise KeyboardInterrupt again where Python drops it.

    Python raises it in whatever runs when the signal comes. In a callback of the garbage collector (JAX has one) or in
    a destructor it is dropped, reported to `sys.unraisablehook` only, and the command would go on.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return
    report = sys.unraisablehook

    def hook(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, AGAIN_SECONDS)
        else:
            report(dropped)

    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    sys.unraisablehook = hook
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        sys.unraisablehook = report
        signal.signal(signal.SIGALRM, before)
