"""How far symbols are believed: against a channel whose errors are counted."""

import numpy as np
import pytest

from evlcp_sdk.air.codebook import hadamard
from evlcp_sdk.rx import _kernels
from evlcp_sdk.rx.reading import calibrate_llr
from evlcp_sdk.values import SoftSymbols

ALL = np.ones(16, bool)
ROWS = hadamard(8)
WORDS = np.concatenate([ROWS, -ROWS])
BITS = np.arange(16)[:, None] >> np.arange(3, -1, -1) & 1


def send_and_read(rng, noise, scale):
    """A frame over a Gaussian channel, by max-log, its LLRs off by a factor."""
    sent = rng.integers(0, 16, 16)
    gain = rng.uniform(0.8, 1.2, 16)
    values = gain[:, None] * WORDS[sent] + rng.normal(0, noise, (16, 8))
    fit = values @ WORDS.T * scale
    llr = np.stack(
        [fit[:, BITS[:, b] == 0].max(1) - fit[:, BITS[:, b] == 1].max(1) for b in range(4)], axis=1
    )
    return sent, SoftSymbols(fit.argmax(1), llr.astype(np.float32), 1.0)


@pytest.mark.parametrize("scale", [0.01, 1.0, 50.0])
@pytest.mark.parametrize(("noise", "least"), [(0.6, 0.5), (0.7, 0.5), (0.8, 0.5), (0.9, 0.4), (1.4, 0.4)])
def test_of_frames_with_quality_q_one_less_q_are_wrong(noise, least, scale):
    """Within a factor of 2; where most are wrong, 0.4 as many are said to be."""
    rng = np.random.default_rng(7)
    wrong, doubt = [], []
    for _ in range(400):
        sent, read = send_and_read(rng, noise, scale)
        soft = calibrate_llr(read, ALL)
        given = soft.symbols >= 0
        wrong.append((soft.symbols != sent)[given].any())
        doubt.append(1 - soft.quality)
    assert np.mean(wrong) > 0.05
    assert least < np.mean(doubt) / np.mean(wrong) < 2


def test_what_is_rather_wrong_is_not_given():
    rng = np.random.default_rng(3)
    hidden = right = 0
    for _ in range(300):
        sent, read = send_and_read(rng, 1.6, 1.0)
        soft = calibrate_llr(read, ALL)
        hidden += int((soft.symbols < 0).sum())
        right += int((read.symbols == sent)[soft.symbols < 0].sum())
        # Their LLRs say so: they stay, for the error correction.
        assert (soft.llr != 0).all()
        assert ((soft.llr > 0) == (read.llr > 0)).all()
    assert hidden > 100
    assert right < 0.6 * hidden


def test_of_what_is_not_seen_nothing_is_given():
    _, read = send_and_read(np.random.default_rng(0), 0.1, 1.0)
    seen = np.arange(16) != 5
    soft = calibrate_llr(read, seen)
    assert soft.symbols[5] == -1
    assert not soft.llr[5].any()
    np.testing.assert_array_equal(soft.symbols[seen], read.symbols[seen])
    assert soft.quality > 0.999
    for none in (calibrate_llr(read, ~ALL), calibrate_llr(SoftSymbols(read.symbols, 0 * read.llr, 1.0), ALL)):
        assert (none.symbols == -1).all()
        assert not none.llr.any()
        assert none.quality == 0


def test_silence_is_not_what_a_cluster_says():
    """Two clusters side by side; the second one's info segment has an event in one chip of eight."""
    rng = np.random.default_rng(0)
    sums = np.where(rng.random((32, 6, 8)) < 0.6, 1, 0).astype(np.int16)
    sums[16:, :, 4:] = 0
    sums[16:20:2, :, 4:] = -1
    probability = np.zeros((3, 3, 4), np.float32)
    probability[0, :, :2] = probability[1, :, 2:] = 0.9
    lit = np.empty(3, np.bool_)
    _kernels.find_lit_clusters(sums, probability, 2, 16, 0.25, ALL[:3], lit)
    assert lit.tolist() == [True, False, False]
    _kernels.find_lit_clusters(sums, probability, 2, 16, 0.25, ~ALL[:3], lit)
    assert not lit.any()
