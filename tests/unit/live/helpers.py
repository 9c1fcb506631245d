"""What tests of live runs share."""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.link.several import name_links
from evlcp_sdk.live import Budget, Publisher
from evlcp_sdk.place.navigator import Place, Placed
from evlcp_sdk.values import Fix, Frame

LINKS = name_links(load_link())
PATIENT = Budget(waiting_ms=1e6, most_ms=1e7)
"""Nothing is left out, however slow the machine is."""


def wait_until(true: Callable[[], bool]) -> None:
    """Wait for something, as long as a machine may take that does much else."""
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def key(frame: Frame) -> tuple[Any, ...]:
    """What is the same of a frame however it was received."""
    symbols, distance = frame.soft.symbols.tolist(), repr(frame.range.distance_m)
    return frame.transmitter, frame.packet, frame.frame, frame.t_us, symbols, distance


def dies(link: socket.socket) -> None:
    """A connection is not ended, but broken off (RST), as by a process that is killed."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    link.close()


@contextmanager
def sender(
    pieces: Iterable[bytes], end: Callable[[socket.socket], None] = socket.socket.close
) -> Iterator[str]:
    """Sends pieces to who connects, and then ends in a way."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def send() -> None:
            link, _ = listening.accept()
            with link:
                for piece in pieces:
                    link.sendall(piece)
                time.sleep(0.3)
                end(link)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        thread.join(10)


def publish_fix(publisher: Publisher, t_us: float) -> None:
    """Tell listeners of a fix."""
    spread, enu_m = np.diag([0.09, 0.16, 0.25]), np.zeros(3)
    where = 35.68, 139.77, 60.0
    fix = Fix(t_us, *where, enu_m, spread, spread, 0.0, 0.0, 0.0, 0.1, (0,), verified=True, misfit=1.0)
    place = Place(t_us, *where, enu_m, spread, 5.0, 90.0, left_out=False, starts=False)
    publisher.publish("fix", t_us, Placed(fix, place))
