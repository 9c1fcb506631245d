"""Fixes from packets: in time, with sites, beacons and attitudes."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Kind, Message
from evlcp_sdk.air.kinds import BeaconKind
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.place.bar_registry import BarRegistry
from evlcp_sdk.place.error_model import ErrorModel
from evlcp_sdk.place.observations import Candidate, Rejection, project_bars
from evlcp_sdk.place.positioner import Positioner, _to_alternatives
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.scene.bar import BarLayout, LedRing
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.values import Fix, Packet, ReceivedMessage, Trust
from tests.unit.place.place_scenes import frame

CAMERA = CameraModel()
PACKET_US, FRAME_US = 34_600.0, 3200.0
ORIGIN = LocalAxes(35.0, 137.0, 40.0)
EXACT = Attitude(4.0, 1.0, 0.0, 0.0, 0.0)
BAR, RING = BarLayout(), BarLayout(LedRing(leds=16, radius_m=0.45))


def site(number: int, enu_m: tuple[float, float, float], transmitter: int | None = None) -> BarSite:
    return BarSite(number, *map(float, ORIGIN.to_geodetic(enu_m)), transmitter=transmitter)


def camera_at(t_us: float) -> NDArray[np.float64]:
    return np.array([0.0, -50.0 + 8.0 * t_us * 1e-6, -4.0])


def packets_of(bar: BarSite, transmitter: int, count: int, start_us: float = 5000.0,
               messages: dict[int, tuple[ReceivedMessage, ...]] | None = None,
               attitude: Attitude = EXACT, dark: tuple[int, ...] = (),
               enu: NDArray[np.float64] | None = None, link: str = "") -> list[Packet]:  # fmt: skip
    """What a receiver of a bar gives while the camera drives, without noise."""
    enu, found = bar.cluster_positions_m(16, ORIGIN) if enu is None else enu, []
    for n in range(count):
        start, frames = start_us + n * PACKET_US, []
        for k in range(10):
            t_us = start + 3400 + k * FRAME_US
            points, _ = project_bars(enu, camera_at(t_us), attitude.rotation(), CAMERA)
            points[list(dark)] = np.nan
            frames.append(dataclasses.replace(frame(points, 0.1, t_us, transmitter, n, k), link=link))
        heard = (messages or {}).get(n, ())
        found.append(Packet(transmitter, n, start, 100.0, tuple(frames), 10, messages=heard))
    return found


def merge(*streams: list[Packet]) -> list[Packet]:
    return sorted((p for s in streams for p in s), key=lambda p: p.t_us)


def positioner(sites, attitude=EXACT, layout=BAR, link="", **spec: Any) -> Positioner:
    links = {"": dataclasses.replace(resolve({"bar": layout.to_table(), "position": spec}), name=link)}
    return Positioner(links, sites, lambda _t: attitude)


def fixes_of(p: Positioner, packets: list[Packet]) -> list[Fix]:
    return p.feed(packets) + p.close()


def test_a_ring_gives_a_fix_where_its_site_says_how_it_faces() -> None:
    ring = dataclasses.replace(LEFT, length_m=RING.length_m, facing_deg=180.0)
    enu = ring.layout_positions_m(RING, ORIGIN)
    # The camera stands in the south: what it sees to the right is in the east.
    assert enu[4] - enu[12] == pytest.approx([0.9, 0, 0], abs=1e-6)
    assert enu[0] - enu[8] == pytest.approx([0, 0, 0.9], abs=1e-6)
    packets = packets_of(ring, 0, 8, enu=enu)
    assert_right(fixes_of(positioner([ring], layout=RING), packets), 5e-3)
    fixes = fixes_of(positioner([dataclasses.replace(ring, facing_deg=None)], layout=RING), packets)
    assert {f.refusal for f in fixes} == {"no-facing"}
    assert fixes[0].detail == "site of id 7: facing_deg: missing; expected where the LEDs shine to"


def assert_right(fixes: list[Fix], most_m: float = 2e-3) -> None:
    assert fixes
    for fix in fixes:
        assert not fix.refusal, fix.detail
        want = ORIGIN.to_geodetic(camera_at(fix.t_us))
        off = ORIGIN.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height_m) - ORIGIN.to_enu(*want)
        assert np.abs(off).max() < most_m


LEFT, RIGHT = site(7, (-2.0, 0.0, 0.0), 0), site(9, (2.0, -6.0, 0.0), 1)


def test_bars_of_two_links_give_one_fix() -> None:
    """A bar of 16 clusters, and one of half the length, of eight, whose packets are longer."""
    short = resolve({"bar": {"rows": 48}, "air": {"frames_per_packet": 13}})
    right = dataclasses.replace(RIGHT, length_m=0.48, transmitter_id=7, link="short")
    left = dataclasses.replace(LEFT, link="long")
    gravity = Attitude(4.0, 1.0, None, 0.0)
    links = {"long": resolve({}), "short": short}
    one, lamp = packets_of(LEFT, 0, 8, link="long"), packets_of(LEFT, 2, 8, link="lamp")
    other = packets_of(right, 1, 8, enu=right.cluster_positions_m(8, ORIGIN), link="short")
    p = Positioner(links, [right, left], lambda _t: gravity)
    fixes = fixes_of(p, merge(one, other, lamp))
    assert_right(fixes)
    assert [fix.transmitters for fix in fixes] == [(0, 1)] * len(fixes)
    assert p.links_of(fixes[0]) == "long short"
    assert p.counts["frames_late"] == 0
    # The longest packets make the grid.
    assert np.diff([fix.t_us for fix in fixes]) == pytest.approx(short.packet.packet_us)
    # The same fixes, packet by packet.
    again = Positioner(links, [right, left], lambda _t: gravity)
    pieces = [fix for packet in merge(one, other, lamp) for fix in again.feed([packet])] + again.close()
    assert [fix.enu_m.tolist() for fix in pieces] == [fix.enu_m.tolist() for fix in fixes]
    # Both have the number of the site, which names neither: each bar is where its own link stands.
    elsewhere = dataclasses.replace(left, link="short", transmitter=0)
    alone = fixes_of(Positioner(links, [elsewhere], lambda _t: gravity), one)
    assert {fix.refusal for fix in alone} == {"no-site"}


def test_one_bar_gives_a_fix_a_packet_time() -> None:
    unknown = positioner([LEFT])
    fixes = fixes_of(unknown, packets_of(RIGHT, 3, 4))
    assert {(f.refusal, f.transmitters) for f in fixes} == {("no-site", (3,))}
    assert fixes[0].detail == "no site is known of transmitter 3 (id not received)"
    assert unknown.counts["refused"] == len(fixes)
    p = positioner([LEFT])
    fixes = fixes_of(p, packets_of(LEFT, 0, 8))
    assert_right(fixes)
    assert [f.t_us for f in fixes] == [PACKET_US * n for n in range(1, 9)]
    assert p.counts == {"fixes": 8, "refused": 0, "frames_late": 0, "beacons_forged": 0}
    assert (fixes[0].pitch_deg, fixes[0].roll_deg) == pytest.approx((4, 1))
    assert math.remainder(fixes[0].heading_deg, 360) == pytest.approx(0, abs=1e-6)
    assert not fixes[0].verified
    # Dark clusters, and a gap in time.
    fixes = fixes_of(positioner([LEFT]), packets_of(LEFT, 0, 4, dark=(2, 9)) + packets_of(LEFT, 0, 4, 1e6))
    assert len(fixes) == 8
    assert_right(fixes)


def test_two_bars_of_other_phases_give_the_heading() -> None:
    turned = Attitude(4.0, 1.0, 359.0, 0.0, 0.0)
    p = positioner([LEFT, RIGHT], Attitude(4.0, 1.0, None, 0.0))
    left, right = packets_of(LEFT, 0, 8, attitude=turned), packets_of(RIGHT, 1, 8, 21_000.0, attitude=turned)
    fixes = fixes_of(p, merge(left, right))
    both = [f for f in fixes if f.transmitters == (0, 1) and not f.refusal]
    assert len(both) >= 6
    assert_right(both, 5e-3)
    assert both[0].heading_deg == pytest.approx(359, abs=2e-3)
    alone = [f for f in fixes if f.refusal]
    assert {f.refusal for f in alone} <= {"heading-unknown"}
    assert all(math.isnan(f.latitude_deg) for f in alone)


def test_gravity_and_north_are_those_of_the_place_not_of_the_first_site() -> None:
    # 30 km away, the vertical leans by 0.27 degrees and north by 0.2.
    far = site(99, (-30_000.0, 10_000.0, 0.0))
    p = positioner([far, LEFT])
    fixes = fixes_of(p, packets_of(LEFT, 0, 6))
    assert_right(fixes)
    assert p.axes == LocalAxes.of([far])
    assert abs(math.remainder(fixes[0].heading_deg, 360)) < 1e-3
    # The covariance turns along: its size stays, its axes are those of the track's frame.
    plain = fixes_of(positioner([LEFT]), packets_of(LEFT, 0, 6))
    here = LocalAxes.of([LEFT])
    turn = LocalAxes.of([far]).rotation_from(here)
    np.testing.assert_allclose(fixes[1].covariance_m2, turn @ plain[1].covariance_m2 @ turn.T, atol=1e-9)


@pytest.mark.parametrize("known_from", [0, 2])
def test_a_mirror_image_is_no_bar(known_from: int) -> None:
    """The bar's image in a wet road, upside down under it, repeats its beacon; fixes are those of the bar."""
    reported = {n: (received_beacon(LEFT, "verified", 0),) for n in range(8)}
    own = packets_of(LEFT, 0, 8, messages=reported)
    image = []
    for n, packet in enumerate(packets_of(LEFT, 1, 8, messages=reported)):
        echo_of = 0 if n >= known_from else None
        frames = tuple(
            dataclasses.replace(f, echo_of=echo_of, points_px=f.points_px * [1, -1] + [0, 1100])
            for f in packet.frames
        )
        image.append(dataclasses.replace(packet, frames=frames, messages=() if echo_of == 0 else reported[0]))
    # No site names a transmitter, so that only a bar that is alone stands there by its number.
    want, both = fixes_of(positioner([LEFT]), own), positioner([LEFT])
    fixes = fixes_of(both, merge(own, image))
    # A fix waits for half a packet on both sides.
    late = [f for f in fixes if f.t_us > known_from * PACKET_US]
    assert_right(late)
    assert {f.transmitters for f in late} == {(0,)}
    assert [repr(f) for f in late] == [repr(f) for f in want[-len(late) :]]
    assert set(both.bars.known_sites) == {0}


