"""The signals that ask a program to end: Ctrl-C, a service manager's, and a closing terminal's."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""All are handled alike."""

Handler = Callable[[int, FrameType | None], None]

Stopped = Callable[[], bool]
"""Called after each piece of work; true to end early."""


def never_stop() -> bool:
    """The `Stopped` of a run that nobody ends early."""
    return False


@contextmanager
def handle_signals(handler: Handler, *numbers: signal.Signals) -> Iterator[Callable[[], None]]:
    """Install a handler for these signals; gives a function that restores the previous ones.

    A signal that is ignored, as under `nohup`, stays ignored, but for Ctrl-C. Outside the main thread, which
    alone receives signals, nothing is done.
    """
    previous: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}

    def restore() -> None:
        while previous:
            signal.signal(*previous.popitem())

    try:
        if threading.current_thread() is threading.main_thread():
            for number in numbers:
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                    previous[number] = signal.signal(number, handler)
        yield restore
    finally:
        restore()


class EndRequest:
    """Whether a run was asked to end: a `Stopped` that `stop_on_request` makes."""

    def __init__(self, root: "EndRequest | None" = None, or_when: Stopped = never_stop) -> None:
        self._root = self if root is None else root
        self._or_when = or_when
        self._requested = self._waits = False

    def __call__(self) -> bool:
        """Whether the run shall end."""
        return self._root._requested or self._or_when()

    def or_when(self, condition: Stopped) -> "EndRequest":
        """The same request with another reason to end."""
        return EndRequest(self._root, lambda: self._or_when() or condition())

    def request(self) -> None:
        """Ask the run to end: at once where it waits.

        Raises:
            KeyboardInterrupt: Within `waiting`.
        """
        self._root._requested = True
        if self._root._waits:
            raise KeyboardInterrupt

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Wait for something external that may never come: a request ends it at once.

        Raises:
            KeyboardInterrupt: The run was asked to end, before or within.
        """
        # In this order, a signal between the two ends it, too.
        self._root._waits = True
        try:
            if self._root._requested:
                raise KeyboardInterrupt
            yield
        finally:
            self._root._waits = False


@contextmanager
def stop_on_request(pass_on: Callable[[], None] = lambda: None) -> Iterator[EndRequest]:
    """Let Ctrl-C, SIGTERM or SIGHUP end a run after the current piece; a second one ends it at once.

    Gives the `stopped` of `receive_to_folder`; the first signal calls `pass_on`, to notify others. Only the
    main thread receives signals.
    """
    end = EndRequest()

    def request_end(_number: int, _frame: FrameType | None) -> None:
        restore()
        pass_on()
        end.request()

    with handle_signals(request_end, *ENDING) as restore:
        yield end


def waiting(stopped: Stopped) -> AbstractContextManager[None]:
    """`EndRequest.waiting` where `stopped` is one; else nothing."""
    return stopped.waiting() if isinstance(stopped, EndRequest) else nullcontext()
