"""Payloads as bytes: the base of the generated messages."""

import dataclasses
import struct
from functools import cache
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar, cast, get_type_hints

from firmware_host.errors import DatagramError

U8 = Annotated[int, "B"]
U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
I16 = Annotated[int, "h"]
Rest = Annotated[bytes, "*"]
"""Bytes to the end of the payload, as the last field."""

Reply = TypeVar("Reply", bound="WireMessage")


_LATEST = 255
"""Minor version with all fields that this host knows."""


class WireMessage:
    """Base of a message's payload; subclasses are frozen dataclasses made from `protocol.toml`.

    The annotation of a field has its `struct` code; the metadata `since` of a field that a later minor
    version added has that version, and such fields are last.
    """

    @classmethod
    @cache
    def _struct_codes(cls, minor: int = _LATEST) -> dict[str, str]:
        """The `struct` code of each field in a minor version."""
        hints = get_type_hints(cls, include_extras=True)
        known = (f for f in dataclasses.fields(cast(Any, cls)) if f.metadata.get("since", 0) <= minor)
        return {field.name: hints[field.name].__metadata__[0] for field in known}

    @classmethod
    @cache
    def _head_struct(cls, minor: int = _LATEST) -> struct.Struct:
        """The fields before one of any length."""
        return struct.Struct(
            "<" + " ".join(code for code in cls._struct_codes(minor).values() if code != "*")
        )

    @classmethod
    def min_bytes(cls) -> int:
        """Length without a last field of any length, bytes."""
        return cls._head_struct().size

    @classmethod
    def is_open_ended(cls) -> bool:
        """Whether it ends with a field of any length."""
        return "*" in cls._struct_codes().values()

    def pack(self, minor: int = _LATEST) -> bytes:
        """The payload as bytes, for a board of a minor version.

        Raises:
            DatagramError: A value does not fit its field.
        """
        values: list[Any] = []
        rest = b""
        for name, code in self._struct_codes(minor).items():
            value = getattr(self, name)
            if code == "*":
                rest = value
                continue
            if isinstance(value, bytes) and len(value) != struct.calcsize(code):
                raise DatagramError(f"{type(self).__name__}.{name}: {len(value)} bytes")
            values.append(value)
        try:
            return self._head_struct(minor).pack(*values) + rest
        except struct.error as fault:
            raise DatagramError(f"{type(self).__name__}: {fault}") from fault

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """A message from a payload; later fields are ignored, and those that an earlier version lacks are 0.

        Raises:
            DatagramError: The length is that of no minor version.
        """
        size = cls.min_bytes()
        if len(data) < size:
            minors = {max(0, f.metadata.get("since", 0) - 1) for f in dataclasses.fields(cast(Any, cls))}
            if len(data) not in {cls._head_struct(minor).size for minor in minors}:
                raise DatagramError(f"{cls.__name__}: {len(data)} bytes, expected {size}")
            data += bytes(size - len(data))
        rest = [bytes(data[size:])] if cls.is_open_ended() else []
        return cls(*cls._head_struct().unpack(data[:size]), *rest)


class WireRequest(WireMessage, Generic[Reply]):
    """Base of a request, generic in its reply.

    Attributes:
        TYPE: Its type byte.
        SINCE: Minor version of the protocol that added it.
    """

    TYPE: ClassVar[int]
    SINCE: ClassVar[int] = 0

    def find_unsupported(self, minor: int) -> str | None:
        """The field that a board of a minor version does not know, "it" for the whole request, or None."""
        if minor < self.SINCE:
            return "it"
        for field in dataclasses.fields(cast(Any, self)):
            is_later = field.metadata.get("since", 0) > minor
            if is_later and getattr(self, field.name) != field.default:
                return field.name
        return None
