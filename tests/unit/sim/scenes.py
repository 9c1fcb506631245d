"""What tests of the simulator share: whole simulations, and scenes without noise or motion."""

from dataclasses import replace

from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.sim import MotionSpec, Scene, SensorSpec, Simulation
from evlcp_sdk.values import Events

EXACT = SensorSpec(
    noise_hz=0.0,
    hot_share=0.0,
    noise_ln=0.0,
    p_on_miss=0.0,
    p_off_miss=0.0,
    th_spread=0.0,
    t_row_us=0.0,
    cap_mev_s=0.0,
)
"""A sensor without noise, spread or readout."""

STILL = MotionSpec(speed_mps=0.0, vib_rate_rad_s=0.0)


def every(
    scene: Scene, seed: int | None = None, threads: int = 1, registry: Registry | None = None
) -> Events:
    """All events of a scene."""
    return Events.concat(Simulation(scene, seed, threads, registry).stream())


def rows(events: Events) -> list[tuple[int, int, int, int]]:
    """Events as (us, column, row, polarity), sorted."""
    columns = (events.t_us, events.x, events.y, events.p)
    return sorted(zip(*(c.tolist() for c in columns), strict=True))


def check_alike(one: Events, two: Events) -> None:
    """But for crossings at the turn of a microsecond, which the rounding of sums moves."""
    a, b = set(rows(one)), set(rows(two))
    assert min(len(a), len(b)) > 5000
    assert len(a & b) > 0.999 * max(len(a), len(b))


def still_scene(duration_s: float, **parts: object) -> Scene:
    """A scene without noise or motion."""
    return replace(Scene(duration_s=duration_s, sensor=EXACT, motion=STILL), **parts)  # type: ignore[arg-type]
