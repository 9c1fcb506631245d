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


def evaluate(polynomial, x):
    value = 0
    for coefficient in polynomial.tolist():
        value = product(value, x) ^ coefficient
    return value


def coded_message(length=960, seed=0, **parameters):
    """A code, a message, its coded bits, and where the bytes of each codeword are, data and parity."""
    code = ReedSolomon(**parameters).compile(length)
    message = np.random.default_rng(seed).integers(0, 2, code.message_bits).astype(np.uint8)
    words, data = -(-(length // 8) // 255), code.message_bits // 8 + 3
    parity = (length // 8 - data) // words
    places = [(np.arange(w, data, words), data + w + words * np.arange(parity)) for w in range(words)]
    return code, message, code.encode(message), places


def llr_of(bits):
    return 8 * (1 - 2 * bits.astype(np.float32))


@pytest.mark.parametrize(("length", "rate"), [(256, 0.5), (960, 0.5), (2040, 0.5), (2048, 0.8), (4100, 0.3)])
def test_every_codeword_has_the_roots_of_the_generator(length, rate):
    code, message, sent, places = coded_message(length, rate=rate)
    data = code.message_bits // 8 + 3
    assert_array_equal(sent[: 8 * data], [*message, *crc24(message)])
    assert data / (length // 8) <= rate < (data + len(places)) / (length // 8)
    for own, parity in places:
        word = np.packbits(sent)[np.concatenate([own, parity])]
        assert len(word) <= 255
        root = 1
        for _ in parity:
            assert evaluate(word, root) == 0
            root = product(root, 2)


@pytest.mark.parametrize("length", [256, 960, 2600])
def test_half_the_parity_in_wrong_bytes(length):
    """As many wrong bytes in each codeword as half its parity, as sure as the others; one more is lost."""
    rng = np.random.default_rng(1)
    for extra in (0, 1):
        code, message, sent, places = coded_message(length, extra)
        received = np.packbits(sent)
        for own, parity in places:
            wrong = rng.choice(np.concatenate([own, parity]), len(parity) // 2 + extra, replace=False)
            received[wrong] ^= rng.integers(1, 256, len(wrong)).astype(np.uint8)
        received = np.unpackbits(received)
        found = code.decode(llr_of(received))
        assert found.ok == (not extra)
        if not extra:
            assert_array_equal(found.bits, message)
            assert found.flipped == (received != sent).sum()


def test_bytes_that_were_not_received_or_are_unsure():
    code, message, sent, _ = coded_message()
    rng = np.random.default_rng(2)
    for count, ok in ((52, True), (53, False)):
        llr = llr_of(sent).reshape(120, 8)
        llr[rng.choice(120, count, replace=False)] = 0
        assert code.decode(llr.ravel()).ok == ok
    llr = llr_of(sent).reshape(120, 8)
    llr[rng.choice(120, 50, replace=False)] *= -0.25
    found = code.decode(llr.ravel())
    assert found.ok
    assert_array_equal(found.bits, message)


def test_what_is_no_number_says_nothing():
    """As with `polar`: 40 bytes that are NaN are erased; as received ones they are too many to correct."""
    code, message, sent, _ = coded_message()
    places = np.random.default_rng(2).permutation(120)
    llr = llr_of(sent).reshape(120, 8)
    llr[places[40:48]] *= -1
    llr[places[:40]] = np.nan
    found = code.decode(llr.ravel())
    assert found.ok
    assert_array_equal(found.bits, message)
    assert found.flipped == 64


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="expected 4 bytes of message and CRC"):
        ReedSolomon().compile(48)
    with pytest.raises(ConfigError, match="and 8 of parity"):
        ReedSolomon(rate=0.95).compile(960)
