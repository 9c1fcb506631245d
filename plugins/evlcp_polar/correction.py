"""CRC-aided polar code."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from math import ceil, floor, inf, log
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_polar import _kernels
from evlcp_polar.sequence import RELIABILITY
from evlcp_sdk.air.crc import CRC_BITS, crc24
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Code, Corrected, ErrorCorrection

_MAX_BITS = 1024
"""Longest codeword: the reliability sequence is given for this length."""

_PIECES = (
    *(0, 1, 2, 4, 3, 5, 6, 7, 8, 16, 9, 17, 10, 18, 11, 19),
    *(12, 20, 13, 21, 14, 22, 15, 23, 24, 25, 26, 28, 27, 29, 30, 31),
)
"""Order in which the 32 pieces of a mother codeword are sent (3GPP TS 38.212, Table 5.4.1.1-1)."""

_PUNCTURED_UP_TO = 7 / 16
"""Rate up to which code bits are punctured, above which they are shortened (3GPP TS 38.212, 5.4.1.2)."""


@dataclass(frozen=True)
class Polar(ErrorCorrection):
    """CRC-aided polar code (Arikan 2009) with successive-cancellation list decoding (Tal and Vardy 2015).

    Reliability order, shortening, puncturing and CRC are those of 5G NR (3GPP TS 38.212). A block of more
    than 1024 bits is split into codewords of equal length, each with its own CRC; see
    `docs/error-correction.md`. Decoding starts with one path and goes on to `list_size` and, doubled each
    time, `max_list_size`, until a path passes.

    A path passes if its CRC holds and it explains the LLRs so well that a word of random signs would come as
    near to any codeword with a probability of `undetected` at most, and of 2**-(reserve * n) at most; both
    are proven bounds. The reserve is for words that are damaged too much: list decoding, which is not quite
    maximum likelihood, then ends among codewords next to the one sent, and each passes the CRC by 2**-24.
    """

    rate: Annotated[float, Field(gt=0, lt=1, description="Message and CRC bits a coded bit.")] = 0.5
    list_size: Annotated[int, Field(ge=1, le=128, description="Paths of the first list.")] = 8
    max_list_size: Annotated[int, Field(ge=1, le=128, description="Paths of the last list.")] = 32
    undetected: Annotated[
        float,
        Field(gt=0, lt=1, description="Probability that a codeword of noise alone is taken for a message."),
    ] = 1e-9
    reserve: Annotated[
        float,
        Field(
            ge=0, lt=1, description="Bits a coded bit that are to be received beyond those of the message."
        ),
    ] = 0.06

    def __post_init__(self) -> None:
        if self.max_list_size < self.list_size:
            raise ConfigError(
                f"error-correction.max_list_size = {self.max_list_size}:"
                f" expected at least list_size = {self.list_size}"
            )

    def compile(self, coded_bits: int) -> Code:
        """Choose the code's inputs and the bits that are sent.

        Raises:
            ConfigError: A codeword has no room for a byte beside the CRC, or for more than its message.
        """
        words = max(-(-coded_bits // _MAX_BITS), 1)
        length = coded_bits // words
        # A rate such as 0.35 has no exact double: the little more keeps 0.35 * 320 from being 111.99.
        message_bits = (int(self.rate * length + 1e-6) - CRC_BITS) // 8 * 8
        if message_bits < 8:
            need = ceil((CRC_BITS + 8) / self.rate)
            raise ConfigError(
                f"error-correction 'polar': a block of {coded_bits} bits, expected at least {need}"
                f" at rate {self.rate:g}"
            )
        # One of the 2**message_bits codewords is as likely as the other to lie near a random word.
        log_share = min(log(self.undetected), -self.reserve * length * log(2)) - message_bits * log(2)
        if -log_share >= length * log(2):
            raise ConfigError(
                f"error-correction.rate = {self.rate:g}: {message_bits} bits of a message in a codeword of"
                f" {length}, expected at most {floor(length + log_share / log(2) + message_bits)}: the rest"
                " is for error-correction.undetected and reserve"
            )
        # Seven doublings of 1 make the largest list that may be set.
        doubled = (min(self.list_size << times, self.max_list_size) for times in range(8))
        return _PolarCode(
            message_bits=words * message_bits,
            coded_bits=coded_bits,
            words=words,
            length=length,
            information=information_set(length, message_bits + CRC_BITS),
            sent=transmission_order(length, message_bits + CRC_BITS),
            punctured=_is_punctured(length, message_bits + CRC_BITS),
            list_sizes=tuple(dict.fromkeys((1, *doubled))),
            log_share=log_share,
        )


def _mother_length(length: int) -> int:
    return max(1 << (length - 1).bit_length(), len(_PIECES))


def _is_punctured(length: int, information_bits: int) -> bool:
    return length < _mother_length(length) and information_bits / length <= _PUNCTURED_UP_TO


def transmission_order(length: int, information_bits: int) -> NDArray[np.int64]:
    """Order in which code bits of the mother code are sent, int64 (length,).

    The mother code has the next power of two of bits; 3GPP TS 38.212, 5.4.1.1 and 5.4.1.2.
    """
    n = _mother_length(length)
    order = np.arange(n).reshape(len(_PIECES), -1)[list(_PIECES)].ravel()
    return order[n - length :] if _is_punctured(length, information_bits) else order[:length]


def information_set(length: int, information_bits: int) -> NDArray[np.bool_]:
    """Which inputs of the mother code carry information, bool (N,); 3GPP TS 38.212, 5.4.1.1.

    Shortened and punctured code bits are not information bits, nor are the first inputs of a punctured code;
    of the others the most reliable are chosen.
    """
    n = _mother_length(length)
    order = np.array(RELIABILITY)
    order = order[order < n]
    barred = np.ones(n, bool)
    barred[transmission_order(length, information_bits)] = False
    if _is_punctured(length, information_bits):
        early = 3 * n / 4 - length / 2 if 4 * length >= 3 * n else 9 * n / 16 - length / 4
        barred[: ceil(early)] = True
    information = np.zeros(n, bool)
    information[order[~barred[order]][-information_bits:]] = True
    return information


def discrepancy_limit(weight: NDArray[np.float64], log_share: float) -> float:
    """Largest total of flipped weights that is not an accident; negative if any total may be one.

    A word of random signs is within D of a given codeword with a probability of at most exp(z D) prod((1 +
    exp(-z w)) / 2) for every z > 0 (Chernoff). The D is found at which the least of these is
    exp(`log_share`), or a little less. The bound falls with z, and D is the mean of the tilted weights.
    """
    weight = weight[weight > 0]
    none = len(weight) * log(2)
    if none <= -log_share:
        return -1.0
    low, high, z = 0.0, inf, 2 / float(weight.mean())
    for _ in range(100):
        tilted = np.exp(-z * weight)
        share = tilted / (1 + tilted)
        total = float(weight @ share)
        bound = float(np.log1p(tilted).sum()) - none + z * total
        if log_share - 0.05 < bound <= log_share:
            return total
        low, high = (z, high) if bound > log_share else (low, z)
        slope = z * float(weight**2 @ (share * (1 - share)))
        z += (bound - log_share + 0.02) / slope if slope > 0 else inf
        if not low < z < high:
            z = (low + high) / 2 if high < inf else 2 * low
    return -1.0


def polar_transform(bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits times the Kronecker power of [[1, 0], [1, 1]], uint8 (N,); its own inverse.

    >>> polar_transform(np.array([0, 0, 0, 1], np.uint8)).tolist()
    [1, 1, 1, 1]
    """
    out, half = bits.copy(), 1
    while half < len(out):
        pairs = out.reshape(-1, 2, half)
        pairs[:, 0] ^= pairs[:, 1]
        half *= 2
    return out


