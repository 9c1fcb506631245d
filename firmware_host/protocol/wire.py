"""Payloads as bytes: the base of the generated messages."""

import dataclasses
import struct
from functools import cache, cached_property
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar, get_type_hints

from firmware_host.errors import DatagramError

U8 = Annotated[int, "B"]
U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
I16 = Annotated[int, "h"]
Rest = Annotated[bytes, "*"]
"""Bytes to the end of the payload; a last field."""

Reply = TypeVar("Reply", bound="WireMessage")


@dataclasses.dataclass(frozen=True)
class _Layout:
    """How the fields that a minor version knows stand in a payload: their `struct` codes."""

    codes: dict[str, str]

    @cached_property
    def rest(self) -> str | None:
        """The field that takes the rest."""
        return next((name for name, code in self.codes.items() if code == "*"), None)

    @cached_property
    def head(self) -> struct.Struct:
        """What stands before the rest."""
        return struct.Struct("<" + " ".join(code for code in self.codes.values() if code != "*"))


@cache
def _read_layout(message: Any, minor: int | None) -> _Layout:
    hints = get_type_hints(message, include_extras=True)
    known = (f for f in _fields(message) if minor is None or f.metadata.get("since", 0) <= minor)
    return _Layout({field.name: hints[field.name].__metadata__[0] for field in known})


def _layout(message: Any, minor: int | None = None) -> _Layout:
    """What of a message a minor version knows; without one, all."""
    return _read_layout(message, minor)


def _fields(message: Any) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(message)


class WireMessage:
    """Base of a message's payload; subclasses are frozen dataclasses made from `protocol.toml`.

    The annotation of a field has its `struct` code; one that a minor version of the protocol has brought has
    that as `since` in its metadata, and stands last.
    """

    @classmethod
    def fixed_bytes(cls) -> int:
        """Length without a trailing field of any length, bytes."""
        return _layout(cls).head.size

    @classmethod
    def takes_more(cls) -> bool:
        """Whether it ends with a field of any length."""
        return _layout(cls).rest is not None

    def pack(self, minor: int | None = None) -> bytes:
        """The payload as bytes, for a board of a minor version, or as long as it is.

        Raises:
            DatagramError: A value does not fit its field.
        """
        layout = _layout(type(self), minor)
        values: list[Any] = []
        for name, code in layout.codes.items():
            value = getattr(self, name)
            if isinstance(value, tuple):
                values += value
            elif code != "*":
                if isinstance(value, bytes) and len(value) != struct.calcsize(code):
                    raise DatagramError(f"{type(self).__name__}.{name}: {len(value)} bytes")
                values.append(value)
        try:
            head = layout.head.pack(*values)
        except struct.error as fault:
            raise DatagramError(f"{type(self).__name__}: {fault}") from fault
        return head + (getattr(self, layout.rest) if layout.rest else b"")

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Read a payload; what a later minor version has added is left out, what this one has is 0.

        Raises:
            DatagramError: The length is no minor version's.
        """
        layout, size = _layout(cls), cls.fixed_bytes()
        if len(data) < size:
            minors = {f.metadata.get("since", 0) - 1 for f in _fields(cls)}
            if len(data) not in {_layout(cls, max(0, minor)).head.size for minor in minors}:
                raise DatagramError(f"{cls.__name__}: {len(data)} bytes, expected {size}")
            data += bytes(size - len(data))
        flat = list(layout.head.unpack(data[:size]))
        values: list[Any] = []
        for code in layout.codes.values():
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
