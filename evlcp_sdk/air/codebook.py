"""The codebook: preamble, pilots and codewords that transmitter and receiver share.

All codes are chips, 1 = LED on. Those of air interface 1 are pair codes (Manchester): a bipolar value b goes
on air as the chips (-b, +b), so that every value has an edge in its middle (arXiv 2510.17203, section III).
Other codes may have any chips; a camera sees their edges.
"""

import hashlib
import json
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evlcp_sdk.errors import ConfigError

AIR_INTERFACE = 1
"""Version of the built-in air interface: all codes are pair codes."""

_UNPAIRED = 2
"""Version in codebooks whose codes are not all pair codes."""

BARKER13 = (1, 1, 1, 1, 1, -1, -1, 1, 1, -1, 1, -1, 1)
"""The Barker code of length 13: all its aperiodic autocorrelation sidelobes are at most 1."""

_LONGEST_PAIR_GAP = 4
"""Most chips from rise to rise in a pair code: 01 10 01."""

_NEIGHBOURS = 256
"""Codewords after each one in which the longest gap is sought: all of most modulations."""

Values = NDArray[np.int8]
Chips = NDArray[np.uint8]

_CODES = "preamble", "pilots", "codewords"


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


def signed_hadamard(order: int) -> Values:
    """Rows of a Hadamard matrix, then the same rows inverted, int8 (2 * order, order)."""
    rows = hadamard(order)
    return np.concatenate([rows, -rows])


def pilot_values(clusters: int) -> Values:
    """Pilots of air interface 1, int8 (clusters, N): N = 8 for up to 16 clusters, then 16, 32, ..."""
    order = 8
    while 2 * order < clusters:
        order *= 2
    return signed_hadamard(order)[:clusters]


def wh4x2_values() -> Values:
    """Codewords of two words of H_4, 3 bits (sign, row) each, int8 (64, 8)."""
    words = signed_hadamard(4)
    return np.concatenate([np.repeat(words, 8, axis=0), np.tile(words, (8, 1))], axis=1)


def chips_of_values(values: ArrayLike) -> Chips:
    """Chips (1 = LED on) of bipolar values along the last axis: b becomes the pair (-b, +b).

    >>> chips_of_values([1, -1]).tolist()
    [0, 1, 1, 0]
    """
    v = np.asarray(values)
    pairs = np.stack([v < 0, v > 0], axis=-1)
    return pairs.reshape(*v.shape[:-1], -1).astype(np.uint8)


def is_pair_code(chips: ArrayLike) -> bool:
    """Whether chips along the last axis are pairs of one off and one on, in either order.

    >>> is_pair_code([0, 1, 1, 0]), is_pair_code([0, 1, 0, 0])
    (True, False)
    """
    c = np.asarray(chips)
    return c.shape[-1] % 2 == 0 and bool((c[..., 0::2] != c[..., 1::2]).all())


def find_unpaired_codes(preamble: ArrayLike, pilots: ArrayLike, codewords: ArrayLike) -> frozenset[str]:
    """Names of the codes that are not pair codes."""
    codes = zip(_CODES, (preamble, pilots, codewords), strict=True)
    return frozenset(name for name, code in codes if not is_pair_code(code))


def edges_of_chips(chips: ArrayLike) -> Values:
    """Edges from each chip to the next along the last axis: 1 on, -1 off, 0 none; int8, one fewer than chips.

    The edge before the first chip depends on what was sent before it.

    >>> edges_of_chips([0, 1, 1, 0]).tolist()
    [1, 0, -1]
    """
    c = np.asarray(chips, np.int8)
    edges: Values = c[..., 1:] - c[..., :-1]
    return edges


def longest_run(chips: ArrayLike) -> int:
    """Longest run of equal chips (n,) that are sent again and again; all where none differs.

    >>> longest_run([1, 0, 0, 1, 1])
    3
    """
    c = np.asarray(chips)
    edges = np.flatnonzero(c != np.roll(c, 1))
    return int(np.diff(edges, append=edges[0] + len(c)).max()) if len(edges) else len(c)


def word_of_chips(chips: ArrayLike) -> int:
    """Chips of one code as an integer whose most significant bit goes on air first.

    >>> f"{word_of_chips(chips_of_values([1] * 8)):04x}"
    '5555'
    """
    return int("".join(map(str, np.asarray(chips, np.uint8).tolist())), 2)


