"""A session with every request of protocol 2.0, the same each time: what the recorded wires are of."""

import zlib

from firmware_host.board.bank import Bank
from firmware_host.board.board import Board, Settings, provision
from firmware_host.errors import RefusedError
from firmware_host.protocol.generated import requests as r

__all__ = ["every_request"]


def every_request(board: Board, bank: Bank, update: bytes) -> list[str]:
    """Say everything once; what was answered, as text.

    Args:
        board: The board, just reset.
        bank: What to play.
        update: An image of its firmware.
    """
    call = board.session.call
    told = [str(board.about.minor)]

    def say(what: object) -> None:
        told.append(str(what))

    provision(board, bank, Settings(level_ma=11, start=False, level_limit_ma=40, duty_limit=0.75))
    say(board.verify(bank))
    board.watchdog(r.Watchdog.IDLE, 60_000)
    say(board.save().slot)
    say(board.recall().slot)
    board.start()
    board.stop()
    say(board.wait_dark().level_limit_ma)
    board.blank()
    board.test_leds(0, 1, 1)
    board.wait_dark()
    try:
        board.level(41)
    except RefusedError as fault:
        say((fault.status, fault.detail))
    spare = 1 - board.status().active_bank
    digest = bytes.fromhex(bank.digest)
    slots = call(r.StreamRequest(spare, r.Format.WORDS, digest)).slots
    say(slots)
    push = call(r.PushRequest(spare, 0, 0, 0, bank.content[:64]))
    say((push.number, push.offset, push.begun))
    state = call(r.UpdateStatusRequest())
    say((state.running, state.next, state.target.rstrip(b"\0").decode()))
    call(r.UpdateBeginRequest(state.next, len(update), zlib.crc32(update)))
    say(call(r.UpdateWriteRequest(0, update)).count)
    say(call(r.UpdateCommitRequest()).sequence)
    call(r.UpdateConfirmRequest())
    call(r.UpdateRestartRequest())
    return told
