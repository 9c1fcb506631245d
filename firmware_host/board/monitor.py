"""Polls a board's status, and reconnects when its line was lost."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass

from firmware_host.board.board import Board
from firmware_host.errors import BoardError, LineError, NoBoardError
from firmware_host.protocol.generated.requests import StatusReply, Watchdog

_FIRST_PAUSE_S = 0.25
_LONGEST_PAUSE_S = 5.0


@dataclass(frozen=True)
class BoardReturned:
    """The board answers again.

    Attributes:
        after_s: Time without an answer, s.
    """

    after_s: float


@dataclass(frozen=True)
class KeyMissing:
    """The board's watchdog acts nevertheless: the board has a key, and this host does not use it."""


def watch_board(
    open_board: Callable[[], AbstractContextManager[Board]],
    interval_s: float,
    count: int | None = None,
    reconnect: bool = True,
    at_first: bool = False,
    end: threading.Event | None = None,
) -> Iterator[StatusReply | BoardError | BoardReturned | KeyMissing]:
    """Yield a board's status every `interval_s`, and keep its watchdog from acting in between.

    Only a host with the board's key can do that; without it `KeyMissing` is yielded once.

    Args:
        open_board: Opens the line to the board.
        interval_s: Time between two requests for the status, s.
        count: Number of statuses; None for no end.
        reconnect: Whether to reconnect to a lost board, at growing intervals of at most 5 s.
        at_first: Whether to try again before the board has answered once, too.
        end: Ends it early, when set.

    Raises:
        BoardError: The board is lost, and `reconnect` is False.
    """
    ended = end or threading.Event()
    yielded = 0
    has_warned = False
    lost_s: float | None = None
    pause_s = _FIRST_PAUSE_S
    with ExitStack() as stack:
        board: Board | None = None
        while not ended.is_set():
            try:
                if board is None:
                    board = stack.enter_context(open_board())
                status = board.status()
                if lost_s is not None:
                    yield BoardReturned(time.monotonic() - lost_s)
                lost_s, pause_s = None, _FIRST_PAUSE_S
                keyless = any(board.info.key_name) and board.session.key is None
                if keyless and status.watchdog != Watchdog.KEEP and not has_warned:
                    has_warned = True
                    yield KeyMissing()
                yield status
                yielded += 1
                if yielded == count:
                    return
                board.wait_with_keep_alive(interval_s, status, ended.is_set)
            except (LineError, NoBoardError) as fault:
                board = None
                with contextlib.suppress(BoardError):
                    stack.close()
                if not reconnect or not (yielded or at_first):
                    raise
                if lost_s is None:
                    lost_s = time.monotonic()
                    yield fault
                ended.wait(pause_s)
                pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)
