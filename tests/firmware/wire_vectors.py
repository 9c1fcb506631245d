"""The golden wire vectors: datagrams and their bytes on the wire, read by tests of host and board.

Lines `name type status sequence session payload wire`, numbers and bytes in hex, `-` for no payload.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from firmware_host.protocol.datagram import Datagram

__all__ = ["VECTORS", "Vector", "read_vectors"]

VECTORS = Path(__file__).parents[1] / "vectors" / "wire-vectors.txt"
"""The file."""


@dataclass(frozen=True)
class Vector:
    """One line: a name, a datagram, and its bytes on the wire."""

    name: str
    datagram: Datagram
    wire: bytes


def read_vectors(path: Path = VECTORS) -> Iterator[Vector]:
    """The vectors of a file.

    Raises:
        ValueError: A line is not a vector.
    """
    for line in path.read_text(encoding="ascii").splitlines():
        if not line or line.startswith("#"):
            continue
        name, type_, status, sequence, session, payload, wire = line.split()
        numbers = (int(type_, 16), int(status, 16), int(sequence, 16), int(session, 16))
        body = b"" if payload == "-" else bytes.fromhex(payload)
        yield Vector(name, Datagram(*numbers, body), bytes.fromhex(wire))
