"""The laws of the SDK, and that bad pixels do not sway what is measured."""

from dataclasses import replace

import numpy as np
from evlcp_robust.decoding import Majority
from evlcp_robust.framing import FlashPosition
from evlcp_robust.modulation import ReturnToZero
from evlcp_robust.ranging import MedianPairs

import evlcp_sdk as evlcp
from evlcp_sdk.testing import (
    IdealBar,
    conformance,
    ideal_events,
    ideal_presence,
    ideal_sums,
    ideal_view,
)

LINK = evlcp.load_link()
SYMBOLS = np.random.default_rng(7).integers(0, len(LINK.codebook.codewords), LINK.bar.clusters)


@conformance("ranging", MedianPairs(), MedianPairs(min_spacing=0.5))
def test_ranging(check):
    check()


@conformance("decoding", Majority())
def test_decoding(check):
    check()


@conformance("modulation", ReturnToZero())
def test_modulation(check):
    check()


@conformance("framing", FlashPosition(), FlashPosition(bits=5))
def test_framing(check):
    check()


def test_flashes_are_read_in_noise_and_with_events_missing():
    link = evlcp.load_link(overrides=["bar.cluster_rows=96", "air.frames_per_packet=20"])
    link = link.with_algorithm("framing", FlashPosition(), id="flash-position")
    symbols = np.random.default_rng(2).integers(0, 8, (5, 20, 1))
    events = ideal_events(link, IdealBar(symbols, ppm=300.0), missing=0.5)
    rng = np.random.default_rng(4)
    n, end_us = 300, int(events.t_us[-1])
    noise = evlcp.Events.of(
        np.sort(rng.integers(0, end_us, n)),
        rng.integers(0, 99, n),
        rng.integers(0, 99, n),
        rng.integers(0, 2, n),
    )
    deframer = FlashPosition().compile(link.codebook, link.packet)
    both = evlcp.Events.concat([events, noise])
    both = both[np.argsort(both.t_us, kind="stable")]
    state, decoded = deframer.step(deframer.init(), both, end_us)
    decoded += deframer.close(state)[1]
    assert len(decoded) == symbols.size
    assert all(one.soft.symbols[0] == symbols[one.packet, one.frame, 0] for one in decoded)
    assert deframer.counts(state) == {"preambles": 5, "frames_dark": 0}


def test_three_clusters_out_of_place_do_not_move_the_distance():
    measure = MedianPairs().compile(LINK.camera, LINK.bar, LINK.codebook)
    view = ideal_view(LINK.codebook, SYMBOLS)
    true_m = LINK.camera.distance_m(0.06, 8)
    pixels = view.presence.pixels.copy()
    for cluster, rows in ((2, 9), (7, -14), (12, 5)):
        pixels[cluster] = np.roll(pixels[cluster], rows, 0)
    found = measure(replace(view, presence=replace(view.presence, pixels=pixels)))
    assert abs(found.distance_m / true_m - 1) < 0.001


def test_sigma_is_that_of_many_trials():
    measure = MedianPairs().compile(LINK.camera, LINK.bar, LINK.codebook)
    rng = np.random.default_rng(3)
    view = ideal_view(LINK.codebook, SYMBOLS)
    shape = view.presence.pixels.shape
    rows = np.arange(shape[1])
    found = []
    for _ in range(400):
        centre = 14.0 + 8 * np.arange(shape[0]) + rng.normal(0, 0.2, shape[0])
        # A weight in two neighbouring rows has its centre of gravity anywhere between them.
        column = np.maximum(1 - np.abs(rows - centre[:, None]), 0)
        pixels = np.repeat(column[:, :, None], shape[2], 2).astype(np.float32)
        found.append(measure(replace(view, presence=replace(view.presence, pixels=pixels))))
    error = np.std([r.distance_m for r in found])
    sigma_m = np.sqrt(np.mean([r.sigma_m**2 for r in found]))
    assert 0.85 < sigma_m / error < 1.25


def test_a_cell_that_never_stops_has_one_vote():
    decode = Majority().compile(LINK.codebook)
    sums = ideal_sums(LINK.codebook, SYMBOLS)
    loud = sums.copy()
    loud[:, 10::8, 10] = np.random.default_rng(1).choice([-30, 30], loud[:, 10::8, 10].shape)
    got = decode(ideal_presence(LINK.bar.clusters), loud)
    assert (got.symbols == SYMBOLS).all()
    assert 0.5 < got.quality < 1


def test_log_likelihood_ratios_are_odds():
    """Of bits with an LLR of L, one in 1 + exp(L) is wrong; one cell a cluster, strong noise."""
    book = LINK.codebook
    decode = Majority().compile(book)
    presence = ideal_presence(book.clusters, cluster_px=2, width_px=2)
    rng = np.random.default_rng(5)
    llr, wrong = [], []
    for seed in range(300):
        symbols = rng.integers(0, len(book.codewords), book.clusters)
        sums = ideal_sums(book, symbols, cluster_px=2, width_px=2, events_per_edge=1, missing=0.4, seed=seed)
        sums += rng.integers(-2, 3, sums.shape).astype(np.int16)
        soft = decode(presence, sums)
        sent = symbols[:, None] >> np.arange(book.bits_per_symbol - 1, -1, -1) & 1
        llr.append(np.abs(soft.llr).ravel())
        wrong.append(((soft.llr < 0) != sent).ravel())
    level, bad = np.concatenate(llr), np.concatenate(wrong)
    middle = np.median(level)
    for half in (level <= middle, level > middle):
        expected = (1 / (1 + np.exp(level[half]))).mean()
        assert 0.9 < bad[half].mean() / expected < 1.15, (bad[half].mean(), expected)
