"""Laws of algorithms on images: separation, decoding, ranging."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Decode
from evlcp_sdk.testing.exercises import (
    compile_subject,
    link_of,
    locate_clusters,
    pilot_sums,
    require_column,
    symbols_of,
)
from evlcp_sdk.testing.law import InapplicableLawError, Subject, compile_or_skip, expect, law
from evlcp_sdk.testing.trees import map_arrays
from evlcp_sdk.testing.views import GRID_PX, ideal_frame, ideal_view
from evlcp_sdk.values import PresenceMap, Range, SoftSymbols

_SPACINGS_PX = (4, 6, 8, 10, 12, 14)
"""Spacings of clusters: 108 m to 31 m with the default bar and camera."""
_EXACT = 1e-3
_SEEDS = 3
_NEXT_CHIPS = ((-1, ""), (0, " before a dark chip"), (1, " before a lit chip"))
"""The chip after a frame, -1 if unknown, and its name."""


def _expect_array(value: object, dtype: type, shape: tuple[int, ...], name: str) -> None:
    wanted = np.dtype(dtype)
    if not isinstance(value, np.ndarray):
        expect(False, f"{name} as an array, got {type(value).__name__}")
    elif value.dtype != wanted or value.shape != shape:
        expect(False, f"{name} as {wanted} {shape}, got {value.dtype} {value.shape}")


def _permute_pilots(book: Codebook) -> tuple[NDArray[np.int64], Codebook]:
    order = np.random.default_rng(1).permutation(book.clusters)
    return order, Codebook(book.profile, book.preamble, book.pilots[order], book.codewords)


@law("shapes", "a PresenceMap of the documented shapes and types, probabilities in range")
def _check_separation_shapes(subject: Subject) -> None:
    link, separate = link_of(subject), compile_subject(subject)
    sums, k = pilot_sums(link, missing=0.2), link.codebook.clusters
    for image in (sums, sums[:, :-3, :-1]):
        found = separate(image)
        expect(isinstance(found, PresenceMap), f"a PresenceMap, got {type(found).__name__}")
        _, height, width = image.shape
        grid = found.grid_px
        expect(isinstance(grid, int) and grid >= 1, f"grid_px as a whole number of pixels, got {grid!r}")
        cells = (k, height // grid, width // grid)
        _expect_array(found.probability, np.float32, cells, "probability")
        _expect_array(found.selected, np.bool_, cells, "selected")
        _expect_array(found.pixels, np.float32, (k, height, width), "pixels")
        in_range = (found.probability >= 0).all() and (found.probability <= 1).all()
        expect(in_range, "probability from 0 to 1, without NaN")
        expect((found.pixels >= 0).all() and np.isfinite(found.pixels).all(), "pixels from 0 on, without NaN")


@law("finds-clusters", "each cluster of an ideal image is found in its place")
def _check_clusters_found(subject: Subject) -> None:
    link, separate = link_of(subject), compile_subject(subject)
    for seed in range(_SEEDS):
        sums = pilot_sums(link, 0.2 * (seed > 0), seed)
        share, placed = locate_clusters(separate, sums, link.codebook.clusters)
        least = f"{share.min():.0%} of cluster {share.argmin()}"
        expect((share >= 0.5).all(), f"half of each cluster's pixels selected or more, got {least}")
        expect(placed >= 0.9, f"nine tenths of what is selected in its place, got {placed:.0%}")


@law("sees-nothing", "without events there is no cluster")
def _check_empty_separation(subject: Subject) -> None:
    link, separate = link_of(subject), compile_subject(subject)
    found = separate(np.zeros((link.packet.pilot_chips, 40, 20), np.int16))
    expect(not found.selected.any(), f"no cell selected without events, got {found.selected.sum()}")
    expect(not found.pixels.any(), "pixels of 0 without events")


@law("permutes", "pilots in another order give the same maps in that order")
def _check_separation_order(subject: Subject) -> None:
    link = link_of(subject)
    order, book = _permute_pilots(link.codebook)
    sums = pilot_sums(link, missing=0.2)
    direct = compile_subject(subject)(sums)
    permuted = compile_or_skip(lambda: subject.algorithm.compile(book))(sums)
    for name in ("probability", "selected", "pixels"):
        same = np.allclose(getattr(permuted, name), getattr(direct, name)[order], atol=1e-5)
        expect(same, f"{name} in another order, equal otherwise, when the pilots are in another order")


SEPARATION = (
    _check_separation_shapes,
    _check_clusters_found,
    _check_empty_separation,
    _check_separation_order,
)
"""Laws of separation."""


def _compile_decoders(subject: Subject) -> Iterator[tuple[Codebook, Decode]]:
    """Compile the subject for the modulations of the SDK and of the link that it accepts.

    Raises:
        InapplicableLawError: It accepts none.
    """
    registry, link = Registry.load(), link_of(subject)
    books = []
    for entry in registry.list_algorithms("modulation"):
        if entry.distribution == "evlcp-sdk":
            modulation = registry.load_class("modulation", entry.algorithm.id)()
            books.append(link.with_algorithm("modulation", modulation, id=entry.algorithm.id).codebook)
    if link.codebook not in books:
        books.append(link.codebook)
    is_used = False
    for book in books:
        try:
            decode = subject.algorithm.compile(book)
        except ConfigError:
            continue
        is_used = True
        yield book, decode
    if not is_used:
        raise InapplicableLawError("refuses every profile")


@law("shapes", "SoftSymbols of the documented shapes and types, values in range")
def _check_decoding_shapes(subject: Subject) -> None:
    for book, decode in _compile_decoders(subject):
        soft = decode(*ideal_frame(book, symbols_of(book), missing=0.4))
        expect(isinstance(soft, SoftSymbols), f"SoftSymbols, got {type(soft).__name__}")
        _expect_array(soft.symbols, np.int64, (book.clusters,), "symbols")
        _expect_array(soft.llr, np.float32, (book.clusters, book.bits_per_symbol), "llr")
        expect(0 <= soft.quality <= 1, f"a quality from 0 to 1, got {soft.quality}")
        top = len(book.codewords) - 1
        in_range = soft.symbols.min() >= -1 and soft.symbols.max() <= top
        expect(in_range, f"symbols from 0 to {top}, or -1 for a cluster that is not seen")
        expect(np.isfinite(soft.llr).all(), "finite llr")
        expect(not soft.llr[soft.symbols < 0].any(), "llr 0 for a cluster that is not seen")


@law("inverts", "every symbol of every profile comes back from an ideal image")
def _check_decoding(subject: Subject) -> None:
    for book, decode in _compile_decoders(subject):
        n, k = book.data_symbols, book.clusters
        for first in range(0, n, k):
            symbols = (first + np.arange(k)) % n
            for after, what in _NEXT_CHIPS[:1] if book.is_pair_coded else _NEXT_CHIPS:
                got = decode(*ideal_frame(book, symbols, after=after)).symbols
                for wrong in np.flatnonzero(got != symbols)[:1]:
                    first_wrong = f"symbol {symbols[wrong]}{what}, got {got[wrong]}"
                    expect(False, f"profile {book.profile}: {first_wrong}")


@law("llr-agrees", "the signs of the log-likelihood ratios spell the symbols that are given")
def _check_llr_signs(subject: Subject) -> None:
    for book, decode in _compile_decoders(subject):
        m = book.bits_per_symbol
        for seed in range(_SEEDS):
            soft = decode(*ideal_frame(book, symbols_of(book, seed), missing=0.1, seed=seed))
            zero = (soft.symbols[:, None] >> np.arange(m - 1, -1, -1) & 1) == 0
            for c, b in np.argwhere(((soft.llr > 0) != zero) & (soft.symbols[:, None] >= 0))[:1]:
                got = f"{soft.llr[c, b]:.3g} for bit {int(not zero[c, b])} of symbol {soft.symbols[c]}"
                expect(
                    False, f"profile {book.profile}: llr > 0 where a bit is 0, < 0 where it is 1; got {got}"
                )


@law("permutes", "clusters in another order say the same in that order")
def _check_decoding_order(subject: Subject) -> None:
    book = link_of(subject).codebook
    order, other = _permute_pilots(book)
    after = np.arange(book.clusters) % 3 - 1
    presence, sums, *around = ideal_frame(book, symbols_of(book), after=after, missing=0.4)
    direct = compile_subject(subject)(presence, sums, *around)
    decode = compile_or_skip(lambda: subject.algorithm.compile(other))
    permuted = decode(map_arrays(presence, lambda a: a[order]), sums, *(sent[order] for sent in around))
    expect((permuted.symbols == direct.symbols[order]).all(), "symbols in the order of the clusters")
    same = np.allclose(permuted.llr, direct.llr[order], rtol=1e-3, atol=1e-3)
    expect(same, "llr in the order of the clusters")


@law("knows-nothing", "without events the log-likelihood ratios are 0")
def _check_empty_decoding(subject: Subject) -> None:
    book = link_of(subject).codebook
    presence, sums, *around = ideal_frame(book, symbols_of(book))
    decode = compile_subject(subject)
    for seen, what in ((map_arrays(presence, np.zeros_like), "nothing at all"), (presence, "no events")):
        soft = decode(seen, np.zeros_like(sums), *around)
        sure = float(np.abs(soft.llr).max())
        expect(sure < 1e-3, f"llr of 0 from {what}, got {sure:.3g}")
        expect(np.isfinite(soft.quality), f"a finite quality from {what}, got {soft.quality}")


DECODING = (
    _check_decoding_shapes,
    _check_decoding,
    _check_llr_signs,
    _check_decoding_order,
    _check_empty_decoding,
)
"""Laws of decoding."""


def _measure(
    subject: Subject, cluster_px: int = 8, seed: int = 0, right_down: tuple[int, int] = (0, 0)
) -> Range:
    link = link_of(subject)
    require_column(link)
    symbols = symbols_of(link.codebook, seed)
    view = ideal_view(link.codebook, symbols, cluster_px=cluster_px, offset_px=right_down)
    found: Range = compile_subject(subject)(view)
    expect(isinstance(found, Range), f"a Range, got {type(found).__name__}")
    return found


def _measure_m(subject: Subject, *of_image: Any, **more: Any) -> float:
    if not subject.algorithm.measures:
        raise InapplicableLawError("it measures nothing")
    return _measure(subject, *of_image, **more).distance_m


@law(
    "shapes",
    "a Range of plain numbers, sigma from 0 on, or NaN for a single pair; NaN where nothing is measured",
)
def _check_range_shapes(subject: Subject) -> None:
    found = _measure(subject)
    for name in ("distance_m", "sigma_m"):
        value = getattr(found, name)
        expect(isinstance(value, float), f"{name} as a float, got {type(value).__name__}")
    if not subject.algorithm.measures:
        nothing = np.isnan(found.distance_m) and np.isnan(found.sigma_m) and found.pairs == 0
        expect(nothing, f"NaN, NaN and 0 pairs of what measures nothing, got {found}")
        return
    expect(isinstance(found.pairs, int) and found.pairs > 0, f"pairs as a count above 0, got {found.pairs!r}")
    # The sigma of a single pair may be unknown.
    known = found.sigma_m >= 0 or (found.pairs == 1 and np.isnan(found.sigma_m))
    expect(known, f"sigma_m from 0 on where there is a distance of several pairs, got {found.sigma_m}")


@law("exact", "exact for clusters that lie whole pixels apart")
def _check_exact(subject: Subject) -> None:
    link = link_of(subject)
    require_column(link)
    centres = link.bar.cluster_centres_m()
    for px in _SPACINGS_PX:
        true = link.camera.distance_m(float(np.hypot(*(centres[1] - centres[0]))), px)
        for seed in range(_SEEDS):
            got = _measure_m(subject, px, seed)
            what = f"{true:.3f} m within {_EXACT:.1%} for clusters exactly {px} px apart, got {got:.3f} m"
            expect(abs(got / true - 1) <= _EXACT, what)


@law("monotone", "the wider the image, the nearer")
def _check_monotone(subject: Subject) -> None:
    found = [_measure_m(subject, px) for px in _SPACINGS_PX]
    got = ", ".join(f"{d:.2f}" for d in found)
    ends = f"{_SPACINGS_PX[0]} px to {_SPACINGS_PX[-1]} px"
    expect((np.diff(found) < 0).all(), f"distances that fall as the spacing grows from {ends}, got {got} m")


@law("moved", "the same wherever the bar stands in the image")
def _check_moved(subject: Subject) -> None:
    still = _measure_m(subject)
    for moved in ((2 * GRID_PX, 0), (0, -2 * GRID_PX), (-GRID_PX, GRID_PX)):
        got = _measure_m(subject, right_down=moved)
        what = f"{still:.3f} m wherever the bar stands, got {got:.3f} m {moved} px (right, down) off"
        expect(abs(got / still - 1) <= _EXACT, what)


@law("focal-length", "in proportion to the focal length")
def _check_focal_length(subject: Subject) -> None:
    near = _measure_m(subject)
    link = link_of(subject)
    camera = replace(link.camera, focal_mm=2 * link.camera.focal_mm)
    measure = compile_or_skip(lambda: subject.algorithm.compile(camera, link.bar, link.codebook))
    far = measure(ideal_view(link.codebook, symbols_of(link.codebook))).distance_m
    what = f"twice the distance with twice the focal length, got {near:.3f} m and {far:.3f} m"
    expect(abs(far / near - 2) <= _EXACT, what)


@law("sees-nothing", "no distance (NaN) from no cluster and from one")
def _check_empty_ranging(subject: Subject) -> None:
    link = link_of(subject)
    require_column(link)
    measure = compile_subject(subject)
    view = ideal_view(link.codebook, symbols_of(link.codebook))
    for clusters, what in ((0, "no cluster"), (1, "one cluster")):
        presence = map_arrays(view.presence, np.copy)
        for array in (presence.probability, presence.selected, presence.pixels):
            array[clusters:] = 0
        got = measure(replace(view, presence=presence))
        expect(np.isnan(got.distance_m), f"a distance of NaN from {what}, got {got.distance_m}")
        expect(np.isnan(got.sigma_m), f"a sigma of NaN from {what}, got {got.sigma_m}")


RANGING = (
    *(_check_range_shapes, _check_exact, _check_monotone, _check_moved),
    *(_check_focal_length, _check_empty_ranging),
)
"""Laws of ranging."""
