"""Kinds of messages: the meaning of each one's payload, and its JSON values."""

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, ClassVar

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import BlockError, Kind
from evlcp_sdk.errors import ConfigError

_TIME = struct.Struct("<Q")
_COUNTDOWN = struct.Struct("<BBI")
_LAST_TIME_S = 253_402_300_800.0
_LONGEST_COUNTDOWN_S = 86_400.0


class MessageKind(ABC):
    """The meaning of a message's payload; a derived class has no state, and its objects are picklable.

    Attributes:
        number: Its number in the four bits of a block's header: 1 to 6 are built in, 7 to 15 are free.
        name: Its name in `packets.jsonl`.
    """

    number: ClassVar[int]
    name: ClassVar[str]

    @abstractmethod
    def pack(self, value: Any) -> bytes:
        """The payload for a value.

        Raises:
            ConfigError: The value cannot be encoded.
        """

    @abstractmethod
    def unpack(self, payload: bytes) -> Any:
        """The value of a payload; a message that raises is only counted, as `messages_undecodable`.

        Raises:
            BlockError: The bytes are not valid.
        """

    @abstractmethod
    def to_dict(self, value: Any) -> Mapping[str, Any]:
        """A value as JSON values for `packets.jsonl`."""


class BeaconKind(MessageKind):
    """Where a transmitter is: a `Beacon`."""

    number = Kind.BEACON
    name = "beacon"

    def pack(self, value: Beacon) -> bytes:
        """The bytes of a beacon."""
        return value.pack()

    def unpack(self, payload: bytes) -> Beacon:
        """A beacon."""
        return Beacon.unpack(payload)

    def to_dict(self, value: Beacon) -> Mapping[str, Any]:
        """Its values; the user's bytes in hex."""
        return asdict(value) | {"user": value.user.hex()}


class TextKind(MessageKind):
    """A text, in UTF-8."""

    number = Kind.TEXT
    name = "text"

    def pack(self, value: str) -> bytes:
        """The text in UTF-8."""
        return value.encode()

    def unpack(self, payload: bytes) -> str:
        """The text."""
        try:
            return payload.decode("utf-8")
        except UnicodeDecodeError as fault:
            raise BlockError(f"text: {fault}") from fault

    def to_dict(self, value: str) -> Mapping[str, Any]:
        """The text."""
        return {"text": value}


class DataKind(MessageKind):
    """Bytes of a user's own format."""

    number = Kind.DATA
    name = "data"

    def pack(self, value: bytes) -> bytes:
        """The bytes."""
        return value

    def unpack(self, payload: bytes) -> bytes:
        """The bytes."""
        return payload

    def to_dict(self, value: bytes) -> Mapping[str, Any]:
        """The bytes in hex."""
        return {"data": value.hex()}


class SignatureKind(DataKind):
    """The signature of a beacon; it is not reported by itself, but as its beacon's `trust`."""

    number = Kind.SIGNATURE
    name = "signature"


class TimeKind(MessageKind):
    """The time at which the message's first chip is on air: seconds since 1970, UTC."""

    number = Kind.TIME
    name = "time"

    def pack(self, value: float) -> bytes:
        """Eight bytes: microseconds."""
        if not 0.0 <= value < _LAST_TIME_S:
            raise ConfigError(f"time: {value!r} s, expected seconds since 1970, before the year 10000")
        return _TIME.pack(round(value * 1e6))

    def unpack(self, payload: bytes) -> float:
        """Seconds since 1970."""
        time_s = _unpack_numbers(_TIME, payload, self.name)[0] * 1e-6
        if not time_s < _LAST_TIME_S:
            raise BlockError(f"time: {time_s} s is after the year 9999")
        return float(time_s)

    def to_dict(self, value: float) -> Mapping[str, Any]:
        """The time, as seconds since 1970 and as ISO 8601 has it."""
        return {
            "time_s": value,
            "time": datetime.fromtimestamp(value, UTC).isoformat(timespec="milliseconds"),
        }


@dataclass(frozen=True)
class Countdown:
    """The time until a traffic light changes.

    Attributes:
        signal: What it shows, one of `SIGNALS`.
        next_signal: What it will show next.
        left_s: Time until then from the message's first chip, s.

    >>> CountdownKind().unpack(CountdownKind().pack(Countdown("red", "green", 12.3))).left_s
    12.3
    """

    signal: str
    next_signal: str
    left_s: float


SIGNALS = ("dark", "red", "red-amber", "amber", "green", "amber-flashing")
"""What a traffic light shows; the index is the number on air."""


class CountdownKind(MessageKind):
    """A traffic light's countdown: a `Countdown`."""

    number = Kind.COUNTDOWN
    name = "countdown"

    def pack(self, value: Countdown) -> bytes:
        """Six bytes: both signals, and milliseconds."""
        for key in ("signal", "next_signal"):
            if getattr(value, key) not in SIGNALS:
                given = getattr(value, key)
                raise ConfigError(f"countdown: {key} = {given!r}, expected one of {', '.join(SIGNALS)}")
        if not 0.0 <= value.left_s <= _LONGEST_COUNTDOWN_S:
            raise ConfigError(f"countdown: {value.left_s!r} s, expected 0 to {_LONGEST_COUNTDOWN_S:.0f}")
        numbers = SIGNALS.index(value.signal), SIGNALS.index(value.next_signal), round(value.left_s * 1e3)
        return _COUNTDOWN.pack(*numbers)

    def unpack(self, payload: bytes) -> Countdown:
        """A countdown."""
        signal, then, left_ms = _unpack_numbers(_COUNTDOWN, payload, self.name)
        if max(signal, then) >= len(SIGNALS):
            raise BlockError(f"countdown: signal {max(signal, then)}, expected 0 to {len(SIGNALS) - 1}")
        return Countdown(SIGNALS[signal], SIGNALS[then], left_ms / 1e3)

    def to_dict(self, value: Countdown) -> Mapping[str, Any]:
        """Its values."""
        return asdict(value)


def _unpack_numbers(form: struct.Struct, payload: bytes, name: str) -> tuple[int, ...]:
    if len(payload) != form.size:
        raise BlockError(f"{name} of {len(payload)} bytes, expected {form.size}")
    return form.unpack(payload)


BUILT_IN_KINDS: Mapping[int, MessageKind] = {
    kind.number: kind
    for kind in (BeaconKind(), TextKind(), DataKind(), SignatureKind(), TimeKind(), CountdownKind())
}
"""The built-in kinds by number."""


def find_kind(name: str, kinds: Mapping[int, MessageKind]) -> MessageKind:
    """The kind of messages with a name.

    Raises:
        ConfigError: There is none.
    """
    for kind in kinds.values():
        if kind.name == name:
            return kind
    raise ConfigError(
        f"no message kind named '{name}' (installed: {', '.join(sorted(k.name for k in kinds.values()))})"
    )
