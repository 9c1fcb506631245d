"""What tests of the receiver share: a stream in pieces, and all that is said of it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import IdealBar, ideal_events, random_symbols
from evlcp_sdk.values import Events

LINK = load_link()


def lit(packets, seed=0, link=LINK, **how):
    """A bar that sends so many random packets, and its events."""
    bar = IdealBar(random_symbols(link, packets, seed), **how)
    return bar, ideal_events(link, bar, seed=seed)


def receive_cut(link, events, cuts=(), **options):
    """A receiver after a stream that is cut before these events, and its packets.

    What algorithms of the SDK give is checked, too, as strangers' is.
    """
    links = [replace(one, built_in=frozenset()) for one in (link if isinstance(link, list) else [link])]
    receiver = Receiver(links if isinstance(link, list) else links[0], **options)
    packets = []
    for begin, end in pairwise([0, *sorted(cuts), len(events)]):
        packets += receiver.feed(events[begin:end])
    return receiver, packets + receiver.close()


def steps(events, until_us):
    """The events of each millisecond, after its start, us."""
    bounds = events.t_us.searchsorted(np.arange(0, until_us + 1, 1000))
    return ((1000 * n, events[a:b]) for n, (a, b) in enumerate(pairwise(bounds)))


def frames_of(packets):
    return [frame for packet in packets for frame in packet.frames]


def frame_content(frame):
    """All of a frame, to the last bit."""
    soft = frame.soft
    return (
        *(frame.transmitter, frame.packet, frame.frame, frame.t_us, frame.x_px, frame.y_px, frame.link),
        *(soft.symbols.tobytes(), soft.llr.tobytes(), soft.quality, repr(frame.range), repr(frame.filtered)),
        *(frame.points_px.tobytes(), frame.points_sigma_px.tobytes(), frame.points_t_us, frame.echo_of),
    )


def right_frames(packets, bar, link=LINK, *, t0_us=0, late_us=(0, 60)):
    """How many frames there are, each of which says what was sent at its time; an edge's events come late.

    Their packets begin when they were sent, and have each frame once.
    """
    chip_us = link.packet.chip_us / (1 + bar.ppm * 1e-6)
    period_us = link.packet.packet_chips * chip_us
    for packet in packets:
        assert [f.frame for f in packet.frames] == sorted({f.frame for f in packet.frames})
        number = round((packet.t_us - t0_us - bar.start_us) / period_us)
        begin_us = t0_us + bar.start_us + number * period_us
        assert late_us[0] < packet.t_us - begin_us < late_us[1]
        for frame in packet.frames:
            after_us = frame.t_us - begin_us - link.packet.frame_start_chip(frame.frame) * chip_us
            assert late_us[0] < after_us < late_us[1]
            assert frame.soft.symbols.tolist() == bar.symbols[number, frame.frame].tolist()
    return len(frames_of(packets))


def lamp_events(x, y, size, flicker_hz, duration_us, *, duty=0.5):
    """A square lamp that flickers: its pixels send three events at each change of its light."""
    rng = np.random.default_rng(0)
    period_us = 1e6 / flicker_hz
    starts = np.arange(0, duration_us, period_us)
    edges = np.concatenate([starts, starts + duty * period_us])
    on = np.concatenate([np.ones(len(starts)), np.zeros(len(starts))])
    v, u = np.mgrid[y : y + size, x : x + size]
    n = v.size * 3
    t = np.repeat(edges, n) + np.tile(np.repeat([0, 12, 24], v.size), len(edges))
    t = np.floor(t + rng.normal(25, 5, len(t)))
    places = (np.tile(one.ravel(), 3 * len(edges)) for one in (u, v))
    return Events.of(t, *places, np.repeat(on, n))[np.argsort(t, kind="stable")]


def noise_events(rate_hz, duration_us):
    """Random events all over a 1280x720 sensor."""
    rng = np.random.default_rng(0)
    n = rng.poisson(rate_hz * duration_us * 1e-6)
    t = np.sort(rng.integers(0, duration_us, n))
    return Events.of(t, rng.integers(0, 1280, n), rng.integers(0, 720, n), rng.integers(0, 2, n))
