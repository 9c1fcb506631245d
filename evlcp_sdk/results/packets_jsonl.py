"""`packets.jsonl`: a line of JSON a packet, and one per message after the packet that completed it."""

import json
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from evlcp_sdk.errors import PluginError, blame
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.results.columns import list_symbols
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.values import Packet, ReceivedMessage


class PacketsJsonl(Sink):
    """Writes `packets.jsonl`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._file = folder.open("packets.jsonl")

    def packet(self, packet: Packet) -> None:
        """Write the packet's line, and those of its messages."""
        self._file.write(json.dumps(packet_line(packet, self.run.link_of(packet.link))) + "\n")
        for message in packet.messages:
            self._file.write(message_line(message) + "\n")


def decode_characters(symbols: Iterable[int | None]) -> str:
    """The text of character codes, with the replacement character for those not received.

    Bytes beyond ASCII are UTF-8 where that is valid, else Latin-1.

    >>> decode_characters([72, 105, None, 33])
    'Hi\ufffd!'
    """
    codes = [0xFFFD if symbol is None or symbol < 0 else symbol for symbol in symbols]
    if max(codes, default=0) > 0x7F and 0xFFFD not in codes and max(codes) < 256:
        with suppress(UnicodeDecodeError):
            return bytes(codes).decode()
    return "".join(map(chr, codes))


def packet_line(packet: Packet, link: Link) -> dict[str, Any]:
    """A packet's line, as JSON values; null and `?` for what was not received.

    Where the framing's symbols are characters, `text` has them.
    """
    codebook = link.codebook
    symbols: list[list[int | None] | None] = [None] * packet.sent
    width = codebook.bits_per_symbol
    unknown, mask = "?" * width, (1 << width) - 1
    bits = [unknown * codebook.clusters] * packet.sent
    for frame in packet.frames:
        decoded = symbols[frame.frame] = list_symbols(frame.soft)
        bits[frame.frame] = "".join([unknown if s is None else f"{s & mask:0{width}b}" for s in decoded])
    return {
        "kind": "packet",
        "transmitter": packet.transmitter,
        **({"link": packet.link} if packet.link else {}),
        "packet": packet.packet,
        "echo_of": packet.echo_of,
        "t_us": round(packet.t_us, 2),
        "chip_us": round(packet.chip_us, 6),
        "frames_sent": packet.sent,
        "frames_received": len(packet.frames),
        "symbols": symbols,
        "bits": "".join(bits),
        **(
            {"text": decode_characters(s[0] if s else None for s in symbols)}
            if link.characters_on_air
            else {}
        ),
    }


def message_line(received: ReceivedMessage) -> str:
    """A message's line: the keys of every message, and then those of its kind.

    Raises:
        PluginError: The kind fails, or gives a key that every message has.
    """
    message, kind = received.message, received.kind
    line: dict[str, Any] = {
        "kind": kind.name,
        "transmitter": received.transmitter,
        **({"link": received.link} if received.link else {}),
        "packet": received.packet,
        "t_us": round(received.t_us, 2),
        "transmitter_id": message.transmitter_id,
        "sequence": message.sequence,
        "verified": received.trust == "verified",
        "trust": received.trust,
        "reason": received.reason,
        "age_s": None if received.age_s is None else round(received.age_s, 6),
    }
    subject = f"message kind '{kind.name}'"
    with blame(f"{subject}: to_dict() fails"):
        content = dict(kind.to_dict(received.value))
        text = json.dumps(line | content, ensure_ascii=False)
    if duplicates := line.keys() & content.keys():
        raise PluginError(f"{subject}: to_dict() shows '{min(duplicates)}', which every message has")
    return text
