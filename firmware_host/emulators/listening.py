"""Where emulators listen: a place is free, or somebody answers there."""

import socket
from pathlib import Path

from evlcp_sdk.errors import ConfigError
from firmware_host.errors import NoBoardError
from firmware_host.ports.transport import SocketTransport


def check_free(listen: str) -> None:
    """Raise ConfigError if somebody answers where an emulator is to listen; a socket left behind may be."""
    if not listen.startswith(("unix:", "tcp:")):
        return
    try:
        SocketTransport.connect(listen).close()
    except NoBoardError:
        return
    raise ConfigError(f"--listen {listen}: another program answers there; end it, or listen elsewhere")


def listener(listen: str) -> socket.socket:
    """Listen at `unix:PATH`, where a socket left behind is replaced, or `tcp:HOST:PORT`."""
    scheme, _, place = listen.partition(":")
    if scheme == "unix":
        path = Path(place)
        if path.is_socket():
            path.unlink()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        server.bind(place)
        server.listen(1)
    else:
        host, _, port = place.rpartition(":")
        server = socket.create_server((host, int(port)))
    return server