def received_beacon(bar: BarSite, trust: Trust, packet: int) -> ReceivedMessage:
    names = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "tilt_deg", "length_m")
    beacon = Beacon(*(getattr(bar, name) for name in names))
    message = Message(Kind.BEACON, bar.transmitter_id, packet, beacon.pack())
    why = "" if trust == "verified" else "why"
    return ReceivedMessage(0, packet, 0.0, message, BeaconKind(), beacon, trust, why)


def test_beacons_tell_who_and_where() -> None:
    # The id decides, not the receiver's number, which is the other bar's here.
    reported = {0: (received_beacon(RIGHT, "unverified", 0),)}
    fixes = fixes_of(positioner([LEFT, RIGHT]), packets_of(RIGHT, 0, 6, messages=reported))
    assert_right(fixes)
    assert not any(f.verified for f in fixes)
    # Without a file, a verified beacon's own place is believed, until one is forged.
    reported = {0: (received_beacon(RIGHT, "verified", 0),), 4: (received_beacon(LEFT, "forged", 4),)}
    p = positioner([])
    fixes = fixes_of(p, packets_of(RIGHT, 0, 9, messages=reported))
    given = [f for f in fixes if not f.refusal]
    assert_right(given)
    assert all(f.verified for f in given)
    # What is said in packet 4 counts for fixes that are not out yet.
    assert 1 <= len(given) <= 4
    assert {f.refusal for f in fixes[len(given) :]} == {"no-site"}
    assert p.counts["beacons_forged"] == 1


