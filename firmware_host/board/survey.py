"""Finds boards: lists the serial ports, and asks HELLO of those that may have one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from firmware_host.board.session import Session
from firmware_host.errors import BoardError, NoBoardError
from firmware_host.ports.transport import open_transport
from firmware_host.ports.usb import SerialPort, UsbFilter, serial_ports
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import HelloReply

_PROBE_TRIES = 2


@dataclass(frozen=True)
class Found:
    """A port, whether anything was written to it, and the HELLO that came, or why none did."""

    port: SerialPort
    asked: bool
    about: HelloReply | None
    fault: str


def survey(
    baud: int, ports: list[SerialPort] | None = None, usb: UsbFilter | None = None, every: bool = False
) -> list[Found]:
    """List serial ports, and ask those at once that may have a board.

    A port is left alone unless its USB id is a bridge's that boards usually have: who knows what hangs
    on another.

    Args:
        baud: Line rate, bit/s.
        ports: The ports; by default all of this machine.
        usb: List and ask only ports with this USB id.
        every: Ask all that are listed.
    """
    listed = [p for p in (serial_ports() if ports is None else ports) if usb is None or usb.matches(p)]
    if not listed:
        return []

    def look(port: SerialPort) -> Found:
        if not (every or usb is not None or port.has_common_bridge):
            return Found(port, False, None, "no USB id of a board's bridge: not asked")
        try:
            line = open_transport(port.device, baud)
            with Session(line, Timing(baud, latency_s=0.15), tries=_PROBE_TRIES) as session:
                return Found(port, True, session.hello(), "")
        except BoardError as fault:
            return Found(port, True, None, str(fault))

    with ThreadPoolExecutor(len(listed)) as pool:
        return list(pool.map(look, listed))


def find(baud: int, ports: list[SerialPort] | None = None) -> str:
    """The port of the one board that answers, of those that may have one.

    Raises:
        NoBoardError: None answers, or several do.
    """
    found = survey(baud, ports)
    boards = [f for f in found if f.about is not None]
    if len(boards) == 1:
        return boards[0].port.device
    if boards:
        names = ", ".join(f.port.device for f in boards)
        raise NoBoardError(f"{len(boards)} boards answer ({names}); choose one with --port or EVLCP_PORT")
    asked, others = (", ".join(f.port.device for f in found if f.asked is which) for which in (True, False))
    raise NoBoardError(
        f"no board answers on any serial port with a USB id that boards have (asked: {asked or 'none'};"
        f" not asked: {others or 'none'});"
        " check power and cable, name its port with --port, or use --port native: for an emulated one"
    )
