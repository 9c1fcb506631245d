"""Payloads as bytes: the base of the generated messages."""

import dataclasses
import struct
from functools import cache
from typing import Any, ClassVar, Self

from firmware_host.errors import DatagramError

__all__ = ["WireMessage"]


@cache
def _packer(codes: str) -> struct.Struct:
    return struct.Struct("<" + codes)


class WireMessage:
    """Base of a message's payload; subclasses are frozen dataclasses made from `protocol.toml`.

    Attributes:
        TYPE: Type byte of the request the payload belongs to.
        LAYOUT: Per field its `struct` code and how many values it takes; the code `*` is the rest.
    """

    TYPE: ClassVar[int]
    LAYOUT: ClassVar[tuple[tuple[str, int], ...]]

    @classmethod
    def fixed_bytes(cls) -> int:
        """Length without a trailing field of any length, bytes."""
        return _packer("".join(code for code, _ in cls.LAYOUT if code != "*")).size

    def pack(self) -> bytes:
        """The payload as bytes.

        Raises:
            DatagramError: A value does not fit its field.
        """
        values: list[Any] = []
        rest = b""
        for (code, count), field in zip(self.LAYOUT, dataclasses.fields(self), strict=True):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if code == "*":
                rest = value
            elif count > 1:
                values += value
            else:
                if isinstance(value, bytes) and len(value) != struct.calcsize(code):
                    raise DatagramError(f"{type(self).__name__}.{field.name}: {len(value)} bytes")
                values.append(value)
        try:
            head = _packer("".join(code for code, _ in self.LAYOUT if code != "*")).pack(*values)
        except struct.error as fault:
            raise DatagramError(f"{type(self).__name__}: {fault}") from fault
        return head + rest

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Read a payload.

        Raises:
            DatagramError: The length is not the message's.
        """
        size = cls.fixed_bytes()
        open_ended = bool(cls.LAYOUT) and cls.LAYOUT[-1][0] == "*"
        if len(data) < size or (len(data) > size and not open_ended):
            raise DatagramError(f"{cls.__name__}: {len(data)} bytes, expected {size}")
        flat = iter(_packer("".join(code for code, _ in cls.LAYOUT if code != "*")).unpack(data[:size]))
        values: list[Any] = []
        for code, count in cls.LAYOUT:
            if code == "*":
                values.append(bytes(data[size:]))
            elif count > 1:
                values.append(tuple(next(flat) for _ in range(count)))
            else:
                values.append(next(flat))
        return cls(*values)
