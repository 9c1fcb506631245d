"""Reed-Solomon codewords against the field's arithmetic, and what they correct."""

import numpy as np
import pytest
from evlcp_reed_solomon.correction import ReedSolomon
from numpy.testing import assert_array_equal

from evlcp_sdk.air.crc import crc24
from evlcp_sdk.errors import ConfigError


def product(a, b):
    """Of two polynomials over GF(2), modulo x^8 + x^4 + x^3 + x^2 + 1."""
    found = 0
    while b:
        if b & 1:
            found ^= a
        a <<= 1
        if a & 0x100:
            a ^= 0x11D
        b >>= 1
    return found


def at(polynomial, x):
    value = 0
    for coefficient in polynomial.tolist():
        value = product(value, x) ^ coefficient
    return value


def words_of(sent, words, data):
    return [np.concatenate([sent[w:data:words], sent[data + w :: words]]) for w in range(words)]


def message_of(bits, seed=0):
    return np.random.default_rng(seed).integers(0, 2, bits).astype(np.uint8)


def llr_of(coded):
    return (8 * (1 - 2 * coded.astype(np.float32))).astype(np.float32)


@pytest.mark.parametrize(("length", "rate"), [(256, 0.5), (960, 0.5), (2040, 0.5), (2048, 0.8), (4100, 0.3)])
def test_every_codeword_has_the_roots_of_the_generator(length, rate):
    code = ReedSolomon(rate=rate).compile(length)
    message = message_of(code.message_bits)
    coded = code.encode(message)
    size = length // 8
    words = -(-size // 255)
    data = code.message_bits // 8 + 3
    assert_array_equal(coded[: 8 * data], [*message, *crc24(message)])
    parity = (size - data) // words
    assert data / size <= rate < (data + words) / size
    for word in words_of(np.packbits(coded)[:size], words, data):
        assert len(word) <= 255
        root = 1
        for _ in range(parity):
            assert at(word, root) == 0
            root = product(root, 2)


@pytest.mark.parametrize("length", [256, 960, 2600])
def test_half_the_parity_in_wrong_bytes(length):
    """As many wrong bytes in each codeword as half its parity, as sure as the others; one more is lost."""
    code = ReedSolomon().compile(length)
    size = length // 8
    words = -(-size // 255)
    data = code.message_bits // 8 + 3
    parity = (size - data) // words
    rng = np.random.default_rng(1)
    for extra in (0, 1):
        message = message_of(code.message_bits, extra)
        sent = np.packbits(code.encode(message))
        for word in range(words):
            places = np.r_[np.arange(word, data, words), np.arange(data + word, data + words * parity, words)]
            wrong = rng.choice(places, parity // 2 + extra, replace=False)
            sent[wrong] ^= rng.integers(1, 256, len(wrong)).astype(np.uint8)
        received = np.unpackbits(sent)
        found = code.decode(llr_of(received))
        assert found.ok == (not extra)
        if not extra:
            assert_array_equal(found.bits, message)
            assert found.flipped == (received != code.encode(message)).sum()


def test_bytes_that_were_not_received_or_are_unsure():
    code = ReedSolomon().compile(960)
    message = message_of(code.message_bits)
    rng = np.random.default_rng(2)
    for count, ok in ((52, True), (53, False)):
        llr = llr_of(code.encode(message)).reshape(120, 8)
        llr[rng.choice(120, count, replace=False)] = 0
        assert code.decode(llr.ravel()).ok == ok
    llr = llr_of(code.encode(message)).reshape(120, 8)
    wrong = rng.choice(120, 50, replace=False)
    llr[wrong] *= -0.25
    found = code.decode(llr.ravel())
    assert found.ok
    assert_array_equal(found.bits, message)


def test_what_is_no_number_says_nothing():
    """As with `polar`: 40 bytes that are NaN are erased; as received ones they are too many to correct."""
    code = ReedSolomon().compile(960)
    message = message_of(code.message_bits)
    sent = np.packbits(code.encode(message))
    places = np.random.default_rng(2).permutation(120)
    sent[places[40:48]] ^= 0xFF
    llr = llr_of(np.unpackbits(sent))
    llr.reshape(120, 8)[places[:40]] = np.nan
    found = code.decode(llr)
    assert found.ok
    assert_array_equal(found.bits, message)
    assert found.flipped == 64


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="expected 4 bytes of message and CRC"):
        ReedSolomon().compile(48)
    with pytest.raises(ConfigError, match="and 8 of parity"):
        ReedSolomon(rate=0.95).compile(960)
