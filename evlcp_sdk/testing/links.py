"""Laws of the link: the whole receiver with one algorithm replaced, on a clean recording."""

import numpy as np

from evlcp_sdk.link.resolve import Link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.exercises import link_of, require_column
from evlcp_sdk.testing.law import Subject, compile_or_skip, expect, law
from evlcp_sdk.testing.recordings import bar_in_sight, ideal_events, random_symbols

_PACKETS = 3
_CLUSTER_PX = 8.0
_TOLERANCE = 0.05
"""Half a pixel of 8 px at the edges of the image."""

_SPARSE = 4
"""Frames between pilots, as in the fast profile."""


@law("clean-link", "no error in a clean recording with this algorithm in the link")
def _check_clean(subject: Subject) -> None:
    _expect_clean(link_of(subject))


@law("sparse-pilots", f"no error in a clean recording with the pilot in every {_SPARSE}th frame only")
def _check_sparse(subject: Subject) -> None:
    _expect_clean(link_of(subject, pilot_every=_SPARSE))


def _expect_clean(link: Link) -> None:
    require_column(link)
    bar = bar_in_sight(link, random_symbols(link, _PACKETS), cluster_px=_CLUSTER_PX)
    receiver = compile_or_skip(lambda: Receiver(link))
    packets = receiver.feed(ideal_events(link, bar, missing=0.0)) + receiver.close()
    frames = [frame for packet in packets for frame in packet.frames]
    sent = bar.symbols.reshape(-1, link.codebook.clusters)
    expect(len(frames) == len(sent), f"all {len(sent)} frames of a clean recording, got {len(frames)}")
    wrong = int((np.array([frame.soft.symbols for frame in frames]) != sent).sum())
    expect(wrong == 0, f"no wrong symbol in a clean recording, got {wrong} of {sent.size}")
    if not link.algorithm("ranging").measures:
        return
    centres = link.bar.cluster_centres_m()
    true_m = link.camera.distance_m(float(np.hypot(*(centres[1] - centres[0]))), _CLUSTER_PX)
    for frame in frames:
        if not link.packet.has_pilot(frame.frame):
            continue
        for name, found in (("distance", frame.range), ("filtered", frame.filtered)):
            if found is not None:
                what = f"{name} {true_m:.2f} m within {_TOLERANCE:.0%}, got {found.distance_m:.2f} m"
                expect(abs(found.distance_m / true_m - 1) <= _TOLERANCE, what)


LINK = (_check_clean, _check_sparse)
"""The laws of the link, for every role."""