@pytest.mark.parametrize(
    ("beacons", "messages", "known"),
    [
        ("verified", [(RIGHT, "verified", 0)], "+"),
        ("verified", [(RIGHT, "unverified", 0)], "-"),
        ("any", [(RIGHT, "unverified", 0)], "?"),
        ("none", [(RIGHT, "verified", 0)], "-"),
        # Who has signed once is not moved by one who does not.
        ("verified", [(RIGHT, "verified", 0), (LEFT, "unverified", 1), (LEFT, "forged", 2)], "++-"),
        ("any", [(RIGHT, "forged", 0), (RIGHT, "unverified", 1), (RIGHT, "verified", 2)], "--+"),
        # The same beacon when its key was not valid any more; a renewed one counts again.
        *(
            (believed, [(RIGHT, "verified", 0), (RIGHT, "unverified", 0), (LEFT, "unverified", 1),
                        (RIGHT, "verified", 2)], known)
            for believed, known in (("verified", "+--+"), ("any", "+??+"))
        ),
    ],
)  # fmt: skip
def test_which_beacons_are_believed(beacons, messages, known) -> None:
    """After each message: `+` its place is known and verified, `?` known, `-` not."""
    registry = BarRegistry([], ErrorModel(beacons=beacons))
    for message, mark in zip(messages, known, strict=True):
        registry.add_packet(Packet(0, 0, 0.0, 100.0, (), 10, messages=(received_beacon(*message),)))
        found = registry.site_of(0)
        assert (found is None) == (mark == "-")
        if found is not None:
            assert registry.is_verified(0) == (mark == "+")
            place = ORIGIN.to_enu(found.latitude_deg, found.longitude_deg, found.height_m)
            assert place == pytest.approx([2.0, -6.0, 0.0], abs=0.01)


