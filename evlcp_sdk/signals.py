"""The signals that ask a program to end: Ctrl-C, that of a service manager, and a terminal that closes."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["ENDING", "Stopped", "heard_by", "interrupt", "stop_on_request"]

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""All are answered in the same way."""

Handler = Callable[[int, FrameType | None], None]

Stopped = Callable[[], bool]
"""Asked after each piece of work whether to end early."""


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


@contextmanager
def stop_on_request(pass_on: Callable[[], None] = lambda: None) -> Iterator[Stopped]:
    """Let Ctrl-C, SIGTERM or SIGHUP end a run after the piece in hand; a second one ends it at once.

    Gives what `receive_to_folder` takes as `stopped`. Only a main thread can listen.

    Args:
        pass_on: Called at the first one, to tell others.
    """
    asked = False

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        restore()
        pass_on()

    with heard_by(ask, *ENDING) as restore:
        yield lambda: asked


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """What Python does at Ctrl-C.

    Raises:
        KeyboardInterrupt: Always.
    """
    raise KeyboardInterrupt
