"""What a board says of itself, as plain values with names: for people, and for JSON."""

from enum import Enum
from typing import Any

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


def about_table(about: protocol.HelloReply) -> dict[str, Any]:
    """What a board is and what it can, from its HELLO."""
    # one that does not say what a bank may hold takes words and masks
    formats = about.formats or 1 << Format.WORDS | 1 << Format.MASKS
    return {
        "hal": about.hal.rstrip(b"\0").decode("ascii", "replace"),
        "unique_id": about.unique_id.hex(),
        "firmware": f"{about.version_major}.{about.version_minor}.{about.version_patch}",
        "protocol": f"{about.major}.{about.minor}",
        **_numbers(about, "clusters", "leds", "banks", "bank_bytes"),
        "formats": [name_of(Format, n) for n in range(formats.bit_length()) if formats >> n & 1],
        **_numbers(about, "window", "max_payload", "tick_hz", "chip_rate_min_hz", "chip_rate_max_hz"),
        **_numbers(about, "clock_hz", "level_max_ma", "mean_max_ma", "burst_chips"),
        "capabilities": names_of_bits(Capability, about.capabilities),
        "key": about.key_name.hex() if any(about.key_name) else None,
        "uptime_ms": about.uptime_ms,
    }


def _numbers(reply: protocol.HelloReply | protocol.StatusReply, *names: str) -> dict[str, int]:
    """Fields that are told as they are."""
    return {name: getattr(reply, name) for name in names}


def name_of(enum: type[Enum], value: int) -> str:
    """The name of a number of the protocol; of one that this host does not know, the number."""
    try:
        return str(enum(value).name).lower()
    except ValueError:
        return str(value)


def names_of_bits(flags: type[Enum], value: int) -> list[str]:
    """Names of the bits that are set; of those that a later firmware has, the number."""
    names = [name_of(flags, 1 << n) for n in range(value.bit_length()) if value >> n & 1]
    return [f"bit {int(name):#x}" if name.isdigit() else name for name in names]


def status_table(status: protocol.StatusReply) -> dict[str, Any]:
    """What a board does, from its STATUS."""

    def bank(number: int) -> int | None:
        return None if number == NO_BANK else number

    open_leds = int.from_bytes(status.open_leds, "big")
    table: dict[str, Any] = {
        "state": name_of(State, status.state),
        "faults": names_of_bits(BoardFault, status.faults),
        "active_bank": bank(status.active_bank),
        "pending_bank": bank(status.pending_bank),
    }
    if status.active_bank != NO_BANK:
        table |= {
            "format": name_of(Format, status.format),
            "profile": name_of(Profile, status.profile),
            "frames": None if status.hold else status.frames,
            "pilot_every": None if status.hold else status.pilot_every,
            **_numbers(status, "packets", "packet_chips", "hold", "clusters", "length"),
            "crc": f"{status.crc:08x}",
        }
    return table | {
        "codebook": status.digest.hex(),
        **_numbers(status, "chip_rate_hz", "commits", "packets_sent", "chips_sent"),
        **_numbers(status, "lateness_ticks", "lateness_max_ticks"),
        **_numbers(status, "crc_errors", "framing_errors", "overflow_errors", "requests"),
        **_numbers(status, "level_ma", "level_limit_ma"),
        "duty_limit": status.duty_limit / 1000,
        "duty": status.duty / 1000,
        "temperature_c": None if status.temperature_dc == -(1 << 15) else status.temperature_dc / 10,
        "open_leds": [led for led in range(96) if open_leds >> (95 - led) & 1],
        "watchdog": name_of(Watchdog, status.watchdog),
        **_numbers(status, "watchdog_ms", "silence_ms", "uptime_ms", "pulses", "pulse_clocks"),
    }
