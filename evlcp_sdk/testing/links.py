"""The law of the link: the whole receiver, with one algorithm exchanged, on a clean recording."""

from collections.abc import Sequence

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.exercises import expect_column, link_of
from evlcp_sdk.testing.law import Law, Subject, compiled, expect
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.values import Frame

__all__ = ["LINK"]

_PACKETS = 3
_CLUSTER_PX = 8.0
_NEAR = 0.05
"""Half a pixel of the image's edges in 8 px."""


_SPARSE = 4
"""Frames from pilot to pilot, as in the fast profile."""


def clean_link(subject: Subject) -> None:
    """Hold the law."""
    _expect_clean(link_of(subject))


def sparse_pilots(subject: Subject) -> None:
    """Hold the law."""
    _expect_clean(link_of(subject, pilot_every=_SPARSE))


def _expect_clean(link: Link) -> None:
    expect_column(link)
    bar = IdealBar(random_symbols(link, _PACKETS), cluster_px=_CLUSTER_PX)
    receiver = compiled(lambda: Receiver(link))
    packets = receiver.feed(ideal_events(link, bar, missing=0.0)) + receiver.close()
    frames = [frame for packet in packets for frame in packet.frames]
    expect(
        len(frames) == bar.symbols[..., 0].size,
        f"all {bar.symbols[..., 0].size} frames of a clean recording, got {len(frames)}",
    )
    sent = bar.symbols.reshape(-1, link.codebook.clusters)
    heard = np.array([frame.soft.symbols for frame in frames])
    wrong = int((heard != sent).sum())
    expect(wrong == 0, f"no wrong symbol in a clean recording, got {wrong} of {sent.size}")
    centres = link.bar.cluster_centres_m()
    true_m = link.camera.distance_m(float(np.hypot(*(centres[1] - centres[0]))), _CLUSTER_PX)
    ranged = [frame for frame in frames if link.packet.has_pilot(frame.frame)]
    if link.algorithm("ranging").measures:
        _expect_near(ranged, true_m)


def _expect_near(frames: Sequence[Frame], true_m: float) -> None:
    for frame in frames:
        ranges = [("distance", frame.range)] + ([("filtered", frame.filtered)] if frame.filtered else [])
        for name, found in ranges:
            expect(
                abs(found.distance_m / true_m - 1) <= _NEAR,
                f"{name} {true_m:.2f} m within {_NEAR:.0%}, got {found.distance_m:.2f} m",
            )


LINK = (
    Law("clean-link", "no error in a clean recording with this algorithm in the link", clean_link),
    Law(
        "sparse-pilots",
        f"no error in a clean recording with the pilot in every {_SPARSE}th frame only",
        sparse_pilots,
    ),
)
"""The law of the link, for every role."""
