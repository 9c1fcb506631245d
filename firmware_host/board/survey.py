"""Finds boards: lists the serial ports, and sends HELLO to those that may have one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from firmware_host.board.session import Session
from firmware_host.errors import BoardError, NoBoardError
from firmware_host.ports.transport import open_transport
from firmware_host.ports.usb import BRIDGES, SerialPort, serial_ports, usb_filter
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import HelloReply


@dataclass(frozen=True)
class SurveyedPort:
    """A port, whether HELLO was sent to it, and the answer, or the reason why there is none."""

    port: SerialPort
    asked: bool
    info: HelloReply | None
    fault: str


def survey_ports(
    baud: int, usb: str | None = None, every: bool = False, ask: bool = True
) -> list[SurveyedPort]:
    """List serial ports, all or with a USB id, and send HELLO at once to those that may have a board.

    Nothing is written to a port unless its USB id is given, or that of a bridge that boards usually have, as
    any other device may be there; `every` sends to all listed ports, and without `ask` none is written to.

    Raises:
        ConfigError: It is no USB id; see `usb_filter`.
    """
    listed = serial_ports() if usb is None else list(filter(usb_filter(usb), serial_ports()))
    if not listed:
        return []

    def probe(port: SerialPort) -> SurveyedPort:
        if not ask:
            return SurveyedPort(port, False, None, "not asked")
        if not (every or usb is not None or port.usb in BRIDGES):
            return SurveyedPort(port, False, None, "no USB id of a board's bridge: not asked")
        try:
            line = open_transport(port.device, baud)
            with Session(line, Timing(baud, latency_s=0.15), tries=2) as session:
                return SurveyedPort(port, True, session.hello(), "")
        except BoardError as fault:
            return SurveyedPort(port, True, None, str(fault))

    with ThreadPoolExecutor(len(listed)) as pool:
        return list(pool.map(probe, listed))


def find_board_port(baud: int) -> str:
    """The port of the only board that answers.

    Raises:
        NoBoardError: None answers, or several do.
    """
    found = survey_ports(baud)
    boards = [f for f in found if f.info is not None]
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
