"""Laws of what looks at images: separation, decoding, ranging."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import Decode
from evlcp_sdk.testing.exercises import compiled_subject, expect_column, link_of, symbols_of
from evlcp_sdk.testing.law import InapplicableLawError, Law, Subject, compiled, expect
from evlcp_sdk.testing.views import GRID_PX, ideal_frame, ideal_presence, ideal_sums, ideal_view
from evlcp_sdk.values import PresenceMap, Range, SoftSymbols

__all__ = ["DECODING", "RANGING", "SEPARATION"]

_SPACINGS_PX = (4, 6, 8, 10, 12, 14)
"""Spacings of clusters: 108 m to 31 m with the default bar and camera."""
_EXACT = 1e-3
_SEEDS = 3
_FOLLOWED = ((-1, ""), (0, " before a dark chip"), (1, " before a lit chip"))
"""What is known of the chip after a frame."""


def _array(value: object, dtype: type, shape: tuple[int, ...], name: str) -> None:
    expect(isinstance(value, np.ndarray), f"{name} as an array, got {type(value).__name__}")
    assert isinstance(value, np.ndarray)
    wanted = np.dtype(dtype)
    expect(
        value.dtype == wanted and value.shape == shape,
        f"{name} as {wanted} {shape}, got {value.dtype} {value.shape}",
    )


def _permuted(book: Codebook, order: NDArray[np.int64]) -> Codebook:
    return Codebook(book.profile, book.preamble, book.pilots[order], book.codewords)


def _pilot_sums(link: Link, missing: float = 0.0, seed: int = 0) -> NDArray[np.int16]:
    sums = ideal_sums(link.codebook, symbols_of(link.codebook), missing=missing, seed=seed)
    return sums[: link.packet.pilot_chips]


def separation_shapes(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    separate = compiled_subject(subject)
    sums, k = _pilot_sums(link, missing=0.2), link.codebook.clusters
    for given in (sums, sums[:, :-3, :-1]):
        found = separate(given)
        expect(isinstance(found, PresenceMap), f"a PresenceMap, got {type(found).__name__}")
        _, height, width = given.shape
        grid = found.grid_px
        expect(isinstance(grid, int) and grid >= 1, f"grid_px as a whole number of pixels, got {grid!r}")
        cells = (k, height // grid, width // grid)
        _array(found.probability, np.float32, cells, "probability")
        _array(found.selected, np.bool_, cells, "selected")
        _array(found.pixels, np.float32, (k, height, width), "pixels")
        in_range = (found.probability >= 0).all() and (found.probability <= 1).all()
        expect(in_range, "probability from 0 to 1, without NaN")
        expect((found.pixels >= 0).all() and np.isfinite(found.pixels).all(), "pixels from 0 on, without NaN")


def finds_clusters(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    separate = compiled_subject(subject)
    k = link.codebook.clusters
    shown = ideal_presence(k).pixels > 0
    for seed in range(_SEEDS):
        found = separate(_pilot_sums(link, 0.2 * (seed > 0), seed))
        cells = found.selected.repeat(found.grid_px, 1).repeat(found.grid_px, 2)
        inside = cells & shown[:, : cells.shape[1], : cells.shape[2]]
        share = inside.sum((1, 2)) / shown.sum((1, 2))
        expect(
            (share >= 0.5).all(),
            f"half of each cluster's pixels selected or more,"
            f" got {share.min():.0%} of cluster {share.argmin()}",
        )
        right = inside.sum() / max(cells.sum(), 1)
        expect(right >= 0.9, f"nine tenths of what is selected in its place, got {right:.0%}")


def sees_nothing(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    separate = compiled_subject(subject)
    found = separate(np.zeros((link.packet.pilot_chips, 40, 20), np.int16))
    expect(not found.selected.any(), f"no cell selected without events, got {found.selected.sum()}")
    expect(not found.pixels.any(), "pixels of 0 without events")


def separation_permutes(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    order = np.random.default_rng(1).permutation(link.codebook.clusters)
    sums = _pilot_sums(link, missing=0.2)
    plain = compiled_subject(subject)(sums)
    turned = compiled(lambda: subject.algorithm.compile(_permuted(link.codebook, order)))(sums)
    for name in ("probability", "selected", "pixels"):
        wanted, got = getattr(plain, name)[order], getattr(turned, name)
        expect(
            np.allclose(got, wanted, atol=1e-5),
            f"{name} in another order, equal otherwise, when the pilots are in another order",
        )


def _decoders(subject: Subject) -> Iterator[tuple[Codebook, Decode]]:
    """The subject compiled for the SDK's modulations and the link's that it takes, with the link's pilots.

    Raises:
        InapplicableLawError: It takes none.
    """
    taken = False
    registry = Registry.load()
    link = link_of(subject)
    books = []
    for entry in registry.installed("modulation"):
        if entry.distribution == "evlcp-sdk":
            modulation = registry.load_class("modulation", entry.algorithm.id)()
            books.append(link.with_algorithm("modulation", modulation, id=entry.algorithm.id).codebook)
    if link.codebook not in books:
        books.append(link.codebook)
    for book in books:
        try:
            decode = subject.algorithm.compile(book)
        except ConfigError:
            continue
        taken = True
        yield book, decode
    if not taken:
        raise InapplicableLawError("refuses every profile")


def decoding_shapes(subject: Subject) -> None:
    """Hold the law."""
    for book, decode in _decoders(subject):
        soft = decode(*ideal_frame(book, symbols_of(book), missing=0.4))
        expect(isinstance(soft, SoftSymbols), f"SoftSymbols, got {type(soft).__name__}")
        _array(soft.symbols, np.int64, (book.clusters,), "symbols")
        _array(soft.llr, np.float32, (book.clusters, book.bits_per_symbol), "llr")
        expect(0 <= soft.quality <= 1, f"a quality from 0 to 1, got {soft.quality}")
        top = len(book.codewords) - 1
        expect(
            soft.symbols.min() >= -1 and soft.symbols.max() <= top,
            f"symbols from 0 to {top}, or -1 for a cluster that is not seen",
        )
        expect(np.isfinite(soft.llr).all(), "finite llr")
        expect(not soft.llr[soft.symbols < 0].any(), "llr 0 for a cluster that is not seen")


def decoding_inverts(subject: Subject) -> None:
    """Hold the law."""
    for book, decode in _decoders(subject):
        n, k = book.carrying, book.clusters
        for first in range(0, n, k):
            symbols = (first + np.arange(k)) % n
            for after, what in _FOLLOWED[:1] if book.pairs else _FOLLOWED:
                got = decode(*ideal_frame(book, symbols, after=after)).symbols
                wrong = np.flatnonzero(got != symbols)
                told = f"symbol {symbols[wrong[0]]}{what}, got {got[wrong[0]]}" if wrong.size else ""
                expect(not wrong.size, f"profile {book.profile}: {told}")


def llr_agrees(subject: Subject) -> None:
    """Hold the law."""
    for book, decode in _decoders(subject):
        m = book.bits_per_symbol
        for seed in range(_SEEDS):
            symbols = symbols_of(book, seed)
            soft = decode(*ideal_frame(book, symbols, missing=0.1, seed=seed))
            zero = (soft.symbols[:, None] >> np.arange(m - 1, -1, -1) & 1) == 0
            wrong = np.argwhere(((soft.llr > 0) != zero) & (soft.symbols[:, None] >= 0))
            if len(wrong):
                c, b = wrong[0]
                expect(
                    False,
                    f"profile {book.profile}: llr > 0 where a bit is 0, < 0 where it is 1; got"
                    f" {soft.llr[c, b]:.3g} for bit {int(not zero[c, b])} of symbol {soft.symbols[c]}",
                )


def decoding_permutes(subject: Subject) -> None:
    """Hold the law."""
    book = link_of(subject).codebook
    order = np.random.default_rng(1).permutation(book.clusters)
    after = np.arange(book.clusters) % 3 - 1
    presence, sums, *around = ideal_frame(book, symbols_of(book), after=after, missing=0.4)
    plain = compiled_subject(subject)(presence, sums, *around)
    other = PresenceMap(
        presence.probability[order], presence.grid_px, presence.selected[order], presence.pixels[order]
    )
    turned = compiled(lambda: subject.algorithm.compile(_permuted(book, order)))(
        other, sums, *(sent[order] for sent in around)
    )
    expect((turned.symbols == plain.symbols[order]).all(), "symbols in the order of the clusters")
    expect(
        np.allclose(turned.llr, plain.llr[order], rtol=1e-3, atol=1e-3), "llr in the order of the clusters"
    )


def decodes_nothing(subject: Subject) -> None:
    """Hold the law."""
    book = link_of(subject).codebook
    presence, sums, *around = ideal_frame(book, symbols_of(book))
    dark = PresenceMap(
        np.zeros_like(presence.probability),
        presence.grid_px,
        np.zeros_like(presence.selected),
        np.zeros_like(presence.pixels),
    )
    decode = compiled_subject(subject)
    for seen, given, what in (
        (dark, np.zeros_like(sums), "nothing at all"),
        (presence, np.zeros_like(sums), "no events"),
    ):
        soft = decode(seen, given, *around)
        sure = float(np.abs(soft.llr).max())
        expect(sure < 1e-3, f"llr of 0 from {what}, got {sure:.3g}")
        expect(np.isfinite(soft.quality), f"a finite quality from {what}, got {soft.quality}")


def _expect_measuring(subject: Subject) -> None:
    """Pass over a law of distances.

    Raises:
        InapplicableLawError: The subject gives none.
    """
    if not subject.algorithm.measures:
        raise InapplicableLawError("it measures nothing")


def _measure(
    subject: Subject, cluster_px: int = 8, seed: int = 0, right_down: tuple[int, int] = (0, 0)
) -> Range:
    _expect_measuring(subject)
    return _measured(subject, cluster_px, seed, right_down)


def _measured(
    subject: Subject, cluster_px: int = 8, seed: int = 0, right_down: tuple[int, int] = (0, 0)
) -> Range:
    link = link_of(subject)
    expect_column(link)
    measure = compiled_subject(subject)
    symbols = symbols_of(link.codebook, seed)
    found = measure(ideal_view(link.codebook, symbols, cluster_px=cluster_px, offset_px=right_down))
    expect(isinstance(found, Range), f"a Range, got {type(found).__name__}")
    assert isinstance(found, Range)
    return found


def _true_m(link: Link, cluster_px: int) -> float:
    centres = link.bar.cluster_centres_m()
    return link.camera.distance_m(float(np.hypot(*(centres[1] - centres[0]))), cluster_px)


def range_shapes(subject: Subject) -> None:
    """Hold the law."""
    found = _measured(subject)
    expect(
        isinstance(found.distance_m, float), f"distance_m as a float, got {type(found.distance_m).__name__}"
    )
    expect(isinstance(found.sigma_m, float), f"sigma_m as a float, got {type(found.sigma_m).__name__}")
    if not subject.algorithm.measures:
        nothing = np.isnan(found.distance_m) and np.isnan(found.sigma_m) and found.pairs == 0
        expect(nothing, f"NaN, NaN and 0 pairs of what measures nothing, got {found}")
        return
    expect(isinstance(found.pairs, int) and found.pairs > 0, f"pairs as a count above 0, got {found.pairs!r}")
    # One pair has no spread: its sigma may be unknown.
    known = found.sigma_m >= 0 or (found.pairs == 1 and np.isnan(found.sigma_m))
    expect(known, f"sigma_m from 0 on where there is a distance of several pairs, got {found.sigma_m}")


def exact(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    expect_column(link)
    for px in _SPACINGS_PX:
        for seed in range(_SEEDS):
            got, true = _measure(subject, px, seed).distance_m, _true_m(link, px)
            expect(
                abs(got / true - 1) <= _EXACT,
                f"{true:.3f} m within {_EXACT:.1%} for clusters exactly {px} px apart, got {got:.3f} m",
            )


def monotone(subject: Subject) -> None:
    """Hold the law."""
    found = [_measure(subject, px).distance_m for px in _SPACINGS_PX]
    told = ", ".join(f"{d:.2f}" for d in found)
    expect(
        (np.diff(found) < 0).all(),
        f"distances that fall as the spacing grows from {_SPACINGS_PX[0]} px to {_SPACINGS_PX[-1]} px,"
        f" got {told} m",
    )


def stays_when_moved(subject: Subject) -> None:
    """Hold the law."""
    still = _measure(subject).distance_m
    for moved in ((2 * GRID_PX, 0), (0, -2 * GRID_PX), (-GRID_PX, GRID_PX)):
        got = _measure(subject, right_down=moved).distance_m
        expect(
            abs(got / still - 1) <= _EXACT,
            f"{still:.3f} m wherever the bar stands, got {got:.3f} m {moved} px (right, down) off",
        )


def scales_with_focal_length(subject: Subject) -> None:
    """Hold the law."""
    _expect_measuring(subject)
    link = link_of(subject)
    expect_column(link)
    view = ideal_view(link.codebook, symbols_of(link.codebook))
    near = compiled_subject(subject)(view)
    camera = replace(link.camera, focal_mm=2 * link.camera.focal_mm)
    far = compiled(lambda: subject.algorithm.compile(camera, link.bar, link.codebook))(view)
    expect(
        abs(far.distance_m / near.distance_m - 2) <= _EXACT,
        f"twice the distance with twice the focal length, got {near.distance_m:.3f} m"
        f" and {far.distance_m:.3f} m",
    )


def no_distance_of_nothing(subject: Subject) -> None:
    """Hold the law."""
    link = link_of(subject)
    expect_column(link)
    measure = compiled_subject(subject)
    view = ideal_view(link.codebook, symbols_of(link.codebook))
    only_first = np.arange(link.codebook.clusters) == 0
    for seen, what in ((0 * only_first, "no cluster"), (only_first, "one cluster")):
        mask = seen.astype(np.float32)[:, None, None]
        presence = view.presence
        dark = PresenceMap(
            presence.probability * mask,
            presence.grid_px,
            presence.selected & (mask > 0),
            presence.pixels * mask,
        )
        got = measure(replace(view, presence=dark))
        expect(np.isnan(got.distance_m), f"a distance of NaN from {what}, got {got.distance_m}")
        expect(np.isnan(got.sigma_m), f"a sigma of NaN from {what}, got {got.sigma_m}")


SEPARATION = (
    Law(
        "shapes",
        "a PresenceMap of the documented shapes and types, probabilities in range",
        separation_shapes,
    ),
    Law("finds-clusters", "each cluster of an ideal image is found in its place", finds_clusters),
    Law("sees-nothing", "without events there is no cluster", sees_nothing),
    Law("permutes", "pilots in another order give the same maps in that order", separation_permutes),
)
"""Laws of separation."""

DECODING = (
    Law("shapes", "SoftSymbols of the documented shapes and types, values in range", decoding_shapes),
    Law("inverts", "every symbol of every profile comes back from an ideal image", decoding_inverts),
    Law("llr-agrees", "the signs of the log-likelihood ratios spell the symbols that are given", llr_agrees),
    Law("permutes", "clusters in another order say the same in that order", decoding_permutes),
    Law("knows-nothing", "without events the log-likelihood ratios are 0", decodes_nothing),
)
"""Laws of decoding."""

RANGING = (
    Law(
        "shapes",
        "a Range of plain numbers, sigma from 0 on, or NaN for a single pair; NaN where nothing is measured",
        range_shapes,
    ),
    Law("exact", "exact for clusters that lie whole pixels apart", exact),
    Law("monotone", "the wider the image, the nearer", monotone),
    Law("moved", "the same wherever the bar stands in the image", stays_when_moved),
    Law("focal-length", "in proportion to the focal length", scales_with_focal_length),
    Law("sees-nothing", "no distance (NaN) from no cluster and from one", no_distance_of_nothing),
)
"""Laws of ranging."""
