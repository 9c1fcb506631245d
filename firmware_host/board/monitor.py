"""Looks at a board again and again, and finds it again when its line was gone."""

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
class Gone:
    """The board does not answer; it is looked for until it does.

    Attributes:
        fault: Why.
    """

    fault: BoardError


@dataclass(frozen=True)
class Back:
    """The board answers again.

    Attributes:
        after_s: How long it did not, s.
    """

    after_s: float


@dataclass(frozen=True)
class KeyMissing:
    """The board's watchdog acts all the same: it has a key, and this host speaks without."""


def watch(
    opened: Callable[[], AbstractContextManager[Board]],
    interval_s: float,
    count: int | None = None,
    reconnect: bool = True,
    at_first: bool = False,
    end: threading.Event | None = None,
) -> Iterator[StatusReply | Gone | Back | KeyMissing]:
    """What a board says, every `interval_s`; in between its watchdog does not act, as it hears of this host.

    A board with a key hears only of a host that has it, too; otherwise `KeyMissing` comes once.

    Args:
        opened: Opens the line to the board.
        interval_s: Time between two looks, s.
        count: End after so many.
        reconnect: Whether to look for a board that is gone, at growing intervals of at most 5 s.
        at_first: Whether to do so before it has answered for the first time, too.
        end: Ends it early, when set.

    Raises:
        BoardError: The board is gone, and not looked for.
    """
    ended = end or threading.Event()
    seen = 0
    told = False
    gone_s: float | None = None
    pause_s = _FIRST_PAUSE_S
    with ExitStack() as stack:
        board: Board | None = None
        while not ended.is_set():
            try:
                if board is None:
                    board = stack.enter_context(opened())
                status = board.status()
                if gone_s is not None:
                    yield Back(time.monotonic() - gone_s)
                gone_s, pause_s = None, _FIRST_PAUSE_S
                keyless = any(board.about.key_name) and board.session.key is None
                if keyless and status.watchdog != Watchdog.KEEP and not told:
                    told = True
                    yield KeyMissing()
                yield status
                seen += 1
                if seen == count:
                    return
                board.stay(interval_s, status)
            except (LineError, NoBoardError) as fault:
                board = None
                with contextlib.suppress(BoardError):
                    stack.close()
                if not reconnect or not (seen or at_first):
                    raise
                if gone_s is None:
                    gone_s = time.monotonic()
                    yield Gone(fault)
                ended.wait(pause_s)
                pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)
