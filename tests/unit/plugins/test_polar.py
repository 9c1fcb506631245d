"""The polar code against its matrix, brute force, plain twins of its kernels and the bounds of theory."""

from functools import reduce
from itertools import product

import numpy as np
import pytest
from evlcp_polar import _kernels
from evlcp_polar.correction import Polar, discrepancy_limit, list_nodes
from evlcp_polar.sequence import RELIABILITY
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy import optimize, stats

from evlcp_sdk.air.crc import crc24
from evlcp_sdk.errors import ConfigError

Bits = NDArray[np.uint8]


def matrix(n):
    return reduce(np.kron, [[[1, 0], [1, 1]]] * (n.bit_length() - 1), np.ones((1, 1), np.int64))


def best_inputs(n, k):
    order = [i for i in RELIABILITY if i < n]
    found = np.zeros(n, bool)
    found[order[-k:]] = True
    return found


def single_nodes(information):
    """Every input by itself."""
    n = len(information)
    return np.stack([np.arange(n), np.zeros(n, np.int64), information], 1).astype(np.int64)


def decode_nodes(llr, nodes, size, limit=np.inf):
    codewords, metric = np.empty((size, len(llr)), np.uint8), np.empty(size)
    found = _kernels.list_decode(llr, nodes, size, limit, codewords, metric)
    order = np.argsort(metric[:found])
    return codewords[order], metric[order]


def discrepancy(llr, codewords):
    return (np.abs(llr) * ((llr < 0) != codewords)).sum(-1).astype(float)


def transmit(coded, bit_error_rate, rng):
    """LLRs of an AWGN channel with a hard-decision error rate."""
    sigma = -1 / stats.norm.ppf(bit_error_rate)
    return (2 * (1.0 - 2.0 * coded + sigma * rng.normal(size=len(coded))) / sigma**2).astype(np.float32)


