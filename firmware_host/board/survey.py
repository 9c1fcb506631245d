"""Finds boards: lists the serial ports, and asks HELLO of each."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from firmware_host.board.session import Session
from firmware_host.errors import BoardError, NoBoardError
from firmware_host.ports.transport import open_transport
from firmware_host.protocol.client import Timing
from firmware_host.protocol.requests import HelloReply

__all__ = ["Found", "ask", "find", "serial_ports", "survey"]

_PROBE_TRIES = 2


@dataclass(frozen=True)
class Found:
    """A port and what answered there.

    Attributes:
        port: Name to give to `--port`.
        description: What the operating system says of it.
        about: The board's HELLO, or None.
        fault: Why there is none.
    """

    port: str
    description: str
    about: HelloReply | None
    fault: str


def serial_ports() -> list[tuple[str, str]]:
    """Serial ports of this machine, as (device, description)."""
    from serial.tools.list_ports import comports

    return sorted((p.device, p.description) for p in comports())


def ask(port: str, baud: int, description: str = "") -> Found:
    """Say HELLO on a port, briefly."""
    try:
        with Session(open_transport(port, baud), Timing(baud, latency_s=0.15), tries=_PROBE_TRIES) as session:
            return Found(port, description, session.hello(), "")
    except BoardError as fault:
        return Found(port, description, None, str(fault))


def survey(baud: int, ports: list[tuple[str, str]] | None = None) -> list[Found]:
    """Ask every serial port at once.

    Args:
        baud: Line rate, bit/s.
        ports: (device, description) of those to ask; by default all of this machine.
    """
    listed = serial_ports() if ports is None else ports
    if not listed:
        return []
    with ThreadPoolExecutor(len(listed)) as pool:
        return list(pool.map(lambda p: ask(p[0], baud, p[1]), listed))


def find(baud: int, ports: list[tuple[str, str]] | None = None) -> str:
    """The port of the one board that answers.

    Raises:
        NoBoardError: None answers, or several do.
    """
    found = survey(baud, ports)
    boards = [f for f in found if f.about is not None]
    if len(boards) == 1:
        return boards[0].port
    if boards:
        names = ", ".join(f.port for f in boards)
        raise NoBoardError(f"{len(boards)} boards answer ({names}); choose one with --port or EVLCP_PORT")
    tried = ", ".join(f.port for f in found) or "there is none"
    raise NoBoardError(
        f"no board answers on any serial port ({tried}); check power and cable, name its port with --port,"
        " or use --port native: for an emulated one"
    )