def test_sites_that_are_mixed_up_are_contradicted_by_beacons() -> None:
    """From behind two bars the image of swapped ones is the same; what they say of themselves tells."""
    gravity = Attitude(4.0, 1.0, None, 0.0, 0.0)
    swapped = [dataclasses.replace(LEFT, transmitter_id=9), dataclasses.replace(RIGHT, transmitter_id=7)]
    reported = [{0: (received_beacon(bar, "unverified", 0),)} for bar in (LEFT, RIGHT)]
    stream = merge(
        packets_of(LEFT, 0, 6, messages=reported[0]), packets_of(RIGHT, 1, 6, messages=reported[1])
    )
    right = positioner([LEFT, RIGHT], gravity)
    assert_right(fixes_of(right, stream))
    assert right.bars.contradictions == {}
    wrong = positioner(swapped, gravity)
    fixes = fixes_of(wrong, stream)
    assert {f.refusal for f in fixes} == {"site-contradicted"}
    assert "transmitter 0 says that it is 7.2 m from the site of its id" in fixes[0].detail
    assert wrong.bars.known_sites == {}
    assert set(wrong.bars.contradictions) == {0, 1}
    # Whoever knows better than the beacons says so; nothing in the image could.
    alone = positioner(swapped, gravity, beacons="none")
    assert not any(f.refusal for f in fixes_of(alone, stream))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"length_m": 1.92}, "0.96 m long, its site 1.92 m"),
        ({"length_m": 0.965}, None),
        ({"height_m": LEFT.height_m + 1.5}, "1.5 m from the site"),
        ({"height_m": LEFT.height_m + 0.9}, "0.9 m from the site"),
        ({"height_m": LEFT.height_m + 0.9, "position_sigma_m": 0.3}, None),
        ({"height_m": LEFT.height_m + 0.3}, None),
    ],
)
def test_a_bar_that_is_not_its_site(change: dict[str, float], expected: str | None) -> None:
    """A lone bar of the wrong length or place fits the image as well as the right one."""
    registry = BarRegistry([dataclasses.replace(LEFT, **change)], ErrorModel())
    registry.add_packet(Packet(0, 0, 0.0, 100.0, (), 10, messages=(received_beacon(LEFT, "unverified", 0),)))
    assert (registry.site_of(0) is None) == (expected is not None)
    assert (expected or "") in registry.contradiction_of(0)
    assert bool(expected) == bool(registry.contradiction_of(0))


