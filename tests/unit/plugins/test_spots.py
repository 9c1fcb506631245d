"""The detection of single lights, beside places that are told."""

import numpy as np
import pytest
from evlcp_regions.spots import Spots

from evlcp_sdk.link.resolve import resolve
from evlcp_sdk.testing.recordings import merge_events
from evlcp_sdk.values import Events

ONE = {"rows": 1, "columns": 1, "cluster_rows": 1, "cluster_columns": 1}
STEP_US = 1500


def link_of(rate_hz):
    return resolve({"bar": ONE, "air": {"chip_rate_hz": rate_hz}, "framing": {"id": "uart"}})


def shaking(t_us):
    """Where a light is in the image of a camera that shakes, up to 1 px a ms fast."""
    t = t_us * 1e-6
    return 600 + 25 * np.sin(2 * np.pi * 4 * t), 300 + 12 * np.sin(2 * np.pi * 9 * t + 1)


def events_of(rng, rate_hz, seconds, burst, noise_hz):
    """Bursts of a light of random bits with a spread of 3 px, dark for many bits, and noise all over."""
    bits = np.repeat(rng.integers(0, 2, int(seconds * rate_hz)), rng.integers(1, 6, int(seconds * rate_hz)))
    edges = np.flatnonzero(np.diff(bits)) + 1
    edges = edges[edges < seconds * rate_hz]
    late = rng.exponential(80.0, (len(edges), burst)) + 20
    t = (edges[:, None] / rate_hz * 1e6 + late).ravel()
    x, y = shaking(t)
    x, y = x + 3 * rng.standard_normal(len(t)), y + 3 * rng.standard_normal(len(t))
    p = np.repeat(bits[edges], burst)
    n = rng.poisson(noise_hz * seconds)
    noise = (rng.uniform(0, most, n) for most in (seconds * 1e6, 1279, 719))
    t, x, y = (np.concatenate(both) for both in zip((t, x, y), noise, strict=True))
    p = np.concatenate([p, rng.integers(0, 2, n)])
    return merge_events(Events.of(np.floor(t), np.rint(x), np.rint(y), p))


def regions_of(link, events, seconds, **given):
    detector = Spots(**given).compile(link.camera, link.codebook, link.packet)
    state, found = detector.init(), []
    for start_us in range(0, int(seconds * 1e6), STEP_US):
        a, b = np.searchsorted(events.t_us, (start_us, start_us + STEP_US))
        state, regions = detector.step(state, start_us, events[a:b])
        found.append((start_us, regions))
    return found


@pytest.mark.parametrize(("rate_hz", "burst"), [(500.0, 100), (500.0, 20), (3125.0, 60), (10_000.0, 60)])
def test_a_light_is_followed_though_it_shakes_and_is_dark_for_long(rate_hz, burst):
    link = link_of(rate_hz)
    seconds = 0.8 if rate_hz < 1000 else 0.3
    events = events_of(np.random.default_rng(1), rate_hz, seconds, burst, 20_000.0)
    found = regions_of(link, events, seconds)
    opened = next(k for k, (_, regions) in enumerate(found) if regions)
    assert found[opened][0] <= 60 / rate_hz * 1e6 + 5 * STEP_US
    ids = {region.id for _, regions in found for region in regions}
    assert len(ids) == 1
    # What counts is that the light's events are in the box.
    inside = total = 0
    for start_us, (region,) in found[opened:]:
        x, y = shaking(np.array([start_us + STEP_US / 2]))
        a, b = np.searchsorted(events.t_us, (start_us, start_us + STEP_US))
        of_light = np.hypot(events.x[a:b] - x[0], events.y[a:b] - y[0]) < 9
        across = np.abs(events.x[a:b] - region.x_px) <= region.width_px / 2
        down = np.abs(events.y[a:b] - region.y_px) <= region.height_px / 2
        total += int(of_light.sum())
        inside += int((of_light & across & down).sum())
    assert inside >= 0.985 * total


@pytest.mark.parametrize(("burst", "opened"), [(100, 2), (20, 1)])
def test_the_brightest_lights_are_followed(burst, opened):
    """Of two lights where one may be: the later one takes its place if it is brighter."""
    link = link_of(500.0)
    first, late = (events_of(np.random.default_rng(1), 500.0, 0.4, n, 0.0) for n in (50, burst))
    late = late[late.t_us >= 200_000]
    events = merge_events(first, Events(late.t_us, late.x + np.uint16(300), late.y, late.p))
    found = regions_of(link, events, 0.4, most=1)
    assert len({region.id for _, regions in found for region in regions}) == opened
    assert all(len(regions) < 2 for _, regions in found)


