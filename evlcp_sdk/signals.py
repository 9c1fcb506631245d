"""The signals that ask a program to end: Ctrl-C, that of a service manager, and a terminal that closes."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""All are answered in the same way."""

Handler = Callable[[int, FrameType | None], None]

Stopped = Callable[[], bool]
"""Asked after each piece of work whether to end early."""


def never() -> bool:
    """Of a run that nobody ends early."""
    return False


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


class EndRequest:
    """Whether a run was asked to end; made by `stop_on_request`, and called as a `Stopped`."""

    def __init__(self, root: "EndRequest | None" = None, also: Stopped = never) -> None:
        self._root = self if root is None else root
        self._also = also
        self._asked = self._waits = False

    def __call__(self) -> bool:
        """Whether it was asked."""
        return self._root._asked or self._also()

    def or_when(self, also: Stopped) -> "EndRequest":
        """The same request, and another reason to end."""
        return EndRequest(self._root, lambda: self._also() or also())

    def ask(self) -> None:
        """Ask it to end, now where it waits.

        Raises:
            KeyboardInterrupt: Within `waiting`.
        """
        self._root._asked = True
        if self._root._waits:
            raise KeyboardInterrupt

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Wait for something outside, which may never come: a request ends that at once.

        Raises:
            KeyboardInterrupt: The run was asked to end, before or within.
        """
        # In this order: a signal between the two ends it, too.
        self._root._waits = True
        try:
            if self._root._asked:
                raise KeyboardInterrupt
            yield
        finally:
            self._root._waits = False


@contextmanager
def stop_on_request(pass_on: Callable[[], None] = lambda: None) -> Iterator[EndRequest]:
    """Let Ctrl-C, SIGTERM or SIGHUP end a run after the piece in hand; a second one ends it at once.

    Gives what `receive_to_folder` takes as `stopped`. Only a main thread can listen.

    Args:
        pass_on: Called at the first one, to tell others.
    """
    request = EndRequest()

    def ask(_number: int, _frame: FrameType | None) -> None:
        restore()
        pass_on()
        request.ask()

    with heard_by(ask, *ENDING) as restore:
        yield request


def waiting(stopped: Stopped) -> AbstractContextManager[None]:
    """`EndRequest.waiting` of what may be one; nothing of any other `Stopped`."""
    return stopped.waiting() if isinstance(stopped, EndRequest) else nullcontext()


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """What Python does at Ctrl-C.

    Raises:
        KeyboardInterrupt: Always.
    """
    raise KeyboardInterrupt
