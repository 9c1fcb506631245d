"""The signals that ask a program to end: Ctrl-C, that of a service manager, and a terminal that closes."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["ENDING", "heard_by", "interrupt"]

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""All are answered in the same way."""

Handler = Callable[[int, FrameType | None], None]


@contextmanager
def heard_by(handler: Handler, *numbers: signal.Signals) -> Iterator[Callable[[], None]]:
    """Have a handler hear some of them; gives a function that lets those hear them again that did before.

    What somebody has set to be ignored, as `nohup` does, stays ignored, but for Ctrl-C. In a thread that
    cannot listen nothing is done.
    """
    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}

    def restore() -> None:
        while before:
            signal.signal(*before.popitem())

    try:
        if threading.current_thread() is threading.main_thread():
            for number in numbers:
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                    before[number] = signal.signal(number, handler)
        yield restore
    finally:
        restore()


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """What Python does at Ctrl-C.

    Raises:
        KeyboardInterrupt: Always.
    """
    raise KeyboardInterrupt
