"""Any split of a stream gives the same, and a frame is told as soon as its light is there."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rx_streams import LINK, frame_content, frames_of, lit, noise_events, receive_cut

from evlcp_sdk.files import find_shipped_file
from evlcp_sdk.io import read_events
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.rx.limits import Limits
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import AttitudeLog
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import Events

FEW_PILOTS = load_link(overrides=["air.pilot_every=4"])
BAR, WH8 = (replace(resolve({"modulation": {"id": id}}), name=id) for id in ("wh4x2", "wh8"))
LAMP = replace(
    resolve(
        {
            "bar": {"rows": 6, "columns": 1, "cluster_rows": 6, "cluster_columns": 1},
            "framing": {"id": "uart", "parity": "even"},
        }
    ),
    name="lamp",
)
_, OWN = lit(3, ppm=50, shake_px=6, shake_hz=12)
_, OTHER = lit(3, 1, x_px=900.7, y_px=300.2, start_us=19_350)
BOTH = merge_events(OWN, OTHER, noise_events(120_000, 200_000))


def few_pilots():
    return lit(3, link=FEW_PILOTS)[1]


def recording():
    return read_events(find_shipped_file("recordings", "night-50m-30kmh-cut.raw"))


def growing_together():
    """A bar comes nearer to another by a column a step."""
    _, near = lit(3, 2, x_px=440, start_us=10_000)
    x = (near.x - np.minimum(near.t_us // 1500, 40)).astype(np.uint16)
    moved = Events.of(near.t_us, x, near.y, near.p)
    return merge_events(lit(3, 1)[1], moved)


def a_rail():
    """It shows the bar again, cut and with events missing."""
    part = OWN[(OWN.y < 370) & (np.random.default_rng(1).random(len(OWN)) >= 0.4)]
    return merge_events(OWN, Events.of(part.t_us + 7, part.x + 80, part.y + 20, part.p))


def two_links():
    _, lamp = lit(6, link=LAMP, x_px=800.7, cluster_px=4.0, width_px=2)
    return merge_events(lit(2, link=BAR, x_px=300.3)[1], lamp)


def crowd():
    """Eight blinking blobs, a bar and noise: more than small limits let in."""
    small = {"y_px": 120, "cluster_px": 0.6, "width_px": 3}
    blobs = (lit(3, n, x_px=60.0 * n, start_us=300 * n, **small)[1] for n in range(1, 9))
    return merge_events(OWN, *blobs, noise_events(1_700_000, 120_000))


T_US = np.linspace(0, 50_000, 50)
LOG = AttitudeLog(T_US, 3 * np.sin(T_US / 15_000), 0 * T_US, None, np.full(50, 0.2), np.full(50, 0.5))

LIMITED = ("dropped_crowded", "steps_forgotten", "dropped_no_room", "regions_gave_way", "areas_left_out")
SCENES = {
    "two bars": (LINK, lambda: BOTH, {}, {"frames": 60}),
    "few pilots": (FEW_PILOTS, few_pilots, {}, {"frames": 30}),
    "growing together": (LINK, growing_together, {}, {"regions_opened": 2, "regions_released": 1}),
    "a rail": (LINK, a_rail, {}, {"frames_reflected": 30}),
    "two links": ([BAR, WH8, LAMP], two_links, {}, {"packets": 7, "frames_of_others": 1}),
    "small limits": (
        LINK,
        crowd,
        {"limits": Limits(22_000, 1_500_000, 800_000, 6, 5, 4)},
        dict.fromkeys(LIMITED, 1),
    ),
    "a recording": (LINK, recording, {}, {"frames": 20}),
    "an attitude that ends": (LINK, lambda: BOTH, {"attitude": LOG}, {"frames": 60}),
}
"""Links, events, what the receiver is told beside, and what it counts at the least."""


@pytest.mark.parametrize("scene", SCENES)
def test_any_split_gives_the_same(scene):
    """Each frame is told once and in order; it is that of its packet, but for what is known later."""
    link, events, options, least = SCENES[scene]
    events, found = events(), []
    random = [np.random.default_rng(many).integers(0, len(events), many) for many in (3, 40)]
    slices = events.t_us.searchsorted(np.arange(1000, int(events.t_us[-1]), 1000))
    for cuts in ([], *random, slices):
        reports = []
        receiver, packets = receive_cut(link, events, cuts, on_frame=reports.append, **options)
        whole = [
            (p.t_us, p.chip_us, p.link, p.echo_of, [frame_content(f) for f in p.frames]) for p in packets
        ]
        found.append(([frame_content(frame) for frame in reports], whole, receiver.counts))
    assert found[1:] == found[:1] * 3
    counts = receiver.counts
    assert {name: counts[name] for name in least if counts[name] < least[name]} == {}
    assert {frame_content(f)[:-1] for f in frames_of(packets)} <= {frame_content(f)[:-1] for f in reports}
    assert len(reports) == counts["frames"] + counts["frames_at_end"] >= 9
    for number in {f.transmitter for f in reports}:
        order = [(f.packet, f.frame) for f in reports if f.transmitter == number]
        assert order == sorted(set(order))


def lateness(frames, events):
    """How long after the last edge of each frame the events reach that were fed when it was told, us."""
    long_us = LINK.packet.frame_chips * LINK.packet.chip_us
    return [float(events.t_us[fed - 1]) - frame.t_us - long_us for frame, fed in frames]


def frames_by_slices(links, events, slice_us):
    """Frames as they are told, each with how many events were fed by then."""
    cuts = events.t_us.searchsorted(np.arange(0, int(events.t_us[-1]), slice_us)).tolist()
    frames = []
    receiver = Receiver(links, on_frame=lambda frame: frames.append((frame, fed)))
    for begin, fed in pairwise([*cuts, len(events)]):
        receiver.feed(events[begin:fed])
    receiver.close()
    return frames


def test_a_frame_is_given_with_the_slice_that_ends_it():
    frames = frames_by_slices(LINK, BOTH, 250)
    # Those before the first lock have been there for long. Events are 20 to 30 us late; it waits half a chip.
    after = lateness([one for one in frames if one[0].packet > 0], BOTH)
    assert len(after) >= 36
    assert min(after) > 0
    assert max(after) < 100 + 250


def test_frames_from_before_the_first_lock_come_a_few_a_step():
    """Each step gives one frame that ends in it and two older ones, until none is left."""
    _, events = lit(2, start_us=-5_000)
    frames = frames_by_slices(LINK, events, LINK.regions.step_us)
    a_slice = list(Counter(fed for _, fed in frames).values())
    assert a_slice[:3] == [3, 3, 3]
    # A slice may hold the end of one step and what is due in the next.
    assert max(a_slice[3:]) <= 2
    assert [f.frame for f, _ in frames] == [*range(1, 10), *range(10)]


def test_of_several_links_a_frame_comes_at_once_where_its_transmitter_holds_its_place():
    events = merge_events(lit(7, link=BAR, x_px=300.3)[1], lit(7, 1, link=WH8, x_px=800.7)[1])
    frames = frames_by_slices([BAR, WH8], events, 250)
    assert Counter(frame.link for frame, _ in frames) == {"wh4x2": 70, "wh8": 70}
    late_us = [max(lateness([f for f in frames if f[0].packet == n], events)) for n in range(7)]
    # The first packets wait for their judgement, the last ones for nothing.
    assert late_us[0] > 60_000
    assert max(late_us[4:6]) < 100 + 250