@lru_cache(maxsize=16)
def list_nodes(information: bytes) -> NDArray[np.int64]:
    """List the largest nodes that are decided at once, (first input, stage, kind) of each, int64 (nodes, 3).

    `information` are the N inputs, 1 where they carry information. It takes a millisecond, while a link is
    compiled again and again.
    """
    inside = [0, *accumulate(information)]
    nodes, first = [], 0
    while first < len(information):
        stage, kind = 0, _kernels.REPEATED if information[first] else _kernels.FROZEN
        while first >> stage & 1 == 0 and first + (2 << stage) <= len(information):
            end = first + (2 << stage)
            many = inside[end] - inside[first]
            if many == 0:
                kind = _kernels.FROZEN
            elif many == 1 and information[end - 1]:
                kind = _kernels.REPEATED
            elif many == end - first:
                kind = _kernels.FREE
            else:
                break
            stage += 1
        nodes.append((first, stage, kind))
        first += 1 << stage
    return np.array(nodes, np.int64)


@dataclass(frozen=True, eq=False)
class _PolarCode:
    """A block of codewords; `log_share` is the share of random words that may be taken for one codeword."""

    message_bits: int
    coded_bits: int
    words: int
    length: int
    information: NDArray[np.bool_]
    sent: NDArray[np.int64]
    punctured: bool
    list_sizes: tuple[int, ...]
    log_share: float

    def encode(self, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if bits.shape != (self.message_bits,):
            raise ConfigError(f"message of shape {bits.shape}: expected ({self.message_bits},) bits")
        coded = np.zeros(self.coded_bits, np.uint8)
        for word, message in enumerate(bits.reshape(self.words, -1)):
            code = np.zeros(len(self.information), np.uint8)
            code[self.information] = np.concatenate([message, crc24(message)])
            coded[word * self.length : (word + 1) * self.length] = polar_transform(code)[self.sent]
        return coded

    def decode(self, llr: NDArray[np.float32]) -> Corrected:
        if llr.shape != (self.coded_bits,):
            raise ConfigError(f"LLRs of shape {llr.shape}: expected ({self.coded_bits},)")
        values = llr.astype(np.float64)
        if not np.isfinite(values).all():
            # Surer than the others, but not so much that these vanish in single precision.
            sure = 2 * np.abs(values[np.isfinite(values)]).max(initial=1.0)
            values = np.nan_to_num(values, nan=0.0, posinf=sure, neginf=-sure)
        words = values[: self.words * self.length].reshape(self.words, -1)
        message, ok, flipped = [], True, 0
        for word in words:
            codeword, inputs, passes = self._decode_word(word)
            message.append(inputs[:-CRC_BITS])
            ok &= passes
            flipped += int(((word < 0) != codeword[self.sent].astype(bool))[word != 0].sum())
        return Corrected(np.concatenate(message), ok, flipped)

    def _decode_word(self, llr: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.uint8], bool]:
        """The likeliest codeword found, its inputs, and whether it passes."""
        weight = np.abs(llr)
        mean = weight.mean()
        if mean > 0:
            weight /= mean
            llr = llr / mean
        limit = discrepancy_limit(weight, self.log_share)
        n, nodes = len(self.information), list_nodes(self.information.tobytes())
        # A shortened bit is known to be 0: surer than all that is received.
        mother = np.full(n, 0.0 if self.punctured else 4.0 * n, np.float32)
        mother[self.sent] = llr
        guess, least = np.zeros(n, np.uint8), np.inf
        for size in self.list_sizes:
            codewords = np.empty((size, n), np.uint8)
            metric = np.empty(size)
            most = np.inf if size == 1 else limit
            found = _kernels.list_decode(mother, nodes, size, most, codewords, metric)
            for path in np.argsort(metric[:found], kind="stable"):
                if metric[path] <= limit:
                    inputs = polar_transform(codewords[path])[self.information]
                    if not crc24(inputs).any():
                        return codewords[path], inputs, True
                if metric[path] < least:
                    guess, least = codewords[path], metric[path]
            # A longer list would most likely find nothing nearer.
            if limit < 0 or found == 0:
                break
        return guess, polar_transform(guess)[self.information], False
