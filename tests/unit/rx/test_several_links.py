"""Several links at once: every region is tried by each, the one that fits gives its packets, and no other."""

from collections import Counter
from dataclasses import replace

import pytest
from rx_streams import frame_content, frames_of, lit, noise_events, receive_cut, right_frames

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import load_link, resolve
from evlcp_sdk.run import receive_to_folder
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.simulated import simulate
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import replace_fields


def named_link(name, **sections):
    return replace(resolve(sections), name=name)


BAR = named_link("bar")
HALF = named_link("half", bar={"rows": 48})
SLOW = named_link("slow", air={"chip_rate_hz": 5000.0})
WH8 = named_link("wh8", modulation={"id": "wh8"})
LEFT, RIGHT = 300.3, 800.7


def light_at(link, x_px, seconds=0.12, start_us=5000.0):
    """A transmitter at a column for some time, and its events."""
    packets = max(int(seconds * link.packet.chip_rate_hz / link.packet.packet_chips), 1)
    return lit(packets, int(x_px), link, x_px=x_px, start_us=start_us, cluster_px=4.0, width_px=2)


def right(packets, link, bar):
    """Frames in a bar's place: all say what it sent, and name its link."""
    here = [p for p in packets if abs(p.frames[0].x_px - bar.x_px) < 50]
    assert {f.link for f in frames_of(here)} == {link.name}
    near_us = 2 * link.packet.chip_us
    return right_frames(here, bar, link, late_us=(-near_us, near_us))


@pytest.mark.parametrize("links", [(BAR, HALF), (WH8, BAR)], ids=lambda links: links[-1].name)
def test_each_transmitter_is_read_by_its_own_link_and_by_no_other(links):
    (one, here), (two, there) = light_at(links[0], LEFT), light_at(links[1], RIGHT)
    receiver, packets = receive_cut(list(links), merge_events(here, there))
    assert right(packets, links[0], one) == len(one.symbols) * 10
    assert right(packets, links[1], two) == len(two.symbols) * 10
    numbers = {p.transmitter: p.link for p in packets}
    assert Counter(numbers.values()) == {link.name: 1 for link in links}
    counts = receiver.counts
    assert counts["frames"] == len(frames_of(packets))
    # Fewer than are told in a warning: before a place is held, other links reject frames there.
    assert counts["frames_rejected"] < 10
    assert receiver.link_counts[links[0].name]["frames"] == 10 * len(one.symbols)


def test_what_is_received_alone_is_the_same_with_another_link_beside():
    events = merge_events(light_at(BAR, LEFT)[1], light_at(BAR, RIGHT)[1], noise_events(20_000, 120_000))
    alone, single = receive_cut(BAR, events)
    _, both = receive_cut([BAR, SLOW], events)
    assert [frame_content(replace_fields(f, link="bar")) for f in frames_of(single)] == [
        frame_content(f) for f in frames_of(both)
    ]
    assert {p.link for p in single} == {""}
    assert {p.link for p in both} == {"bar"}
    assert alone.link_counts == {}


def test_a_place_that_is_left_is_free_for_another_link():
    one, first = light_at(BAR, LEFT, 0.1)
    two, second = light_at(WH8, LEFT, 0.1, start_us=400_000.0)
    packets = receive_cut([BAR, WH8], merge_events(first, second))[1]
    early = [p for p in packets if p.t_us < 300_000]
    late = [p for p in packets if p.t_us > 300_000]
    assert right(early, BAR, one) == len(one.symbols) * 10
    assert right(late, WH8, two) == len(two.symbols) * 10


@pytest.mark.parametrize(
    ("links", "message"),
    [
        ([], "no link: expected one or more"),
        ([BAR, replace(WH8, name="bar")], "two links are named 'bar'"),
        ([BAR, replace(BAR, name="again")], "'bar' and 'again': they send alike"),
        (
            [BAR, named_link("far", camera={"focal_mm": 50.0}, modulation={"id": "wh8"})],
            r"\[camera\] differs",
        ),
        ([BAR, named_link("fine", regions={"step_us": 1000}, modulation={"id": "wh8"})], "step_us = 1500"),
    ],
)
def test_links_that_cannot_be_received_together_are_refused(links, message):
    with pytest.raises(ConfigError, match=message):
        Receiver(links)


@pytest.mark.parametrize("seed", [0, 2])
def test_what_one_lamp_s_link_rejects_in_a_bar_is_the_bar_s(seed, tmp_path):
    """A link of one cluster reads each part of a bar as a lamp, until the bar holds its place.

    In the second scene a region's last frames show that it is a part of another.
    """
    table, raw = tmp_path / "lamp.toml", tmp_path / "scene.raw"
    one = "".join(f"{name} = 1\n" for name in ("rows", "columns", "cluster_rows", "cluster_columns"))
    table.write_text(f"ranging.id = 'none'\n[bar]\n{one}")
    bars = [{"x_m": -1.0}, {"x_m": 1.5, "link": str(table)}]
    scene = {"duration_s": 0.15, "seed": seed, "motion": {"distance_m": 40.0}, "bars": bars}
    simulate(scene).save(raw)
    summary = receive_to_folder(raw, None, [BAR, replace(load_link(table), name="lamp")])
    of_lamp = summary["links"]["lamp"]["counts"]
    assert of_lamp["frames"] > 30
    assert of_lamp["frames_of_others"] > 80
    assert of_lamp["frames_rejected"] < 10
    assert not summary["warnings"]