def test_an_attitude_file(tmp_path: Path) -> None:
    path = tmp_path / "attitude.csv"
    # As a spreadsheet writes it.
    text = "t_us,heading_deg,pitch_deg,roll_deg,heading_sigma_deg\n0,359,1,-1,0.2\n1000,1,3,-1,0.4\n"
    path.write_text(text, encoding="utf-8-sig")
    # What the file has not are those that are said.
    track = AttitudeLog.read(path, Attitude(gravity_sigma_deg=0.7, heading_sigma_deg=3.0))
    found = track.interpolate(500)
    assert (found.pitch_deg, found.roll_deg, found.heading_deg) == pytest.approx((2, -1, 0))
    assert (found.gravity_sigma_deg, found.heading_sigma_deg) == pytest.approx((0.7, 0.3))
    assert track.interpolate(1001) is None
    path.write_text("t_us,pitch_deg,roll_deg\n0,1,2\n")
    with pytest.raises(ConfigError, match="two lines or more with rising t_us"):
        AttitudeLog.read(path)


def test_a_bar_off_its_site_is_off_in_the_track_s_axes() -> None:
    """Left out by the two others, far from the track's origin."""
    third = site(11, (0.5, 3.0, 1.5), 2)
    p = positioner([LEFT, RIGHT, site(11, (1.5, 3.0, 1.9), 2)], Attitude(4.0, 1.0, 0.0, 0.1, 0.2))
    p.axes = LocalAxes(10.0, 60.0, 40.0)
    fix = fixes_of(p, merge(*(packets_of(bar, n, 3) for n, bar in enumerate((LEFT, RIGHT, third)))))[1]
    assert fix.failed is not None
    assert fix.failed.off_m @ p.axes.rotation_from(ORIGIN) == pytest.approx([-1.0, 0.0, -0.4], abs=1e-3)


def test_the_focal_length_that_would_fit_is_found() -> None:
    p = Positioner({"": resolve({"camera": {"focal_mm": 50.0}})}, [LEFT, RIGHT], lambda _t: EXACT)
    assert math.isnan(p.search_focal_mm())
    fixes = fixes_of(p, merge(packets_of(LEFT, 0, 3), packets_of(RIGHT, 1, 3)))
    assert {fix.refusal for fix in fixes} == {"misfit"}
    assert p.search_focal_mm() == pytest.approx(CAMERA.focal_mm, rel=0.01)


def test_poses_that_are_left_open_are_reported_on_earth() -> None:
    here, axes = LocalAxes(35.2, 137.1, 60.0), LocalAxes(35.0, 137.0, 50.0)
    spread = np.diag([1.0, 4.0, 9.0])
    open_one = Candidate(np.array([5.0, 6.0, 7.0]), Attitude(1.0, 2.0, 30.0).rotation(), spread, 0.5)
    (found,) = _to_alternatives(Rejection("two-solutions", "", (open_one,)), here, axes)
    place = here.to_enu(found.latitude_deg, found.longitude_deg, found.height_m)
    np.testing.assert_allclose(place, [5, 6, 7], atol=1e-6)
    np.testing.assert_allclose(axes.to_geodetic(found.enu_m)[2], found.height_m, atol=1e-6)
    assert (found.heading_deg, found.likelihood) == (pytest.approx(30), 0.5)
    assert np.linalg.eigvalsh(found.covariance_m2) == pytest.approx([1, 4, 9])