@dataclass(frozen=True, eq=False)
class Codebook:
    """The shared table of codes, in chips.

    Attributes:
        profile: Name of the info-segment profile, e.g. `wh4x2`.
        preamble: The code that finds time, uint8 (P,).
        pilots: One code a cluster, uint8 (K, N); N is 0 where none are sent.
        codewords: One code a symbol, uint8 (S, M).

    Raises:
        ConfigError: A code has chips other than 0 and 1, there is one codeword only, or two rows have the
            same edges, or the only pilot is the preamble, so that no camera could distinguish them.

    Two codebooks are equal when their digests are.

    >>> book = Codebook.of_values("demo", [1, -1], hadamard(2), hadamard(4))
    >>> book.pilots.tolist(), book.pilot_edges.tolist()
    ([[0, 1, 0, 1], [0, 1, 1, 0]], [[1, 1], [1, -1]])
    """

    profile: str
    preamble: Chips
    pilots: Chips
    codewords: Chips

    def __post_init__(self) -> None:
        for name, ndim in (("preamble", 1), ("pilots", 2), ("codewords", 2)):
            try:
                given = np.asarray(getattr(self, name))
            except (TypeError, ValueError, OverflowError):
                # An array of a shape that is refused below.
                given = np.empty(0)
            allowed = given.ndim == ndim and given.dtype.kind in "bui" and np.isin(given, (0, 1)).all()
            if not allowed or (given.size == 0 and (name != "pilots" or not len(given))):
                hint = ""
                if given.size and given.dtype.kind == "i" and np.isin(given, (-1, 1)).all():
                    hint = "; values of -1 and +1 become chips by chips_of_values"
                raise ConfigError(
                    f"codebook {name}: expected a {ndim}-D array of chips 0 and 1{hint};"
                    f" got {given.dtype} of shape {given.shape}"
                )
            if name == "codewords" and len(given) < 2:
                raise ConfigError("codebook codewords: 1 row, expected two or more")
            code = given.astype(np.uint8)
            code.setflags(write=False)
            object.__setattr__(self, name, code)
            if ndim == 2 and code.shape[1]:
                edges = edges_of_chips(code)
                _, first = np.unique(edges, axis=0, return_index=True)
                if len(first) != len(code):
                    second = next(row for row in range(len(code)) if row not in first)
                    like = int(np.flatnonzero((edges == edges[second]).all(1))[0])
                    what = "are equal" if (code[like] == code[second]).all() else "have the same edges"
                    raise ConfigError(f"codebook {name}: rows {like} and {second} {what}")
        if len(self.pilots) == 1 and np.array_equal(self.pilots[0], self.preamble):
            raise ConfigError("codebook pilots: that of the only cluster is the preamble, expected another")

    @classmethod
    def of_values(cls, profile: str, preamble: ArrayLike, pilots: ArrayLike, codewords: ArrayLike) -> Self:
        """A codebook of pair codes from bipolar values, -1 and +1, of two chips each.

        Raises:
            ConfigError: A value is neither.
        """
        codes = []
        for name, code in (("preamble", preamble), ("pilots", pilots), ("codewords", codewords)):
            values = np.asarray(code)
            if values.dtype.kind != "i" or not np.isin(values, (-1, 1)).all():
                raise ConfigError(f"codebook {name}: expected values of -1 and +1")
            codes.append(chips_of_values(values))
        return cls(profile, *codes)

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
        """Bits m that one symbol carries: symbol s < 2**m carries those of s; others carry none."""
        return len(self.codewords).bit_length() - 1

    @property
    def data_symbols(self) -> int:
        """Symbols that carry bits, 2**m: all, or the first of an alphabet whose size is no power of two."""
        return 1 << self.bits_per_symbol

    @cached_property
    def unpaired_codes(self) -> frozenset[str]:
        """Which of `preamble`, `pilots` and `codewords` are not pair codes."""
        return find_unpaired_codes(self.preamble, self.pilots, self.codewords)

    @cached_property
    def is_pair_coded(self) -> bool:
        """Whether all codes are pair codes."""
        return not self.unpaired_codes

    def require_pairs(self, role: str, name: str, other: str, codes: Collection[str] = _CODES) -> None:
        """Raise ConfigError unless the codes that an algorithm reads are pair codes.

        Args:
            role: The algorithm's role.
            name: Its id.
            other: Id of an algorithm for any codes.
            codes: Names of the codes that it reads.
        """
        for code in (name for name in codes if name in self.unpaired_codes):
            raise ConfigError(
                f"{role} '{name}' reads pair codes, chips 01 or 10 each, and the {code} are others; try"
                f" {role}.id = '{other}'"
            )

    @property
    def edge_spacing_chips(self) -> int:
        """Chips from one edge that distinguishes codes to the next; the first is after one chip."""
        return 2 if self.is_pair_coded else 1

    @property
    def trailing_chips(self) -> int:
        """Chips after a codeword up to the last edge that decoding reads: 1, but 0 for pair codes."""
        return 0 if self.is_pair_coded else 1

    @cached_property
    def pilot_edges(self) -> Values:
        """Edges of each cluster's pilot, 1 on, -1 off, 0 none, int8 (K, n).

        For a pair code these are its values, the edges in the middle of each pair, which determine those
        between pairs.
        """
        return self._edges(self.pilots)

    @cached_property
    def codeword_edges(self) -> Values:
        """Edges of each symbol's codeword, likewise, int8 (S, n)."""
        return self._edges(self.codewords)

    @cached_property
    def pilot_values(self) -> Values:
        """Values of the pilots, -1 and 1, int8 (K, n); n is 0 unless they are pair codes."""
        return _pair_values(self.pilots)

    @cached_property
    def codeword_values(self) -> Values:
        """Values of the codewords, likewise, int8 (S, n)."""
        return _pair_values(self.codewords)

    @cached_property
    def edge_chips(self) -> NDArray[np.int64]:
        """Chips of a frame right after the edges that distinguish codes, int64 (n,)."""
        pilot, info = self.pilots.shape[1], self.codewords.shape[1]
        step = self.edge_spacing_chips
        return np.concatenate([np.arange(1, pilot, step), np.arange(pilot + 1, pilot + info, step)])

    @cached_property
    def longest_gap_chips(self) -> int:
        """Most chips from one rise to the next while packets are sent.

        Four for pair codes; for others, over sequences of codewords and pilots.
        """
        if self.is_pair_coded:
            return _LONGEST_PAIR_GAP
        words = len(self.codewords)
        runs = [self.preamble]
        for pilot in self.pilots:
            runs += [pilot, self.codewords[0]]
        for offset in range(min(words, _NEIGHBOURS)):
            following = (np.arange(words) + offset) % words
            runs.append(np.concatenate([self.codewords, self.codewords[following]], axis=1).ravel())
        rises = np.flatnonzero(np.diff(np.concatenate(runs).astype(np.int8)) > 0)
        return int(np.diff(rises).max(initial=2))

    @cached_property
    def least_edge_ratio(self) -> float:
        """Edge density of the sparsest codeword, over that of the pilots; half for pair codes."""
        if self.is_pair_coded:
            return 0.5
        fewest = float(np.abs(edges_of_chips(self.codewords)).mean(1).min())
        pilots = float(np.abs(edges_of_chips(self.pilots)).mean()) if self.pilots.shape[1] > 1 else fewest
        return fewest / pilots if pilots else 1.0

    def _edges(self, chips: Chips) -> Values:
        edges = np.ascontiguousarray(edges_of_chips(chips)[..., :: self.edge_spacing_chips])
        edges.setflags(write=False)
        return edges

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the codes in canonical JSON, 64 hex digits, which both ends compare."""
        text = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """The codebook as plain lists: of values for pair codes, else of strings of chips."""
        codes: dict[str, Any] = {}
        for name in _CODES:
            code = getattr(self, name)
            if self.is_pair_coded:
                codes[name] = (code[..., 1::2].astype(int) * 2 - 1).tolist()
            else:
                codes[name] = _chip_string(code) if code.ndim == 1 else [_chip_string(row) for row in code]
        version = AIR_INTERFACE if self.is_pair_coded else _UNPAIRED
        return {"air_interface": version, "profile": self.profile, **codes}

    def to_json(self) -> str:
        """The codebook as JSON text, with its digest."""
        return json.dumps(self.to_dict() | {"digest": self.digest})

    def to_c(self) -> str:
        """The codebook as a C11 header: chip words, most significant bit first on air.

        Raises:
            ConfigError: Pilot or codeword do not fit the board's 16-chip words.
        """
        for name, code in (("pilots", self.pilots), ("codewords", self.codewords)):
            if code.shape[1] != 16:
                raise ConfigError(f"codebook {name}: {code.shape[1]} chips, the board's words have 16")

        def table(codes: Chips) -> str:
            words = [f"0x{word_of_chips(row):04x}u" for row in codes]
            rows = [", ".join(words[i : i + 8]) for i in range(0, len(words), 8)]
            return ",\n    ".join(rows)

        digest = ", ".join(f"0x{b:02x}u" for b in bytes.fromhex(self.digest))
        return "\n".join(
            [
                f"/* Codebook of air interface {AIR_INTERFACE}, profile {self.profile}."
                " Generated, do not edit. */",
                "#ifndef EVLCP_CODEBOOK_H",
                "#define EVLCP_CODEBOOK_H",
                "#include <stdint.h>",
                f"#define EVLCP_CLUSTERS {self.clusters}u",
                f"#define EVLCP_PREAMBLE_CHIPS {len(self.preamble)}u",
                f"#define EVLCP_BITS_PER_SYMBOL {self.bits_per_symbol}u",
                f"#define EVLCP_CODEWORDS {len(self.codewords)}u",
                "/* First chip on air is the most significant of the EVLCP_PREAMBLE_CHIPS bits. */",
                f"static const uint32_t evlcp_preamble = 0x{word_of_chips(self.preamble):08x}u;",
                f"static const uint16_t evlcp_pilots[{self.clusters}] = {{\n    {table(self.pilots)}}};",
                f"static const uint16_t evlcp_codewords[{len(self.codewords)}] = {{",
                f"    {table(self.codewords)}}};",
                f"static const uint8_t evlcp_digest[32] = {{\n    {digest}}};",
                "#endif",
                "",
            ]
        )


def _pair_values(chips: Chips) -> Values:
    values = edges_of_chips(chips)[:, ::2] if is_pair_code(chips) else np.empty((len(chips), 0), np.int8)
    values = np.ascontiguousarray(values)
    values.setflags(write=False)
    return values


def _chip_string(chips: Chips) -> str:
    return "".join(map(str, chips.tolist()))
