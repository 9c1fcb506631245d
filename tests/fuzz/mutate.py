"""Bytes and texts, damaged as wires, disks and strangers damage them."""

import re

ODD_NUMBERS = (
    *("0", "-1", "1e308", "-1e308", "1e-308", "nan", "inf", "9" * 400, "99999999999999999999", "0x10", "1_0"),
    *("-0.0", "2147483648", "9223372036854775807", "1e9", "", "true", "null", '""', "[]", "{}"),
)

ODD_BYTES = (
    b"",
    b"\x00",
    b"\xff" * 8,
    b"\x00" * 64,
    b"\n",
    b"%",
    b"\xef\xbb\xbf",
    b"\xff\x7f\x00\x80",
    b"PK\x03\x04",
)

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def damage(data, rng):
    """The bytes after one to four accidents."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_ACCIDENTS)(data, rng)
    return data


def _flip(data, rng):
    if not data:
        return data
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]


def _write(data, rng):
    at = rng.randrange(len(data) + 1)
    odd = rng.choice(ODD_BYTES)
    return data[:at] + odd + data[at + len(odd) :]


def _insert(data, rng):
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 2, 3, 16))) + data[at:]


def _delete(data, rng):
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.choice((1, 2, 4, 100, 4096)) :]


def _cut(data, rng):
    return data[: rng.randrange(len(data) + 1)]


def _repeat(data, rng):
    at = rng.randrange(len(data) + 1)
    part = data[at : at + rng.choice((1, 8, 64, 512))]
    return data[:at] + part * rng.choice((2, 3, 50)) + data[at + len(part) :]


def _swap(data, rng):
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    c = rng.randrange(b, len(data) + 1)
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _number(data, rng):
    """A number of a text, where there is one, becomes an odd one."""
    found = list(_NUMBER.finditer(data[:200_000]))
    if not found:
        return _flip(data, rng)
    start, end = rng.choice(found).span()
    return data[:start] + rng.choice(ODD_NUMBERS).encode() + data[end:]


_ACCIDENTS = (_flip, _write, _insert, _delete, _cut, _repeat, _swap, _number)