def test_there_is_no_light_in_noise_or_in_what_moves():
    rng = np.random.default_rng(2)
    n = 20_000
    t = np.sort(rng.uniform(0, 4e5, n))
    # A steady edge that moves: brighter ahead of it, darker behind.
    ahead = rng.integers(0, 2, n)
    x, y = 200 + t * 3e-4 + np.where(ahead, 0.0, -40.0) + rng.standard_normal(n), rng.uniform(300, 330, n)
    events = Events.of(np.floor(t), np.rint(x), np.rint(y), ahead)
    assert not any(regions for _, regions in regions_of(link_of(500.0), events, 0.4))
    noise = events_of(rng, 500.0, 0.2, 1, 200_000.0)
    assert not any(regions for _, regions in regions_of(link_of(500.0), noise, 0.2))


def move_events(events, right, share, late_us, rng):
    """Some of the events elsewhere and later, as a lens scatters light and dim pixels see it."""
    kept = rng.random(len(events)) < share
    t = events.t_us[kept] + late_us + rng.integers(0, 40, int(kept.sum()))
    return merge_events(Events.of(t, events.x[kept].astype(np.int64) + right, events.y[kept], events.p[kept]))


def places_of(found, from_us, x_px):
    """In what share of the steps from a time on there is a light some columns beside the shaking one."""
    late = [(start, regions) for start, regions in found if start >= from_us]
    hits = 0
    for start, regions in late:
        x, _ = shaking(np.array([start + STEP_US / 2]))
        hits += any(abs(region.x_px - x[0] - x_px) < 12 for region in regions)
    return hits / len(late)


@pytest.mark.parametrize("rate_hz", [500.0, 3125.0, 10_000.0])
@pytest.mark.parametrize("late_us", [0, 60, 300])
def test_what_the_lens_scatters_is_no_light_and_a_dim_one_beside_is(rate_hz, late_us):
    """Three times dimmer either: one goes with the edges of the bright light, one has its own."""
    rng = np.random.default_rng(5)
    seconds = 1.0 if rate_hz < 1000 else 0.3
    bright = events_of(rng, rate_hz, seconds, 90, 0.0)
    dim = events_of(rng, rate_hz, seconds, 28, 0.0)
    noise = events_of(rng, rate_hz, seconds, 1, 10_000.0)
    flare, dim = move_events(bright, -70, 0.3, late_us, rng), move_events(dim, 60, 1.0, late_us, rng)
    found = regions_of(link_of(rate_hz), merge_events(bright, flare, dim, noise), seconds)
    half_us = int(seconds * 5e5)
    assert places_of(found, half_us, 0) == 1
    assert places_of(found, half_us, 60) > 0.97
    assert places_of(found, 20_000, -70) < 0.03


def beside_one_another(rng, places):
    """Lights of their own edges so many rows below the shaking place, from a time to a time, s."""
    parts = []
    for down, (from_s, until_s) in places.items():
        one = events_of(rng, 10_000.0, 0.3, 60, 0.0)
        part = one[(one.t_us >= from_s * 1e6) & (one.t_us < until_s * 1e6)]
        parts.append(Events.of(part.t_us, part.x, part.y + down, part.p))
    return merge_events(*parts)


def test_a_large_light_is_one_though_its_places_come_and_go():
    """The ends have a neighbour on one side; then one in the middle is lost, and that has one less."""
    places = {0: (0.0, 0.18), 40: (0.0, 0.18), 80: (0.0, 0.1), 120: (0.0, 0.18)}
    found = regions_of(link_of(10_000.0), beside_one_another(np.random.default_rng(4), places), 0.3)
    assert not any(regions for _, regions in found)


def test_two_lights_beside_one_another_are_two():
    events = beside_one_another(np.random.default_rng(4), {0: (0.0, 0.3), 36: (0.0, 0.3)})
    found = regions_of(link_of(10_000.0), events, 0.3)
    assert all(len(regions) == 2 for start, regions in found if start > 30_000)
