"""Updates of a board's firmware over its line: on trial first, with a fallback if it does not start."""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from evlcp_sdk.errors import InputError
from evlcp_sdk.files import read_json
from firmware_host import build
from firmware_host.board.board import Board, Progress
from firmware_host.board.tables import info_table
from firmware_host.errors import BoardError, IncompatibleError, LineError, RefusedError, VerifyError
from firmware_host.images import FlashImage
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import Capability, Status

_NO_UPDATE = (
    "not a firmware update, or damaged; expected TARGET.update.json, as 'evlcp board build' makes it"
    " ('evlcp board flash' takes .bin, .hex and .elf)"
)


@dataclass(frozen=True)
class UpdatePackage:
    """A firmware, linked for both places of updates.

    Attributes:
        target: Part and crystal.
        images: The images for places 1 and 2.
    """

    target: str
    images: Mapping[int, bytes]

    @classmethod
    def build(cls, target: str) -> Self:
        """Build the firmware for a target, such as `stm32f405-8mhz`.

        Raises:
            ToolchainError: The cross compiler is missing, or fails.
        """
        return cls(target, {n: FlashImage.read(build.arm_image(f"{target}-{n}")).data for n in (1, 2)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file with the text of `to_json`.

        Raises:
            InputError: It cannot be read, or is no such file.
        """
        try:
            table = read_json(path)
            images = {n: base64.b64decode(table["images"][str(n)], validate=True) for n in (1, 2)}
            crcs = [zlib.crc32(images[n]) for n in (1, 2)]
            is_valid = table["evlcp_update"] == 1 and crcs == table["crc32"] and all(images.values())
            if not is_valid or not isinstance(table["target"], str):
                raise ValueError
        except (InputError, KeyError, TypeError, ValueError) as fault:
            if isinstance(fault.__cause__, OSError):
                raise
            raise InputError(f"{path}: {_NO_UPDATE}") from fault
        return cls(table["target"], images)

    def to_json(self) -> str:
        """The package as the text of a file."""
        table = {
            "evlcp_update": 1,
            "target": self.target,
            "crc32": [zlib.crc32(self.images[n]) for n in (1, 2)],
            "images": {str(n): base64.b64encode(self.images[n]).decode() for n in (1, 2)},
        }
        return json.dumps(table, indent=1) + "\n"


@dataclass(frozen=True)
class UpdateResult:
    """The result of an update.

    Attributes:
        image: The running image, 1 or 2.
        length: Its bytes.
        sequence: Number of the update.
        firmware: Version of the running firmware.
    """

    image: int
    length: int
    sequence: int
    firmware: str


def update_status(board: Board) -> protocol.UpdateStatusReply:
    """State of the firmware's images.

    Raises:
        RefusedError: The board takes no updates.
    """
    if not board.info.capabilities & Capability.UPDATE:
        raise RefusedError(
            f"{board.session.name}: takes no updates over its line; 'evlcp board flash' instead",
            Status.NOT_SUPPORTED,
        )
    return board.session.call(protocol.UpdateStatusRequest())


def confirm_update(board: Board) -> None:
    """End the trial of the running image and keep it."""
    board.session.call(protocol.UpdateConfirmRequest())


def update_firmware(
    board: Board,
    package: UpdatePackage,
    progress: Progress = lambda *_: None,
    keep: bool = True,
    wait_s: float = 10.0,
) -> UpdateResult:
    """Write another firmware to a dark board, restart it, and keep the firmware once it answers.

    Until then, and without `keep`, it is on trial: at the third reset the board goes back to the previous
    one, which any failure leaves intact. `wait_s` is the longest time for the restart.

    Raises:
        IncompatibleError: The firmware is for another board.
        RefusedError: The LEDs are not dark, or an image is on trial.
        VerifyError: The board does not hold what was sent, or went back to another image.
        LineError: The line fails.
    """
    session = board.session
    before = update_status(board)
    target = before.target.rstrip(b"\0").decode("ascii", "replace")
    if target != package.target:
        raise IncompatibleError(f"{session.name}: is a {target}, the firmware is for {package.target}")
    if before.trial:
        raise RefusedError(
            f"{session.name}: image {before.running} runs on trial; keep it first, 'evlcp board update"
            " --confirm', or reset the board until it has left it",
            Status.BUSY,
        )
    if before.next not in package.images:
        raise IncompatibleError(f"{session.name}: image {before.next} is its next, expected 1 or 2")
    data = package.images[before.next]
    if len(data) > before.capacity:
        raise RefusedError(
            f"{session.name}: {len(data)} bytes of firmware, an image may have {before.capacity}",
            Status.OUT_OF_RANGE,
        )
    session.call(protocol.UpdateBeginRequest(before.next, len(data), zlib.crc32(data)))
    piece = (session.max_payload - protocol.UpdateWriteRequest.min_bytes()) // 4 * 4

    done = 0

    def handle(request: protocol.UpdateWriteRequest, _: protocol.UpdateWriteReply) -> None:
        nonlocal done
        done += len(request.data)
        progress(done, len(data))

    pieces = (protocol.UpdateWriteRequest(at, data[at : at + piece]) for at in range(0, len(data), piece))
    try:
        session.call_each(pieces, handle)
        sequence = session.call(protocol.UpdateCommitRequest()).sequence
    except LineError as fault:
        raise type(fault)(
            f"{fault}; it begins anew, and the board keeps the firmware that it runs"
        ) from fault
    _restart_board(board, wait_s)
    after = update_status(board)
    if after.running != before.next:
        raise VerifyError(
            f"{session.name}: runs image {after.running}, expected {before.next}: the new firmware did not"
            " start; the board went back"
        )
    if keep:
        confirm_update(board)
    return UpdateResult(after.running, len(data), sequence, info_table(board.info)["firmware"])


def _restart_board(board: Board, wait_s: float) -> None:
    """Restart the board, and send HELLO until it answers with its count of requests reset."""
    session, line = board.session, board.session.transport
    requests = board.status().requests
    session.call(protocol.UpdateRestartRequest())
    begin = line.time_s()
    # a slow board gets longer
    end = begin + wait_s + 20 * session.client.latency_s
    while line.time_s() < begin + 0.1:  # the answer is out, and the reset under way
        line.read(0.02)
    while True:
        try:
            line.read(0.02)
            board.info = session.hello()
            if board.status().requests < requests:
                return
        except BoardError:
            if line.time_s() > end:
                raise
        else:
            if line.time_s() > end:
                raise VerifyError(f"{session.name}: has not been reset; run the command again")