def by_the_standard(message, length):
    """One codeword, from the text of 3GPP TS 38.212, 5.3.1.2 and 5.4.1, and docs/error-correction.md."""
    k = len(message) + 24
    n = 32
    while n < length:
        n *= 2
    pieces = [0, 1, 2, 4, 3, 5, 6, 7, 8, 16, 9, 17, 10, 18, 11, 19, 12, 20, 13, 21, 14, 22, 15, 23]
    pieces += [24, 25, 26, 28, 27, 29, 30, 31]
    interleaved = [pieces[32 * i // n] * (n // 32) + i % (n // 32) for i in range(n)]
    frozen = set()
    if 16 * k <= 7 * length:
        kept = interleaved[n - length :]
        frozen |= set(interleaved[: n - length])
        if length < n:
            early = (3 * n - 2 * length) / 4 if 4 * length >= 3 * n else (9 * n - 4 * length) / 16
            frozen |= set(range(int(np.ceil(early))))
    else:
        kept = interleaved[:length]
        frozen |= set(interleaved[length:])
    free = [i for i in RELIABILITY if i < n and i not in frozen][-k:]
    inputs = dict(zip(sorted(free), [*message, *crc24(message)], strict=True))
    return np.array([sum(int(bit) for i, bit in inputs.items() if i & j == j) % 2 for j in kept], np.uint8)


@pytest.mark.parametrize("rate", [0.15, 0.3, 0.43, 0.45, 0.5, 0.8])
def test_encoding_by_the_standard(rate):
    rng = np.random.default_rng(0)
    for length in (40, 64, 100, 130, 200, 256, 300, 640, 800, 960, 1024):
        if rate * length < 32:
            continue
        code = Polar(rate=rate).compile(length)
        message = rng.integers(0, 2, code.message_bits).astype(np.uint8)
        assert_array_equal(code.encode(message), by_the_standard(message, length))


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="a block of 63 bits, expected at least 64 at rate"):
        Polar().compile(63)
    with pytest.raises(ConfigError, match="max_list_size = 4: expected at least list_size = 8"):
        Polar(max_list_size=4)


@pytest.mark.parametrize(("length", "rate"), [(960, 0.97), (960, 0.99), (45, 0.9), (512, 0.999), (64, 0.85)])
def test_a_code_decodes_at_least_what_has_no_errors_or_is_refused(length, rate):
    """Of 960 bits, 57.6 are in reserve: 904 bits of a message leave less, and nothing would ever pass."""
    size = (int(rate * length) - 24) // 8 * 8
    if size + max(0.06 * length, np.log2(1e9)) >= length:
        with pytest.raises(ConfigError, match=rf"rate = {rate:g}: {size} bits of a message in a codeword"):
            Polar(rate=rate).compile(length)
        return
    code = Polar(rate=rate).compile(length)
    message = np.random.default_rng(length).integers(0, 2, code.message_bits).astype(np.uint8)
    found = code.decode(1 - 2 * code.encode(message).astype(np.float32))
    assert found.ok
    assert_array_equal(found.bits, message)


def twin(llr, information, size):
    """Successive-cancellation list decoding as it is defined: every LLR from the start, input by input."""

    def leaf(values, before):
        half = len(values) // 2
        if not half:
            return float(values[0])
        a, b = values[:half], values[half:]
        if len(before) < half:
            return leaf(np.sign(a) * np.sign(b) * np.minimum(np.abs(a), np.abs(b)), before)
        left = before[:half] @ matrix(half) % 2
        return leaf(b + (1 - 2 * left) * a, before[half:])

    paths = [(0.0, np.zeros(0, np.uint8))]
    for i in range(len(llr)):
        grown = []
        for metric, before in paths:
            value = leaf(llr, before)
            for bit in (0, 1) if information[i] else (0,):
                penalty = abs(value) if (value < 0) != bit else 0.0
                grown.append((metric + penalty, np.append(before, np.uint8(bit))))
        paths = sorted(grown, key=lambda path: path[0])[:size]
    return [(metric, (inputs @ matrix(len(llr)) % 2).astype(np.uint8)) for metric, inputs in paths]


@pytest.mark.parametrize("size", [1, 2, 4, 8])
@pytest.mark.parametrize(("n", "k"), [(16, 9), (32, 16), (32, 31), (64, 24), (64, 50)])
def test_list_decoding_against_its_twin(n, k, size):
    information = best_inputs(n, k)
    rng = np.random.default_rng(n + k + size)
    for mean in (0.0, 1.0):
        for _ in range(4):
            llr = rng.normal(mean, 1.0, n).astype(np.float32)
            wanted = twin(llr.astype(float), information, size)
            for nodes in (list_nodes(information.tobytes()), single_nodes(information)):
                codewords, metric = decode_nodes(llr, nodes, size)
                assert_allclose(metric, [m for m, _ in wanted], rtol=1e-4, atol=1e-5)
                assert_array_equal(codewords, [c for _, c in wanted])


@pytest.mark.parametrize(("length", "rate"), [(40, 0.9), (80, 0.4), (90, 0.4), (64, 0.5)])
def test_shortened_and_punctured_codes_against_brute_force(length, rate):
    """All 256 messages of a byte: what is decoded is the most likely one."""
    code = Polar(rate=rate, undetected=0.999, reserve=0, list_size=32).compile(length)
    assert code.message_bits == 8
    messages = np.array(list(product((0, 1), repeat=8)), np.uint8)
    codewords = np.array([code.encode(message) for message in messages])
    rng = np.random.default_rng(length)
    decided = 0
    for i in range(150):
        llr = transmit(codewords[i], 0.06 if rate > 0.5 else 0.12, rng)
        llr[rng.integers(length)] = 0
        found = code.decode(llr)
        likely = int(discrepancy(llr, codewords).argmin())
        decided += found.ok
        if found.ok:
            assert_array_equal(found.bits, messages[likely])
            wrong = (llr < 0) != codewords[likely]
            assert found.flipped == wrong[llr != 0].sum()
    assert decided > 75


def chernoff(weight, total):
    def bound(log_z):
        z = np.exp(log_z)
        return float(z * total + np.logaddexp(0, -z * weight).sum() - len(weight) * np.log(2))

    return float(optimize.minimize_scalar(bound, bounds=(-8, 8), method="bounded").fun)


@pytest.mark.parametrize("kind", ["equal", "normal", "wide", "one"])
@pytest.mark.parametrize(("n", "share"), [(40, -10.0), (256, -93.0), (960, -337.0)])
def test_the_limit_solves_the_bound(n, share, kind):
    rng = np.random.default_rng(n)
    weight = {
        "equal": np.full(n, 0.3),
        "normal": np.abs(rng.normal(4, 2, n)),
        "wide": np.exp(1.5 * rng.normal(size=n)),
        "one": np.where(np.arange(n) == 3, 1e4, 1.0),
    }[kind]
    limit = discrepancy_limit(weight, share)
    assert share - 0.051 <= chernoff(weight, limit) <= share + 1e-3
    assert_allclose(discrepancy_limit(7 * weight, share), 7 * limit, rtol=1e-6)
    padded = np.concatenate([weight, np.zeros(50)])
    assert discrepancy_limit(padded, share) == limit


def test_a_reserve_is_kept():
    """Bits without errors that are needed: 456 of the message, and 76.8 in reserve or 29.9 of a billionth."""
    message = np.random.default_rng(0).integers(0, 2, 456).astype(np.uint8)
    order = np.random.default_rng(1).permutation(960)
    for reserve, needed in ((0.08, 533), (0.0, 486)):
        code = Polar(reserve=reserve).compile(960)
        for received_bits in (needed - 1, needed, 960):
            llr = 1 - 2 * code.encode(message).astype(np.float32)
            llr[order[received_bits:]] = 0
            if received_bits < needed:
                assert not code.decode(llr).ok
            elif received_bits == 960 or reserve:
                assert code.decode(llr).ok


def test_a_scale_of_the_llrs_changes_nothing():
    code = Polar().compile(256)
    rng = np.random.default_rng(0)
    message = rng.integers(0, 2, 104).astype(np.uint8)
    llr = transmit(code.encode(message), 0.05, rng)
    for scale in (1e-20, 1.0, 1e20):
        found = code.decode(llr * np.float32(scale))
        assert found.ok
        assert_array_equal(found.bits, message)
    sure = (np.abs(llr) > 3) & ((llr < 0) == code.encode(message))
    assert_array_equal(code.decode(np.where(sure, np.inf * np.sign(llr), llr)).bits, message)


@pytest.mark.parametrize(("length", "blocks"), [(256, 1000), (960, 300)])
@pytest.mark.parametrize("bit_error_rate", [0.04, 0.06])
def test_no_message_is_lost_where_the_link_works(length, blocks, bit_error_rate):
    """Soft input; none of 1000 is a frame error rate below 3e-3 with 95 % confidence."""
    code, rng = Polar().compile(length), np.random.default_rng(0)
    for _ in range(blocks):
        message = rng.integers(0, 2, code.message_bits).astype(np.uint8)
        found = code.decode(transmit(code.encode(message), bit_error_rate, rng))
        assert found.ok
        assert_array_equal(found.bits, message)
