"""What tests of the receiver share: a stream in pieces, and all that is said of it."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.recordings import IdealBar
from evlcp_sdk.values import Events, Frame, Packet

LINK = load_link()


def received(
    link: Link | list[Link], events: Events, cuts: Iterable[int] = (), **options: Any
) -> tuple[Receiver, list[Packet]]:
    """A receiver after a stream that is cut before these events, and its packets.

    What algorithms of the SDK give is checked, too, as strangers' is.
    """
    links = [replace(one, built_in=frozenset()) for one in (link if isinstance(link, list) else [link])]
    receiver = Receiver(links if isinstance(link, list) else links[0], **options)
    packets: list[Packet] = []
    for begin, end in pairwise([0, *sorted(cuts), len(events)]):
        packets += receiver.feed(events[begin:end])
    return receiver, packets + receiver.close()


def frames_of(packets: list[Packet]) -> list[Frame]:
    return [frame for packet in packets for frame in packet.frames]


def said(frame: Frame) -> tuple[object, ...]:
    """All of a frame, to the last bit."""
    soft = frame.soft
    return (
        *(frame.transmitter, frame.packet, frame.frame, frame.t_us, frame.x_px, frame.y_px, frame.link),
        *(soft.symbols.tobytes(), soft.llr.tobytes(), soft.quality, repr(frame.range), repr(frame.filtered)),
        *(frame.points_px.tobytes(), frame.points_sigma_px.tobytes(), frame.points_t_us, frame.echo_of),
    )


def right_frames(
    packets: list[Packet],
    bar: IdealBar,
    link: Link = LINK,
    *,
    t0_us: int = 0,
    late_us: tuple[float, float] = (0, 60),
) -> int:
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
