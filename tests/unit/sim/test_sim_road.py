"""What a road adds: images, covers, wiper, bloom, potholes, background; against other ways to them."""

import json
import math
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import (
    BackgroundSpec,
    BarSpec,
    DropSpec,
    LampSpec,
    MotionSpec,
    ReflectionSpec,
    Scene,
    SensorSpec,
    Simulation,
    WiperSpec,
    resolve_scene,
    truth_of,
)
from evlcp_sdk.sim.leds import draw_led_light
from evlcp_sdk.sim.light import BarLight, Source, wiper_switches
from evlcp_sdk.sim.motion import pothole_angle_rad
from evlcp_sdk.sim.scene import LensSpec
from evlcp_sdk.values import Events
from tests.models.pixels import serve_requests, words_of
from tests.unit.sim.scenes import EXACT, STILL, check_alike, every, rows, still_scene

EVEN = BackgroundSpec(light_w_m2=0.3, texture=0.0)
FOCAL_PX = Scene().camera.focal_px

Floats = NDArray[np.float64]


@pytest.mark.parametrize(
    ("image", "place"),
    [
        # The bar is 0.96 m long: from its middle, 0.48 + 0.3 + 0.48 m down.
        (ReflectionSpec("road", share=0.25, gap_m=0.3), {"y_m": 1.26, "chips_file": "upside-down.npy"}),
        (ReflectionSpec("rail", share=0.25, gap_m=0.4), {"x_m": -1.1}),
        (ReflectionSpec("window", share=0.25, shift_px=(0.4 / 50 * FOCAL_PX, 0.0)), {"x_m": -1.1}),
    ],
    ids=["road", "rail", "window"],
)
def test_an_image_is_a_dimmer_bar_at_another_place(image, place, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    sent = np.random.default_rng(5).integers(0, 2, (100, 16))
    np.save("chips.npy", sent)
    np.save("upside-down.npy", sent[:, ::-1])
    first = BarSpec(chips_file="chips.npy", start_chip=0.0, led_w_m2=40.0)
    scene = still_scene(0.01, background=EVEN, bars=(first,))
    second = replace(first, led_w_m2=10.0, **place)
    check_alike(every(replace(scene, reflections=(image,))), every(replace(scene, bars=(first, second))))


def test_a_window_turns_the_light() -> None:
    image = ReflectionSpec("window", turn_deg=(0.4, -0.2))
    scene = Scene(motion=STILL, reflections=(image,))
    table = truth_of(scene).table
    (ghost,) = table["others"]
    (column, row), (ghost_column, ghost_row) = (
        [axis[0] for axis in place] for place in (table["bar_centre_px"][0], ghost.pop("centre_px"))
    )
    turned = FOCAL_PX * math.tan(math.atan((column - 640) / FOCAL_PX) + math.radians(0.4))
    assert ghost_column - 640 == pytest.approx(turned, abs=0.02)
    # Off the axis, the same angle is a little more: by 1 / cos.
    assert ghost_row - row == pytest.approx(-math.radians(0.2) * FOCAL_PX, rel=2e-3)
    assert ghost == {"kind": "ghost", "src": 0, "gain": 0.2}


def level_at(source: Source, t_us: float) -> Floats:
    """What each part of a source gives at a time from 1 to 5 ms."""
    when, levels = source.switches(1000.0, 5000.0)
    return levels[np.searchsorted(when, t_us, side="right")]


def test_covers_put_out_clusters_and_only_those() -> None:
    covers = {"covered": (3,), "cover_s": ((0.0012, 0.0033, 6, 8),), "pole_s": ((0.004, 0.0041),)}
    plain, hidden = (
        BarLight(BarSpec(start_chip=2.3, **more), resolve({}), LensSpec(), 7, reflections=[ReflectionSpec()])
        for more in ({}, covers)
    )
    for t_us in (1000.0, 1199.9, 1200.0, 3299.9, 3300.1, 4050.0, 4100.1, 4999.0):
        want = level_at(plain.strips[0], t_us).copy()
        want[3] = 0
        if 1200 <= t_us < 3300:
            want[6:9] = 0
        if 4000 <= t_us < 4100:
            want[:] = 0
        assert (level_at(hidden.strips[0], t_us) == want).all()
        assert (level_at(hidden.images[0], t_us) == level_at(plain.images[0], t_us)).all()
    # However time is cut, it is switched at the same times.
    cuts = [1000.0, 1200.0, 2717.3, 5000.0]
    parts = [hidden.strips[0].switches(*span)[0] for span in pairwise(cuts)]
    assert {*np.concatenate(parts), 1200.0} == set(hidden.strips[0].switches(1000.0, 5000.0)[0])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"covered": (16,)}, "covered = [16]: expected clusters, 0 to 15"),
        ({"dead_leds": (96,)}, "dead_leds = [96]: expected LEDs, 0 to 95"),
        ({"dead_leds": (1,), "stuck_leds": (2, 1)}, "stuck_leds = [2, 1]: expected each LED once, either"),
        ({"lattice_m": (0.1, 0.1, 0.0)}, "lattice_m = [0.1, 0.1, 0.0]: expected [every, width, first], with"),
        ({"lattice_mps": 0.3}, "lattice_mps = 0.3: expected lattice_m beside it"),
    ],
)
def test_what_cannot_hide_a_bar_is_reported(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as fault:
        BarLight(BarSpec(**keys), resolve({}), LensSpec(), 7)
    assert message in str(fault.value)


def test_leds_are_dead_stuck_dim_or_behind_slats() -> None:
    dead, stuck = (5, *range(12, 18), 40), (3, 41)
    bar = BarSpec(start_chip=2.3, dead_leds=dead, stuck_leds=stuck, led_spread=0.3)
    bar = replace(bar, lattice_m=(0.09, 0.033, 0.02), lattice_mps=2.0)
    light, plain = (BarLight(one, resolve({}), LensSpec(), 7) for one in (bar, BarSpec(start_chip=2.3)))
    assert light.dark == {2}
    assert truth_of(Scene(bars=(bar,))).bars[0].covered == (2,)
    own = draw_led_light(bar, 96, 7)
    assert np.log(own.sum(0)[own.sum(0) > 0]).std() == pytest.approx(0.3, abs=0.06)
    places_m = (np.arange(96)[:, None] + np.linspace(0, 1, 200, endpoint=False)) / 100
    for t_us in (1000.0, 1333.3, 2718.2, 4999.0):
        # They pass by 2 mm in a millisecond, and move in steps of 1 mm.
        moved_m = math.floor(t_us * 2e-3) * 1e-3
        free = ((places_m - 0.02 - moved_m) % 0.09 >= 0.033).mean(1)
        want = (own[0] * np.repeat(level_at(plain.strips[0], t_us), 6) + own[1]) * free
        found = level_at(light.strips[0], t_us)
        np.testing.assert_allclose(found, want, atol=0.02)
        assert not found[list(dead)].any()
        # However time is cut, it is the same light.
        np.testing.assert_allclose(light.strips[0].switches(t_us, t_us + 1.0)[1][0], found, atol=1e-9)


def test_a_drop_bends_what_is_seen_through_it() -> None:
    drop = DropSpec(660.0, 350.0, 20.0, 5.0, (500.0, 0.0))
    for dx, dy in ((10.0, 0.0), (-12.0, 16.0), (0.0, 2.0)):
        x, y = (660.0 - 640 + dx) * 50 / FOCAL_PX, (350.0 - 360 + dy) * 50 / FOCAL_PX
        lamp = LampSpec(x, y, 0.0, 0.005, 0.005, flicker_hz=1000.0)
        events = every(still_scene(0.0039, background=EVEN, bars=(), lamps=(lamp,), drops=(drop,)))
        # Where the formula puts it, by iteration: in the first 4 ms the drop is 1 px farther on.
        seen = at = np.array([dx - 1.0, dy]) / 20
        for _ in range(200):
            seen = at + 0.25 * seen * np.exp(0.5 - 0.5 * (seen @ seen))
        centre = np.array([661.0, 350.0]) + seen * 20
        np.testing.assert_allclose([events.x.mean(), events.y.mean()], centre, atol=0.4)


def test_background_that_changes_gives_the_events_of_its_contrast() -> None:
    background = BackgroundSpec(
        light_w_m2=0.1, texture=0.0, change_s=((0.004, 1.0), (0.014, 300.0), (0.016, 30.0)), around_px=40
    )
    camera = CameraModel(width=40, height=4)
    events = every(still_scene(0.03, camera=camera, background=background, bars=()))
    rising, falling = events[events.p == 1], events[events.p == 0]
    # A pixel forgets what the light rises by while it is blind, 10 us, and a dark one is late.
    each_us = 0.223 / math.log(300) * 10_000 + 10
    assert len(rising) == 160 * math.floor(10_000 / each_us)
    # One is under way at the turn, and what falls within a blind time is forgotten.
    assert math.log(10) / 0.223 - 3 < len(falling) / 160 < math.log(10) / 0.223
    # The logarithm rises evenly: so do the events come.
    np.testing.assert_allclose(np.diff(np.unique(rising.t_us))[3:], each_us, rtol=0.04)


def test_a_camera_turns() -> None:
    motion = replace(STILL, yaw_deg=2.0, yaw_rate_deg_s=-45.0)
    column = truth_of(Scene(duration_s=0.08, motion=motion)).bars[0].centre_px[:, 0]
    yaw = np.radians(2.0 - 45e-3 * np.arange(80))
    np.testing.assert_allclose(column, 640 + FOCAL_PX * np.tan(np.arctan2(-1.5, 50) - yaw), atol=1e-2)


def test_a_wiper_dims_along_its_line() -> None:
    wiper = WiperSpec(share=0.96, at_s=0.01, lasts_s=0.03, edge_s=0.008, every_s=0.1)
    when, share = wiper_switches(wiper, 0.0, 3e5)
    t = np.linspace(1, 3e5 - 1, 20_011)
    after = np.mod(t / 1e6 - 0.01, 0.1)
    line = 1 - 0.96 * np.clip(np.minimum(after, 0.03 - after) / 0.008, 0, 1)
    found = share[np.searchsorted(when, t, side="right")]
    assert np.abs(np.log(found / line)).max() < 0.026
    assert found.min() == pytest.approx(0.04)
    assert share[0] == share[-1] == 1
    for a, b in ((0.0, 3e5), (12_345.6, 34_567.8), (103_000.0, 103_100.0), (2e5, 2.01e5)):
        part_when, part = wiper_switches(wiper, a, b)
        inside = (when > a) & (when < b)
        assert (part_when == when[inside]).all()
        assert part[0] == share[int((when <= a).sum())]
        assert (part[1:] == share[1:][inside]).all()
    once = wiper_switches(replace(wiper, every_s=0.0), 0.0, 3e5)[0]
    assert (once == when[when < 50_000]).all()


def test_a_pothole_strikes_rings_and_decays() -> None:
    motion = MotionSpec(vib_rate_rad_s=0.0, pothole_s=(0.05, 0.3), pothole_rad_s=0.8, pothole_hz=15.0)
    t_us = np.arange(0, 2e6, 10.0)
    angle = pothole_angle_rad(motion, t_us)
    rate = np.gradient(angle, 1e-5)
    turn, decay = 2 * math.pi * 15, motion.pothole_decay_s
    want = np.zeros(len(t_us))
    for begin in motion.pothole_s:
        after = t_us * 1e-6 - begin
        ringing = np.exp(-after / decay) * (np.cos(turn * after) - np.sin(turn * after) / (turn * decay))
        want += np.where(after >= 0, 0.8 * ringing, 0.0)
    kinks = np.isin(np.arange(len(t_us)), [4999, 5000, 5001, 29_999, 30_000, 30_001])
    np.testing.assert_allclose(rate[1:-1][~kinks[1:-1]], want[1:-1][~kinks[1:-1]], atol=2e-3)
    assert not angle[t_us <= 50_000].any()
    assert abs(angle[-1]) < 1e-6
    place = truth_of(Scene(duration_s=0.1, motion=replace(motion, speed_mps=0.0))).bars[0].centre_px
    assert np.diff(place[:, 1])[50] == pytest.approx(0.8 * FOCAL_PX / 1000, rel=0.03)


def panning_scene(tmp_path: Path, **background: Any) -> Scene:
    """A camera that turns to the right by 0.3 degrees in 40 ms, and then rests."""
    lines = ["t_s,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg"]
    lines += [f"{t},0,0,-50,{min(t, 0.04) * 7.5},0,0" for t in np.arange(0, 0.0601, 0.002)]
    (tmp_path / "path.csv").write_text("\n".join(lines))
    motion = MotionSpec(vib_rate_rad_s=0.0, path_file=str(tmp_path / "path.csv"))
    return Scene(
        duration_s=0.06,
        camera=CameraModel(width=160, height=100),
        sensor=replace(EXACT, refr_us=1.0),
        motion=motion,
        background=BackgroundSpec(light_w_m2=5.0, **background),
        bars=(),
    )


def test_texture_that_moves_gives_the_events_of_its_own_contrast(tmp_path: Path) -> None:
    scene = panning_scene(tmp_path, texture=0.8, texture_px=8.0, texture_step_px=0.1, around_px=160)
    simulation = Simulation(scene)
    events = Events.concat(list(simulation.stream()))
    net, count = np.zeros((2, 100, 160))
    np.add.at(net, (events.y, events.x), np.where(events.p == 1, 1, -1))
    np.add.at(count, (events.y, events.x), 1)
    turned = math.radians(0.3) * FOCAL_PX
    field = simulation._texture
    spots = [(int(x), int(y)) for x, y in np.random.default_rng(1).integers(0, (160, 100), (300, 2))]
    for x, y in spots:
        across = x + np.linspace(0, turned, 400)
        path = np.log(map_coordinates(field, [np.full(400, y), across], order=1, mode="grid-wrap"))
        # A pixel without noise counts thresholds: one may be under way, and each is passed by up to a step.
        assert abs(net[y, x] * 0.223 - (path[-1] - path[0])) < 0.223 + 0.02 * (1 + count[y, x])
        assert count[y, x] * 0.223 <= np.abs(np.diff(path)).sum() + 0.05
    assert count.mean() > 1


def test_background_is_simulated_around_the_sources() -> None:
    scene = still_scene(
        0.02,
        motion=replace(STILL, vib_rate_rad_s=0.3),
        background=BackgroundSpec(3.0, texture=1.0, texture_px=4.0, around_px=60, texture_step_px=0.2),
        bars=(BarSpec(led_w_m2=10.0),),
    )
    events = every(scene)
    centre = truth_of(scene).bars[0].centre_px.mean(0)
    away = np.abs(events.x - centre[0])
    assert 60 <= away.max() < 60 + 25
    assert (away > 30).sum() > 1000
    # A background at rest has no events, and leaves the bar's as they are.
    scene = replace(scene, motion=STILL)
    alone = replace(scene, background=replace(scene.background, around_px=0))
    assert rows(every(scene)) == rows(every(alone))


def test_all_that_a_road_adds_does_not_depend_on_threads_or_length() -> None:
    scene = resolve_scene(
        {
            "duration_s": 0.012,
            "motion": {"pothole_s": [0.003]},
            "wiper": {"share": 0.9, "at_s": 0.002, "lasts_s": 0.01},
            "lens": {"bloom": 0.1, "bloom_px": 5.0},
            "background": {"around_px": 20, "light_w_m2": 0.5, "change_s": [[0.001, 1.0], [0.006, 5.0]]},
            "bars": [{"cover_s": [[0.002, 0.006, 0, 4]], "lattice_m": [0.1, 0.03, 0], "dead_leds": [7]}],
            "drops": [{"x_px": 420.0, "y_px": 360.0, "speed_px_s": [200.0, 0.0]}],
            "reflections": [{}, {"kind": "rail"}, {"kind": "window", "shift_px": [5, 5]}],
        }
    )
    events = every(scene)
    assert rows(events) == rows(every(scene, threads=3))
    long = every(replace(scene, duration_s=0.014))
    until = 7_900
    assert rows(events[events.t_us < until]) == rows(long[long.t_us < until])
    table = json.loads(json.dumps(truth_of(scene).table))
    assert resolve_scene(table["simulator"]) == scene
    assert resolve_scene(json.loads(json.dumps(asdict(scene)))) == scene


def held_twin(t: Floats, y: Floats, x: Floats, row_us: float) -> list[tuple[int, int, int]]:
    """Row after row, a plain loop: a pixel's request that comes while one of it waits is not there."""
    todo, waiting, found = list(zip(t.tolist(), y.tolist(), x.tolist(), strict=True)), {}, []
    free, row = 0.0, -1
    while todo or waiting:
        if not waiting:
            free = max(free, todo[0][0])
        while todo and todo[0][0] <= free:
            _, at, column = todo.pop(0)
            waiting.setdefault((at, column), True)
        row = next(r % 30 for r in range(row + 1, row + 31) if any(at == r % 30 for at, _ in waiting))
        free += row_us
        for key in sorted(key for key in waiting if key[0] == row):
            found.append((math.floor(free), *key))
            del waiting[key]
    return found


def test_a_pixel_that_waits_for_the_readout_sends_no_other() -> None:
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0, 400, 3000))
    y, x = rng.integers(0, 30, 3000), rng.integers(0, 6, 3000)
    want = held_twin(t, y, x, 1.3)
    assert 500 < len(want) < 2500
    for cuts in ([math.inf], [100.0, 101.5, 260.0, math.inf]):
        memory, pending, found, blind = np.array([-1e18, -1.0, -1.0, 0.0]), np.zeros((30, 8), bool), [], 0
        words = words_of(t, y, x)
        rest, before = words[:0], 0.0
        for safe in cuts:
            new = (t >= before) & (t < safe)
            before, rest = safe, np.concatenate([rest, words[new]])
            events, _, held, left = serve_requests(
                rest, 30, 1.3, until_us=safe, memory=memory, pending=pending
            )
            rest, blind = rest[:left], blind + held
            found += list(zip(events.t_us.tolist(), events.y.tolist(), events.x.tolist(), strict=True))
            assert not pending.any()
        assert sorted(found) == sorted(want)
        assert blind + len(found) == 3000
    scene = Scene(duration_s=0.02, sensor=replace(SensorSpec(), t_row_us=1.0, hold=True))
    events = every(scene)
    assert len({row[:3] for row in rows(events)}) == len(events)
