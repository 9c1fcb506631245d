"""Frames to packets."""

from itertools import chain, pairwise

import numpy as np
from hypothesis import given, strategies as st

from evlcp_sdk.rx.packets import PacketAssembler
from evlcp_sdk.values import Frame, Range, SoftSymbols

SENT = 4
SOFT = SoftSymbols(np.zeros(1, np.int64), np.zeros((1, 1), np.float32), 1.0)


def frame(packet, number):
    return Frame(2, packet, number, 0.0, SOFT, Range(1.0, 0.1, 3), None, 0.0, 0.0)


def start_us(packet, number):
    """The start of a packet as one of its frames tells it: each by a little differently."""
    return 1000.0 * packet + 0.25 * number


def fed(numbers):
    """What the assembler gives after each frame, and at the end."""
    assembler = PacketAssembler(SENT)
    given_out = [assembler.add(frame(*n), start_us(*n), 100 + n[1]) for n in numbers]
    last = assembler.flush()
    assert assembler.flush() == []
    return given_out, last


def numbers_of(packets):
    return [(f.packet, f.frame) for p in packets for f in p.frames]


@given(st.sets(st.tuples(st.integers(0, 6), st.integers(0, SENT - 1))).map(sorted))
def test_every_frame_comes_out_once_in_its_packet(numbers):
    given_out, last = fed(numbers)
    packets = [*chain(*given_out), *last]
    assert numbers_of(packets) == numbers
    assert [p.packet for p in packets] == sorted({n for n, _ in numbers})
    for p in packets:
        assert {f.packet for f in p.frames} == {p.packet}
        assert (p.transmitter, p.sent) == (2, SENT)
        # Timing is that of the first frame held.
        first = p.frames[0].frame
        assert (p.t_us, p.chip_us) == (start_us(p.packet, first), 100 + first)


@given(st.sets(st.tuples(st.integers(0, 6), st.integers(0, SENT - 1)), min_size=1).map(sorted))
def test_a_packet_comes_out_as_soon_as_it_is_over(numbers):
    given_out, last = fed(numbers)
    nothing_held = (-1, SENT - 1)
    for (before, now), packets in zip(pairwise([nothing_held, *numbers]), given_out, strict=True):
        cut_short = before[0] != now[0] and before[1] != SENT - 1
        whole = now[1] == SENT - 1
        assert [p.packet for p in packets] == [before[0]] * cut_short + [now[0]] * whole
    assert bool(last) == (numbers[-1][1] != SENT - 1)
