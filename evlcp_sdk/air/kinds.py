"""Kinds of messages: what the payload of each means, and how it is shown."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import BlockError, Kind
from evlcp_sdk.errors import ConfigError

__all__ = [
    "BUILT_IN_KINDS",
    "BeaconKind",
    "DataKind",
    "MessageKind",
    "SignatureKind",
    "TextKind",
    "kind_named",
]


class MessageKind(ABC):
    """What the payload of a message means; a derived class has no state, and its objects are picklable.

    Attributes:
        number: What the four bits of a block's header say: 1 to 4 are built in, 5 to 15 are free.
        name: What it is called in `packets.jsonl`.
    """

    number: ClassVar[int]
    name: ClassVar[str]

    @abstractmethod
    def pack(self, value: Any) -> bytes:
        """The payload that says a value.

        Raises:
            ConfigError: The value cannot be said.
        """

    @abstractmethod
    def unpack(self, payload: bytes) -> Any:
        """What a payload says. One that raises is counted as `messages_undecodable`, and not handed on.

        Raises:
            BlockError: The bytes mean nothing.
        """

    @abstractmethod
    def to_dict(self, value: Any) -> Mapping[str, Any]:
        """What `packets.jsonl` shows of a value, as JSON values."""


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
    """Bytes that mean something to somebody else."""

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
    """The signature of a beacon; it is not handed on by itself, but with its beacon as `trust`."""

    number = Kind.SIGNATURE
    name = "signature"


BUILT_IN_KINDS: Mapping[int, MessageKind] = {
    kind.number: kind for kind in (BeaconKind(), TextKind(), DataKind(), SignatureKind())
}
"""The kinds that the format itself has, by number."""


def kind_named(name: str, kinds: Mapping[int, MessageKind]) -> MessageKind:
    """The kind of a name.

    Raises:
        ConfigError: There is none.
    """
    for kind in kinds.values():
        if kind.name == name:
            return kind
    raise ConfigError(
        f"no message kind named '{name}' (installed: {', '.join(sorted(k.name for k in kinds.values()))})"
    )
