"""The codebook: preamble, pilots and codewords that transmitter and receiver share.

All codes are bipolar values (-1, +1); a value b goes on air as the chip pair (-b, +b). See the air interface
(version 1) and arXiv 2510.17203, section III.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.errors import CodebookMismatchError, ConfigError

__all__ = ["AIR_INTERFACE", "BARKER13", "Codebook", "chips_of_values", "hadamard", "word_of_values"]

AIR_INTERFACE = 1
"""Version of the air interface that this SDK speaks."""

BARKER13 = (1, 1, 1, 1, 1, -1, -1, 1, 1, -1, 1, -1, 1)
"""The Barker code of length 13: all its aperiodic autocorrelation sidelobes are at most 1."""

Values = NDArray[np.int8]


def hadamard(order: int) -> Values:
    """Sylvester's Hadamard matrix in natural order, int8 (order, order).

    Raises:
        ConfigError: `order` is not a power of two.

    >>> hadamard(4)[3].tolist()
    [1, -1, -1, 1]
    """
    if order < 1 or order & (order - 1):
        raise ConfigError(f"Hadamard order {order}: expected a power of two")
    matrix = np.ones((1, 1), np.int8)
    while len(matrix) < order:
        matrix = np.block([[matrix, matrix], [matrix, -matrix]])
    return matrix


def chips_of_values(values: ArrayLike) -> NDArray[np.uint8]:
    """Chips (1 = LED on) of bipolar values along the last axis: b becomes the pair (-b, +b).

    >>> chips_of_values([1, -1]).tolist()
    [0, 1, 1, 0]
    """
    v = np.asarray(values)
    pairs = np.stack([v < 0, v > 0], axis=-1)
    return pairs.reshape(*v.shape[:-1], -1).astype(np.uint8)


def word_of_values(values: ArrayLike) -> int:
    """Chips of one code as an integer whose most significant bit goes on air first.

    >>> f"{word_of_values([1] * 8):04x}"
    '5555'
    """
    return int("".join(map(str, chips_of_values(values).tolist())), 2)


@dataclass(frozen=True, eq=False)
class Codebook:
    """The shared table of codes.

    Attributes:
        profile: Name of the info-segment profile, e.g. `wh4x2`.
        preamble: Barker code that finds time, int8 (P,).
        pilots: One code a cluster, int8 (K, N).
        codewords: One code a symbol, int8 (2**m, M).

    Raises:
        ConfigError: A code has other values than -1 and +1, two rows are equal, or the number of codewords
            is not a power of two.

    Two codebooks are equal when their digests are.
    """

    profile: str
    preamble: Values
    pilots: Values
    codewords: Values

    def __post_init__(self) -> None:
        for name, ndim in (("preamble", 1), ("pilots", 2), ("codewords", 2)):
            try:
                code = np.array(getattr(self, name), np.int8)
            except (TypeError, ValueError, OverflowError):
                # Of no shape that is expected below.
                code = np.empty(0, np.int8)
            if code.ndim != ndim or code.size == 0 or not np.isin(code, (-1, 1)).all():
                raise ConfigError(f"codebook {name}: expected a {ndim}-D array of -1 and +1")
            if ndim == 2 and len(np.unique(code, axis=0)) != len(code):
                raise ConfigError(f"codebook {name}: two rows are equal")
            code.setflags(write=False)
            object.__setattr__(self, name, code)
        n = len(self.codewords)
        if n & (n - 1):
            raise ConfigError(f"codebook codewords: {n} rows, expected a power of two")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Codebook) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def clusters(self) -> int:
        """Number of clusters K."""
        return len(self.pilots)

    @property
    def bits_per_symbol(self) -> int:
        """Bits m that one symbol carries."""
        return len(self.codewords).bit_length() - 1

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the codes in canonical JSON, 64 hex digits; what both ends compare."""
        text = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """The codebook as plain lists."""
        return {
            "air_interface": AIR_INTERFACE,
            "profile": self.profile,
            "preamble": self.preamble.tolist(),
            "pilots": self.pilots.tolist(),
            "codewords": self.codewords.tolist(),
        }

    def to_json(self) -> str:
        """The codebook as JSON text, with its digest."""
        return json.dumps(self.to_dict() | {"digest": self.digest})

    @classmethod
    def from_json(cls, text: str, source: Path | str = "codebook") -> Self:
        """Read what `to_json` wrote.

        Raises:
            ConfigError: The text is not JSON, or a key is missing.
            CodebookMismatchError: The air interface is another one, or the digest does not fit the codes.
        """
        try:
            table = json.loads(text)
            if table["air_interface"] != AIR_INTERFACE:
                raise CodebookMismatchError(
                    f"{source}: air_interface {table['air_interface']}, expected {AIR_INTERFACE}"
                )
            book = cls(
                table["profile"],
                np.array(table["preamble"], np.int8),
                np.array(table["pilots"], np.int8),
                np.array(table["codewords"], np.int8),
            )
            digest = table["digest"]
        except (ValueError, TypeError, OverflowError, RecursionError) as fault:
            raise ConfigError(f"{source}: not a codebook: {fault}") from fault
        except KeyError as fault:
            raise ConfigError(f"{source}: not a codebook: key {fault} is missing") from fault
        if digest != book.digest:
            raise CodebookMismatchError(f"{source}: digest {digest}, but its codes have {book.digest}")
        return book

    def to_c(self) -> str:
        """The codebook as a C11 header: chip words, most significant bit first on air.

        Raises:
            ConfigError: Pilot or codeword do not fit the board's 16-chip words.
        """
        for name, code in (("pilots", self.pilots), ("codewords", self.codewords)):
            if code.shape[1] != 8:
                raise ConfigError(f"codebook {name}: {2 * code.shape[1]} chips, the board's words have 16")

        def table(codes: Values) -> str:
            words = [f"0x{word_of_values(row):04x}u" for row in codes]
            rows = [", ".join(words[i : i + 8]) for i in range(0, len(words), 8)]
            return ",\n    ".join(rows)

        chips = chips_of_values(self.preamble)
        digest = ", ".join(f"0x{b:02x}u" for b in bytes.fromhex(self.digest))
        return "\n".join(
            [
                f"/* Codebook of air interface {AIR_INTERFACE}, profile {self.profile}."
                " Generated, do not edit. */",
                "#ifndef EVLCP_CODEBOOK_H",
                "#define EVLCP_CODEBOOK_H",
                "#include <stdint.h>",
                f"#define EVLCP_CLUSTERS {self.clusters}u",
                f"#define EVLCP_PREAMBLE_CHIPS {len(chips)}u",
                f"#define EVLCP_BITS_PER_SYMBOL {self.bits_per_symbol}u",
                f"#define EVLCP_CODEWORDS {len(self.codewords)}u",
                "/* First chip on air is the most significant of the EVLCP_PREAMBLE_CHIPS bits. */",
                f"static const uint32_t evlcp_preamble = 0x{word_of_values(self.preamble):08x}u;",
                f"static const uint16_t evlcp_pilots[{self.clusters}] = {{\n    {table(self.pilots)}}};",
                f"static const uint16_t evlcp_codewords[{len(self.codewords)}] = {{",
                f"    {table(self.codewords)}}};",
                f"static const uint8_t evlcp_digest[32] = {{\n    {digest}}};",
                "#endif",
                "",
            ]
        )
