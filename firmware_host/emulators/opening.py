"""Ports by name, emulators among them.

`native:` (`native:FILE` keeps its flash) starts an emulator that ends with the line; other names are ports of
`firmware_host.ports.transport`.
"""

from pathlib import Path

from firmware_host.emulators.native import NativeBoard
from firmware_host.ports.transport import Transport, open_transport
from firmware_host.protocol.generated.requests import DEFAULT_BAUD


def open_port(spec: str, baud: int = DEFAULT_BAUD) -> Transport:
    """Open a port, or start an emulator, by its name.

    Raises:
        InputError: The emulator's flash file cannot be used.
        NoBoardError: The port cannot be opened.
        ToolchainError: The emulator cannot be built.
    """
    scheme, _, rest = spec.partition(":")
    if scheme == "native":
        return NativeBoard(flash=Path(rest) if rest else None)
    return open_transport(spec, baud)
