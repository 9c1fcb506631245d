"""The transmitter's modules for commands, each imported at its first use, as `cli._sdk` does."""

# ruff: noqa: F401
# mypy: implicit-reexport

from typing import TYPE_CHECKING

from evlcp_sdk.lazy import find_module

if TYPE_CHECKING:
    from firmware_host import build, flicker, images, loop
    from firmware_host.board import (
        bank,
        board,
        fleet,
        keys,
        messages,
        monitor,
        session,
        step,
        stream,
        survey,
        symbols,
        tables,
        update,
    )
    from firmware_host.emulators import led_record, listening, models, native, opening
    from firmware_host.ports import rom, transport
    from firmware_host.protocol import client, seal
    from firmware_host.protocol.generated import requests
else:
    __getattr__ = find_module(
        {
            "firmware_host": "build flicker images loop",
            "firmware_host.board": "bank board fleet keys messages monitor session step "
            "stream survey symbols tables update",
            "firmware_host.emulators": "led_record listening models native opening",
            "firmware_host.ports": "rom transport",
            "firmware_host.protocol": "client seal",
            "firmware_host.protocol.generated": "requests",
        }
    )
