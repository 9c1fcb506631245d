"""Payloads as bytes: the base of the generated messages."""

import dataclasses
import struct
from functools import cache
from typing import Any, ClassVar, Self

from firmware_host.errors import DatagramError


@cache
def _packer(codes: str) -> struct.Struct:
    return struct.Struct("<" + codes)


def _count(code: str) -> int:
    """How many values a field takes: an array several, bytes one."""
    return 1 if code.endswith("s") else int(code[:-1] or 1)


class WireMessage:
    """Base of a message's payload; subclasses are frozen dataclasses made from `protocol.toml`.

    Attributes:
        TYPE: Type byte of the request the payload belongs to.
        LAYOUT: The `struct` code of each field, apart by blanks; `*` is the rest.
        SINCE: Minor version of the protocol that brought the message.
        FIELD_SINCE: The same of fields that came after the message; they are its last.
    """

    TYPE: ClassVar[int]
    LAYOUT: ClassVar[str]
    SINCE: ClassVar[int] = 0
    FIELD_SINCE: ClassVar[dict[str, int]] = {}

    @classmethod
    def fixed_bytes(cls) -> int:
        """Length without a trailing field of any length, bytes."""
        return _packer(cls.LAYOUT.rstrip("*")).size

    @classmethod
    def _lengths(cls) -> list[int]:
        """Lengths of the payload in each minor version that changed it, bytes."""
        codes = cls.LAYOUT.rstrip("*").split()
        later = list(cls.FIELD_SINCE.values())
        return [
            _packer(" ".join(codes[: len(codes) - sum(since > minor for since in later)])).size
            for minor in sorted({0, *later})
        ]

    def later(self, minor: int) -> str | None:
        """What of this message a board of an earlier minor version could not know; None if nothing."""
        if minor < self.SINCE:
            return "it"
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            since = self.FIELD_SINCE.get(field.name, 0)
            if since > minor and getattr(self, field.name) != field.default:
                return field.name
        return None

    def pack(self, minor: int | None = None) -> bytes:
        """The payload as bytes, for a board of a minor version, or as long as it is.

        Raises:
            DatagramError: A value does not fit its field.
        """
        values: list[Any] = []
        rest = b""
        later = self.FIELD_SINCE.values() if minor is not None else ()
        codes = self.LAYOUT.split()
        codes = codes[: len(codes) - sum(since > (minor or 0) for since in later)]
        for code, field in zip(codes, dataclasses.fields(self), strict=False):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if code == "*":
                rest = value
            elif _count(code) > 1:
                values += value
            else:
                if isinstance(value, bytes) and len(value) != struct.calcsize(code):
                    raise DatagramError(f"{type(self).__name__}.{field.name}: {len(value)} bytes")
                values.append(value)
        try:
            head = _packer(" ".join(codes).rstrip("*")).pack(*values)
        except struct.error as fault:
            raise DatagramError(f"{type(self).__name__}: {fault}") from fault
        return head + rest

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Read a payload; what a later minor version has added is left out, what this one has is 0.

        Raises:
            DatagramError: The length is no minor version's.
        """
        size = cls.fixed_bytes()
        if len(data) < size:
            if len(data) not in cls._lengths():
                raise DatagramError(f"{cls.__name__}: {len(data)} bytes, expected {size}")
            data += bytes(size - len(data))
        flat = iter(_packer(cls.LAYOUT.rstrip("*")).unpack(data[:size]))
        values: list[Any] = []
        for code in cls.LAYOUT.split():
            if code == "*":
                values.append(bytes(data[size:]))
            elif (count := _count(code)) > 1:
                values.append(tuple(next(flat) for _ in range(count)))
            else:
                values.append(next(flat))
        return cls(*values)
