"""Several bars in step: a START at the same pulse of a common clock."""

import contextlib
from collections.abc import Sequence

from firmware_host.board.board import Board
from firmware_host.errors import BoardError, LineError, RefusedError
from firmware_host.protocol.generated.requests import Capability, State, Status

_ROUNDS = 20


def start_together(boards: Sequence[Board], pulse_hz: int = 1) -> list[int]:
    """Start boards at the same pulse; each stays in step with the pulses from then on.

    Boards count pulses from their own reset. Their counts belong to the same pulse if none has changed
    between two readings of all.

    Args:
        boards: The boards, dark; they must take all STARTs within half a second.
        pulse_hz: Pulses a second; must divide the chip rates.

    Returns:
        The pulse in each board's count.

    Raises:
        RefusedError: A board has no pulse input, plays, or refuses; then all are stopped.
        LineError: Pulses are faster than the boards' answers.
    """
    for board in boards:
        if not board.info.capabilities & Capability.PULSE:
            raise RefusedError(
                f"{board.session.name}: has no pulse input; 'evlcp board hello' shows what it can",
                Status.NOT_SUPPORTED,
            )
    counts = [board.status().pulses for board in boards]
    for _ in range(_ROUNDS):
        before, counts = counts, [board.status().pulses for board in boards]
        if before == counts:
            break
    else:
        raise LineError(
            f"{boards[0].session.name}: pulses come faster than the boards answer; take fewer a second"
        )
    after = max(3, -(-pulse_hz // 2))
    targets = [count + after for count in counts]
    try:
        for board, target in zip(boards, targets, strict=True):
            board.start(target, pulse_hz)
    except BoardError:
        for board in boards:
            with contextlib.suppress(BoardError):
                board.stop()
        raise
    return targets


def wait_for_pulse(boards: Sequence[Board], timeout_s: float) -> None:
    """Wait until boards that `start_together` has armed play.

    Raises:
        LineError: They do not within `timeout_s`; all are stopped.
    """
    line = boards[0].session.transport
    end = line.time_s() + timeout_s
    waiting = list(boards)
    while waiting := [board for board in waiting if board.status().state == State.WAITING]:
        if line.time_s() >= end:
            pulses = [board.status().pulses for board in waiting]
            for board in boards:
                with contextlib.suppress(BoardError):
                    board.stop()
            names = (board.session.name for board in waiting)
            counts = ", ".join(map("{} has counted {}".format, names, pulses))
            raise LineError(
                f"{waiting[0].session.name}: the pulse that it waits for has not come in {timeout_s:g} s"
                f" (pulses since reset: {counts}): check the wire of the pulse input; all are stopped"
            )
        line.read(min(0.02, max(0.0, end - line.time_s())))
