"""Payloads as bytes: the base of the generated messages."""

import dataclasses
import struct
from functools import cache
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar, get_type_hints

from firmware_host.errors import DatagramError

U8 = Annotated[int, "B"]
U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
I16 = Annotated[int, "h"]
Rest = Annotated[bytes, "*"]
"""Bytes to the end of the payload; a last field."""

Reply = TypeVar("Reply", bound="WireMessage")


_ALL = 255
"""As a minor version: one that knows all that this host does."""


def _fields(message: Any) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(message)


class WireMessage:
    """Base of a message's payload; subclasses are frozen dataclasses made from `protocol.toml`.

    The annotation of a field has its `struct` code; one that a minor version of the protocol has brought has
    that as `since` in its metadata, and stands last.
    """

    @classmethod
    @cache
    def _codes(cls, minor: int = _ALL) -> dict[str, str]:
        """The `struct` code of each field that a minor version knows."""
        hints = get_type_hints(cls, include_extras=True)
        known = (f for f in _fields(cls) if f.metadata.get("since", 0) <= minor)
        return {field.name: hints[field.name].__metadata__[0] for field in known}

    @classmethod
    @cache
    def _head(cls, minor: int = _ALL) -> struct.Struct:
        """What stands before a field that takes the rest."""
        return struct.Struct("<" + " ".join(code for code in cls._codes(minor).values() if code != "*"))

    @classmethod
    def fixed_bytes(cls) -> int:
        """Length without a trailing field of any length, bytes."""
        return cls._head().size

    @classmethod
    def takes_more(cls) -> bool:
        """Whether it ends with a field of any length."""
        return "*" in cls._codes().values()

    def pack(self, minor: int = _ALL) -> bytes:
        """The payload as bytes, for a board of a minor version, or as long as it is.

        Raises:
            DatagramError: A value does not fit its field.
        """
        values: list[Any] = []
        rest = b""
        for name, code in self._codes(minor).items():
            value = getattr(self, name)
            if code == "*":
                rest = value
            elif isinstance(value, tuple):
                values += value
            else:
                if isinstance(value, bytes) and len(value) != struct.calcsize(code):
                    raise DatagramError(f"{type(self).__name__}.{name}: {len(value)} bytes")
                values.append(value)
        try:
            return self._head(minor).pack(*values) + rest
        except struct.error as fault:
            raise DatagramError(f"{type(self).__name__}: {fault}") from fault

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Read a payload; what a later minor version has added is left out, what this one has is 0.

        Raises:
            DatagramError: The length is no minor version's.
        """
        size = cls.fixed_bytes()
        if len(data) < size:
            minors = {max(0, f.metadata.get("since", 0) - 1) for f in _fields(cls)}
            if len(data) not in {cls._head(minor).size for minor in minors}:
                raise DatagramError(f"{cls.__name__}: {len(data)} bytes, expected {size}")
            data += bytes(size - len(data))
        flat = list(cls._head().unpack(data[:size]))
        values: list[Any] = []
        for code in cls._codes().values():
            if code == "*":
                values.append(bytes(data[size:]))
            elif code[:-1] and code[-1] != "s":
                count = int(code[:-1])
                values.append(tuple(flat[:count]))
                del flat[:count]
            else:
                values.append(flat.pop(0))
        return cls(*values)


class WireRequest(WireMessage, Generic[Reply]):
    """Base of a request, of the reply that it has.

    Attributes:
        TYPE: Its type byte.
        SINCE: Minor version of the protocol that brought it.
    """

    TYPE: ClassVar[int]
    SINCE: ClassVar[int] = 0

    def later(self, minor: int) -> str | None:
        """What of this request a board of an earlier minor version could not know; None if nothing."""
        if minor < self.SINCE:
            return "it"
        for field in _fields(self):
            later = field.metadata.get("since", 0) > minor
            if later and getattr(self, field.name) != field.default:
                return field.name
        return None
