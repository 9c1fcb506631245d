"""HELLO and STATUS of a board as tables of plain values."""

from enum import Enum
from typing import Any

from evlcp_sdk.formatting import escape_controls
from firmware_host.protocol.generated import requests as protocol
from firmware_host.protocol.generated.requests import (
    NO_BANK,
    BoardFault,
    Capability,
    Format,
    Profile,
    State,
    Watchdog,
)


def info_table(info: protocol.HelloReply) -> dict[str, Any]:
    """The board's identity and abilities from its HELLO."""
    # firmware that does not list its formats takes words and masks
    formats = info.formats or 1 << Format.WORDS | 1 << Format.MASKS
    return {
        "hal": escape_controls(info.hal.rstrip(b"\0").decode("ascii", "replace")),
        "unique_id": info.unique_id.hex(),
        "firmware": f"{info.version_major}.{info.version_minor}.{info.version_patch}",
        "protocol": f"{info.major}.{info.minor}",
        **_copy_fields(info, "clusters", "leds", "banks", "bank_bytes"),
        "formats": [enum_name(Format, n) for n in range(formats.bit_length()) if formats >> n & 1],
        **_copy_fields(info, "window", "max_payload", "tick_hz", "chip_rate_min_hz", "chip_rate_max_hz"),
        **_copy_fields(info, "clock_hz", "level_max_ma", "mean_max_ma", "burst_chips"),
        "capabilities": flag_names(Capability, info.capabilities),
        "key": info.key_name.hex() if any(info.key_name) else None,
        "uptime_ms": info.uptime_ms,
    }


def _copy_fields(reply: protocol.HelloReply | protocol.StatusReply, *names: str) -> dict[str, int]:
    return {name: getattr(reply, name) for name in names}


def enum_name(enum: type[Enum], value: int) -> str:
    """The name of a number of the protocol, or the number itself if this host does not know it."""
    return next((member.name.lower() for member in enum if member.value == value), str(value))


def flag_names(flags: type[Enum], value: int) -> list[str]:
    """Names of the bits that are set, or numbers for those of a later firmware."""
    names = [enum_name(flags, 1 << n) for n in range(value.bit_length()) if value >> n & 1]
    return [f"bit {int(name):#x}" if name.isdigit() else name for name in names]


def status_table(status: protocol.StatusReply) -> dict[str, Any]:
    """The board's state from its STATUS."""

    def bank(number: int) -> int | None:
        return None if number == NO_BANK else number

    open_leds = int.from_bytes(status.open_leds, "big")
    table: dict[str, Any] = {
        "state": enum_name(State, status.state),
        "faults": flag_names(BoardFault, status.faults),
        "active_bank": bank(status.active_bank),
        "pending_bank": bank(status.pending_bank),
    }
    if status.active_bank != NO_BANK:
        table |= {
            "format": enum_name(Format, status.format),
            "profile": enum_name(Profile, status.profile),
            "frames": None if status.hold else status.frames,
            "pilot_every": None if status.hold else status.pilot_every,
            **_copy_fields(status, "packets", "packet_chips", "hold", "clusters", "length"),
            "crc": f"{status.crc:08x}",
        }
    return table | {
        "codebook": status.digest.hex(),
        **_copy_fields(status, "chip_rate_hz", "commits", "packets_sent", "chips_sent"),
        **_copy_fields(status, "lateness_ticks", "lateness_max_ticks"),
        **_copy_fields(status, "crc_errors", "framing_errors", "overflow_errors", "requests"),
        **_copy_fields(status, "level_ma", "level_limit_ma"),
        "duty_limit": status.duty_limit / 1000,
        "duty": status.duty / 1000,
        "temperature_c": None if status.temperature_dc == -(1 << 15) else status.temperature_dc / 10,
        "open_leds": [led for led in range(96) if open_leds >> (95 - led) & 1],
        "watchdog": enum_name(Watchdog, status.watchdog),
        **_copy_fields(status, "watchdog_ms", "silence_ms", "uptime_ms", "pulses", "pulse_clocks"),
    }
