"""The scene: bars, reflections, lamps, drops, lens, motion and sensor, from TOML to checked objects.

Coordinates: x right, y down, z forward, m. The camera's path starts at the origin of x and y, looking along
z; a bar with `z_m = 0` then stands `motion.distance_m` ahead. Defaults are those of the sensor model; where a
number is an engineering guess, its description says so.
"""

import json
import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from evlcp_sdk.errors import ConfigError, name_place
from evlcp_sdk.formatting import format_count, suggest
from evlcp_sdk.link.resolve import Link, load_led_file, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.plugin.roles import ROLES
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.specs import build_spec, parse_toml, parse_value, read_toml

MAX_PIXELS = 4096
"""Columns and rows of a sensor."""

MAX_SOURCES = 64
"""Strips of light of one scene: lamps, and columns or rows of LEDs, again for every reflection."""

LinkTable = Mapping[str, Any]
"""A link, or its differences from another: tables as in `link.toml`."""


@dataclass(frozen=True)
class BarSpec:
    """A transmitter: the LEDs that its link describes, which send packets without end."""

    x_m: Annotated[float, Field(description="Its centre, to the right of the path's start.")] = -1.5
    y_m: Annotated[float, Field(description="The same, downward.")] = 0.0
    z_m: Annotated[float, Field(description="The same, beyond `motion.distance_m`.")] = 0.0
    link: Annotated[
        dict[str, Any] | str | None,
        Field(
            description="What it sends, and the layout of its LEDs: a `link.toml`, or tables laid over the"
            " scene's link; none: the scene's link."
        ),
    ] = None
    width_m: Annotated[
        float, Field(gt=0, description="Lit width of a column of LEDs; a ring and a table have their own.")
    ] = 0.005
    lean_deg: Annotated[float, Field(gt=-90, lt=90, description="Its top leans to the right.")] = 0.0
    tilt_deg: Annotated[float, Field(gt=-90, lt=90, description="Its top leans away from the camera.")] = 0.0
    ppm: Annotated[float, Field(ge=-1e5, le=1e5, description="How much faster its clock runs.")] = 0.0
    start_chip: Annotated[
        float | None,
        Field(ge=0, le=1e6, description="Chip of a packet on air as the scene starts; none: random."),
    ] = None
    transmitter_id: Annotated[
        int | None, Field(ge=0, lt=2**32, description="Its number as a site; none: 1 for the first bar.")
    ] = None
    site_off_m: Annotated[
        tuple[float, float, float],
        Field(description="Error of its reported site to the east, north and up."),
    ] = (0.0, 0.0, 0.0)
    site_of: Annotated[
        int | None,
        Field(ge=0, description="Number of the bar, counted from 0, whose site it is reported at."),
    ] = None
    seed: Annotated[int | None, Field(ge=0, description="Seed of its payload; none: the scene's.")] = None
    payload: Annotated[
        Literal["symbols", "data", "messages"],
        Field(
            description="Random symbols; a message of random data in each packet; or, again and again, its"
            " beacon if there is a `[world]`, and its text."
        ),
    ] = "symbols"
    text: Annotated[str | None, Field(description="Text among its messages.")] = None
    symbols: Annotated[
        tuple[tuple[tuple[int, ...], ...], ...] | None,
        Field(description="Symbols [packet][frame][cluster], sent again and again; none: random."),
    ] = None
    chips_file: Annotated[
        str | None,
        Field(description="Instead of packets: .npy of 0 and 1 (chips, clusters), sent again and again."),
    ] = None
    led_w_m2: Annotated[
        float | None,
        Field(ge=0, description="Light of a fully lit pixel; none: from the LED's intensity and the lens."),
    ] = None
    led_mw_sr: Annotated[float, Field(gt=0, description="Intensity of one LED.")] = 20.0
    dead_leds: Annotated[
        tuple[int, ...], Field(description="LEDs that stay dark, counted from 0 as its layout does.")
    ] = ()
    stuck_leds: Annotated[tuple[int, ...], Field(description="LEDs that shine all the time.")] = ()
    led_spread: Annotated[
        float, Field(ge=0, le=1, description="Sigma of the logarithm of the light of LEDs.")
    ] = 0.0
    covered: Annotated[
        tuple[int, ...], Field(description="Clusters that are hidden all the time, counted from 0.")
    ] = ()
    cover_s: Annotated[
        tuple[tuple[float, float, int, int], ...],
        Field(description="Clusters hidden for a time: [from s, to s, first cluster, last cluster]."),
    ] = ()
    pole_s: Annotated[
        tuple[tuple[float, float], ...], Field(description="Times when all of it is hidden: [from s, to s].")
    ] = ()
    lattice_m: Annotated[
        tuple[float, float, float] | None,
        Field(
            description="Slats of a slanted fence that cross it: [pitch, width of a slat, from its top to the"
            " start of a slat] along it; none: no fence."
        ),
    ] = None
    lattice_mps: Annotated[float, Field(ge=-10, le=10, description="How fast they pass down it.")] = 0.0


@dataclass(frozen=True)
class ReflectionSpec:
    """A second image of a bar: upside down in the road, beside it in a rail, or shifted by a window.

    Every image has the bar's chips at the same times. Covers of a bar hide the direct view and none of its
    images.
    """

    kind: Annotated[
        Literal["road", "rail", "window"],
        Field(
            description="road: mirrored in a level plane; rail: mirrored in an upright plane that holds the"
            " viewing direction; window: the same image, shifted."
        ),
    ] = "road"
    bar: Annotated[
        int | None, Field(ge=0, description="Number of the bar, counted from 0; none: every bar.")
    ] = None
    share: Annotated[float, Field(gt=0, le=1, description="Share of the bar's light.")] = 0.2
    gap_m: Annotated[
        float,
        Field(description="road: from the bar's lower end down to its image; rail: from the bar to it."),
    ] = 0.1
    shift_px: Annotated[
        tuple[float, float], Field(description="window: shift of the image to the right and down.")
    ] = (0.0, 0.0)
    turn_deg: Annotated[
        tuple[float, float], Field(description="window: the same as angles, to the right and down.")
    ] = (0.0, 0.0)
    blur_px: Annotated[
        float, Field(ge=0, le=20, description="Sigma of the blur that a rough surface adds.")
    ] = 0.0


@dataclass(frozen=True)
class LampSpec:
    """A rectangle of flickering light: a lamp, a sign, a panel that is dimmed by switching."""

    x_m: Annotated[float, Field(description="Its centre, to the right of the path's start.")] = 4.0
    y_m: Annotated[float, Field(description="The same, downward.")] = -3.0
    z_m: Annotated[float, Field(description="The same, beyond `motion.distance_m`.")] = 0.0
    width_m: Annotated[float, Field(gt=0, description="Its width.")] = 0.2
    height_m: Annotated[float, Field(gt=0, description="Its height.")] = 0.2
    light_w_m2: Annotated[float, Field(ge=0, description="Light of a fully lit pixel at its peak.")] = 20.0
    flicker_hz: Annotated[float, Field(gt=0, le=1e5, description="Periods a second.")] = 100.0
    waveform: Annotated[
        Literal["square", "sine"],
        Field(description="On and off, or the square of a sine in 32 steps (mains light)."),
    ] = "square"
    duty: Annotated[float, Field(gt=0, lt=1, description="Share of a period that a square is on.")] = 0.5
    depth: Annotated[float, Field(gt=0, le=1, description="Share of its light that flickers.")] = 1.0
    phase: Annotated[float, Field(ge=0, lt=1, description="Share of a period gone as the scene starts.")] = (
        0.0
    )


@dataclass(frozen=True)
class LensSpec:
    """The lens: its light, its blur, near and far, its halo."""

    f_number: Annotated[float, Field(gt=0, description="Focal length over aperture.")] = 2.0
    focus_m: Annotated[float, Field(gt=0, description="Distance that is sharp.")] = 50.0
    transmission: Annotated[
        float, Field(gt=0, le=1, description="Share of the light that arrives; a guess.")
    ] = 0.65
    wavelength_nm: Annotated[float, Field(gt=0, description="For the diffraction.")] = 630.0
    blur_px: Annotated[
        float, Field(ge=0.05, description="Sigma of the blur that is left in focus; a guess.")
    ] = 0.36
    wings: Annotated[
        bool, Field(description="The Airy pattern's wings of an ideal lens; without: its core only.")
    ] = True
    halo: Annotated[float, Field(ge=0, lt=1, description="Share of the light in the halo; a guess.")] = 0.02
    halo_px: Annotated[float, Field(ge=2, le=400, description="Sigma of the halo; a guess.")] = 40.0
    bloom: Annotated[
        float, Field(ge=0, lt=1, description="Share of the light in a second halo: a dirty windscreen.")
    ] = 0.0
    bloom_px: Annotated[float, Field(ge=2, le=400, description="Sigma of the second halo.")] = 12.0


@dataclass(frozen=True)
class MotionSpec:
    """How the camera moves: an approach along z or a path from a file, and the vehicle's vibration."""

    distance_m: Annotated[
        float, Field(gt=0, le=10_000, description="Depth of z_m = 0 as the scene starts.")
    ] = 50.0
    speed_mps: Annotated[float, Field(ge=-100, le=100, description="Speed towards it.")] = 8.333
    lateral_mps: Annotated[float, Field(ge=-100, le=100, description="Speed to the right.")] = 0.0
    yaw_deg: Annotated[float, Field(ge=-60, le=60, description="The camera looks to the right.")] = 0.0
    pitch_deg: Annotated[float, Field(ge=-60, le=60, description="The camera looks up.")] = 0.0
    roll_deg: Annotated[float, Field(ge=-180, le=180, description="The camera's top leans right.")] = 0.0
    yaw_rate_deg_s: Annotated[
        float, Field(ge=-360, le=360, description="It turns to the right; 45: 5.7 px/ms.")
    ] = 0.0
    vib_rate_rad_s: Annotated[
        float, Field(ge=0, le=2, description="Rms of the vibration's pitch and yaw rates; a guess.")
    ] = 0.06
    vib_yaw_share: Annotated[float, Field(ge=0, le=10, description="The yaw's rate beside the pitch's.")] = (
        1.0
    )
    pothole_s: Annotated[
        tuple[float, ...], Field(description="When a wheel hits a pothole: pitch is struck, rings, decays.")
    ] = ()
    pothole_rad_s: Annotated[
        float, Field(ge=-4, le=4, description="Pitch rate right after the blow, upward; 1 rad/s: 7.2 px/ms.")
    ] = 1.0
    pothole_hz: Annotated[float, Field(gt=0, le=200, description="What it rings with; a guess.")] = 12.0
    pothole_decay_s: Annotated[
        float, Field(gt=0, le=10, description="Time constant of its decay; a guess.")
    ] = 0.1
    path_file: Annotated[
        str | None, Field(description="CSV of t_s,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg for the approach.")
    ] = None


@dataclass(frozen=True)
class WorldSpec:
    """Place and heading on earth of the scene's origin; errors of an IMU and of a survey."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90, description="WGS-84.")] = 0.0
    longitude_deg: Annotated[float, Field(ge=-180, le=180, description="The same.")] = 0.0
    height_m: Annotated[float, Field(ge=-12_000, le=20_000, description="Above the WGS-84 ellipsoid.")] = 0.0
    heading_deg: Annotated[float, Field(ge=0, lt=360, description="Of z, clockwise from north.")] = 0.0
    attitude: Annotated[
        Literal["none", "gravity", "heading"],
        Field(description="What is known of the camera's attitude: nothing, pitch and roll, or all."),
    ] = "heading"
    gravity_sigma_deg: Annotated[
        float, Field(ge=0, le=10, description="Error of pitch and of roll, the same all through a recording.")
    ] = 0.1
    heading_sigma_deg: Annotated[float, Field(ge=0, le=30, description="The same of the heading.")] = 0.1
    attitude_off_deg: Annotated[
        tuple[float, float, float],
        Field(description="Further error of pitch, roll and heading, unknown to all."),
    ] = (0.0, 0.0, 0.0)
    attitude_late_ms: Annotated[float, Field(ge=0, le=1000, description="Age of the reported attitude.")] = (
        0.0
    )
    attitude_errs: Annotated[
        float, Field(ge=0, le=1000, description="Ratio of its errors to its stated sigmas.")
    ] = 1.0
    survey_sigma_m: Annotated[
        float,
        Field(ge=0, le=1000, description="Stated error of each site to the east, north and up."),
    ] = 0.0


@dataclass(frozen=True)
class BackgroundSpec:
    """The light of everything else."""

    light_w_m2: Annotated[
        float, Field(gt=0, le=100, description="On the sensor: night 1e-4, tunnel 0.1, sun 3 to 12.")
    ] = 0.05
    change_s: Annotated[
        tuple[tuple[float, Annotated[float, Field(gt=0, le=1e5)]], ...],
        Field(
            description="[at s, multiple of that light]: sun through trees, a tunnel's end. Its logarithm"
            " changes evenly in between; before the first and after the last it is constant."
        ),
    ] = ()
    texture: Annotated[
        float, Field(ge=0, le=2, description="Rms of its logarithm over the image; a guess.")
    ] = 0.3
    texture_px: Annotated[
        float, Field(ge=2, le=64, description="Distance at which its correlation is 1 / e; a guess.")
    ] = 12.0
    texture_step_px: Annotated[
        float, Field(ge=0.1, le=4, description="Motion after which the light on a pixel follows it.")
    ] = 0.8
    around_px: Annotated[
        int,
        Field(
            ge=0,
            le=MAX_PIXELS,
            description="How far around bars and lamps its own events are simulated, too; 0: only on pixels"
            " that these light; the width of the image: everywhere.",
        ),
    ] = 0


@dataclass(frozen=True)
class DropSpec:
    """A rain drop on the windscreen, a lens that deflects light away from its middle.

    A point d px from the middle is seen `bend_px` (d / r) exp((1 - d^2 / r^2) / 2) farther out, with r its
    `radius_px`: the most, `bend_px`, at its rim.
    """

    x_px: Annotated[float, Field(description="Its middle's column as the scene starts.")]
    y_px: Annotated[float, Field(description="Its row.")]
    radius_px: Annotated[float, Field(gt=0, le=1000, description="From its middle to its rim.")] = 25.0
    bend_px: Annotated[float, Field(ge=-50, le=50, description="Deflection; less than 0: inward.")] = 4.0
    speed_px_s: Annotated[
        tuple[float, float], Field(description="Its speed to the right and down; in steps of 4 ms.")
    ] = (0.0, 0.0)


@dataclass(frozen=True)
class WiperSpec:
    """A wiper's blade before the lens, out of focus, which takes a share of all light for a time."""

    share: Annotated[float, Field(ge=0, le=0.999, description="Share of the light that it takes.")] = 0.0
    at_s: Annotated[float, Field(ge=0, description="Start of its first pass.")] = 0.05
    lasts_s: Annotated[float, Field(gt=0, description="Length of a pass, its edges included.")] = 0.03
    edge_s: Annotated[
        float, Field(ge=0, description="Time of the blade's edge to pass the lens; a guess.")
    ] = 0.005
    every_s: Annotated[float, Field(ge=0, description="Period of its passes; 0: only one.")] = 0.0


@dataclass(frozen=True)
class SensorSpec:
    """Pixels and readout; a logarithmic receptor, solved exactly for light constant between edges."""

    th_on: Annotated[float, Field(gt=0, le=2, description="ON threshold, ln units.")] = 0.223
    th_off: Annotated[float, Field(gt=0, le=2, description="OFF threshold, ln units.")] = 0.223
    th_spread: Annotated[
        float, Field(ge=0, le=0.2, description="Relative sigma between pixels; a guess.")
    ] = 0.10
    charge_us_w_m2: Annotated[float, Field(gt=0, description="Receptor charge Q, us W/m2.")] = 14.6
    dark_w_m2: Annotated[float, Field(gt=0, description="Dark current as light; a guess.")] = 1e-4
    dly_on_us: Annotated[float, Field(ge=0, le=1000, description="Fixed delay of ON events.")] = 22.0
    dly_off_us: Annotated[float, Field(ge=0, le=1000, description="Fixed delay of OFF events.")] = 33.0
    tau_sf_us: Annotated[
        float,
        Field(
            ge=0,
            le=1000,
            description="Time constant of a source follower behind the receptor; 0, the default, for none:"
            " with one, crossing times are computed in adaptive steps and rendering is ten times slower.",
        ),
    ] = 0.0
    jitter_us: Annotated[float, Field(ge=0, le=100, description="Sigma of the delays.")] = 0.0
    refr_us: Annotated[float, Field(ge=1, le=10_000, description="Refractory time; a guess.")] = 10.0
    noise_ln: Annotated[float, Field(ge=0, le=0.2, description="Rms noise of the log signal.")] = 0.03
    noise_hz: Annotated[
        float, Field(ge=0, le=1000, description="Background events a pixel, each sign; a guess.")
    ] = 0.1
    hot_share: Annotated[float, Field(ge=0, le=0.1, description="Share of hot pixels; a guess.")] = 1e-4
    hot_hz: Annotated[float, Field(ge=0, le=1e5, description="Events of a hot pixel; a guess.")] = 100.0
    p_on_miss: Annotated[
        float, Field(ge=0, lt=1, description="Share of ON events that go missing; a guess.")
    ] = 0.05
    p_off_miss: Annotated[
        float, Field(ge=0, lt=1, description="Share of OFF events that go missing; a guess.")
    ] = 0.2
    t_row_us: Annotated[float, Field(ge=0, le=10, description="Readout's time for a row.")] = 0.2
    hold: Annotated[
        bool,
        Field(description="A pixel whose event waits for the readout sends no other; without: all wait."),
    ] = False
    cap_mev_s: Annotated[
        float, Field(ge=0, description="Events a second, in millions, that pass at most; 0: no limit.")
    ] = 100.0
    cap_window_us: Annotated[int, Field(ge=1, description="Time over which they are counted; a guess.")] = 200


@dataclass(frozen=True)
class Scene:
    """Everything that determines a recording.

    Raises:
        ConfigError: It is not possible, e.g. with a bar behind the camera, or too many sources.

    >>> len(Scene().bars)
    1
    """

    name: Annotated[str, Field(pattern=r"^[\w.+-]+$", description="Name of the recording.")] = "scene"
    duration_s: Annotated[float, Field(gt=0, le=86_400, description="Its length.")] = 0.25
    t0_us: Annotated[int, Field(ge=0, le=10**15, description="Camera clock as it starts.")] = 0
    seed: Annotated[int, Field(ge=0, lt=2**63, description="Seed of everything random.")] = 0
    flicker_lamps: Annotated[
        int, Field(ge=0, le=48, description="Lamps at random places, beside those listed.")
    ] = 0
    link: Annotated[
        dict[str, Any] | str | None,
        Field(description="Link of its bars: a `link.toml`, or tables as in one; none: the default link."),
    ] = None
    camera: CameraModel = field(default_factory=CameraModel)
    lens: LensSpec = field(default_factory=LensSpec)
    motion: MotionSpec = field(default_factory=MotionSpec)
    background: BackgroundSpec = field(default_factory=BackgroundSpec)
    sensor: SensorSpec = field(default_factory=SensorSpec)
    wiper: WiperSpec = field(default_factory=WiperSpec)
    world: WorldSpec | None = None
    bars: tuple[BarSpec, ...] = (BarSpec(),)
    reflections: tuple[ReflectionSpec, ...] = ()
    lamps: tuple[LampSpec, ...] = ()
    drops: tuple[DropSpec, ...] = ()

    def __post_init__(self) -> None:
        if len(self.bars) + len(self.lamps) + self.flicker_lamps > MAX_SOURCES:
            raise ConfigError(f"bars and lamps: expected at most {MAX_SOURCES} together")
        self._check_numbers()
        if self.motion.pothole_rad_s not in (0.0, MotionSpec.pothole_rad_s) and not self.motion.pothole_s:
            raise ConfigError(
                f"motion.pothole_rad_s = {self.motion.pothole_rad_s}: expected pothole_s beside it"
            )
        if self.lens.halo + self.lens.bloom >= 1:
            raise ConfigError(
                f"lens.bloom = {self.lens.bloom}: expected less than 1 together with lens.halo ="
                f" {self.lens.halo}"
            )
        wiper = self.wiper
        if 2 * wiper.edge_s > wiper.lasts_s:
            raise ConfigError(f"wiper.edge_s = {wiper.edge_s}: expected at most half of lasts_s")
        if 0 < wiper.every_s < wiper.lasts_s:
            raise ConfigError(f"wiper.every_s = {wiper.every_s}: expected at least lasts_s")
        times_s = [at_s for at_s, _ in self.background.change_s]
        if times_s and (times_s[0] < 0 or any(b <= a for a, b in pairwise(times_s))):
            raise ConfigError(f"background.change_s = {times_s}: expected times from 0 on that rise")
        if max(self.camera.width, self.camera.height) > MAX_PIXELS:
            raise ConfigError(f"camera: expected at most {MAX_PIXELS} columns and rows")
        if self.lens.focus_m * 1e3 <= self.camera.focal_mm:
            raise ConfigError(f"lens.focus_m = {self.lens.focus_m}: expected beyond the focal length")
        for i, bar in enumerate(self.bars):
            if self.motion.path_file is None and self.motion.distance_m + bar.z_m <= NEAREST_M:
                raise ConfigError(
                    f"bars.{i}.z_m = {bar.z_m}: the bar is behind the camera, which starts"
                    f" {self.motion.distance_m} m before z_m = 0"
                )

    def _check_numbers(self) -> None:
        """Check numbers of bars, and what sites need."""
        chosen = [(f"reflections.{i}.bar", reflection.bar) for i, reflection in enumerate(self.reflections)]
        chosen += [(f"bars.{i}.site_of", bar.site_of) for i, bar in enumerate(self.bars)]
        for key, number in chosen:
            if number is not None and number >= len(self.bars):
                raise ConfigError(
                    f"{key} = {number}: expected one of {format_count(len(self.bars), 'bar')}, from 0 on"
                )
        for i, bar in enumerate(self.bars):
            if self.world is None and (bar.site_of is not None or any(bar.site_off_m)):
                raise ConfigError(f"bars.{i}: site_of and site_off_m are of its site: expected a [world]")
        ids = [i + 1 if bar.transmitter_id is None else bar.transmitter_id for i, bar in enumerate(self.bars)]
        if self.world is not None and len(set(ids)) < len(ids):
            raise ConfigError(f"bars.transmitter_id = {ids}: expected another one of each bar")


NEAREST_M = 0.5
"""Depth from which a source is rendered."""

_TABLES = ("camera", "lens", "motion", "background", "sensor", "wiper", "world")
_LISTS = ("bars", "reflections", "lamps", "drops")


def preset_names() -> list[str]:
    """Return the names of the scenes that come with the package."""
    folder = resources.files("evlcp_sdk.sim") / "presets"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def preset_text(name: str) -> str:
    """Return the TOML of a preset.

    Raises:
        ConfigError: There is no preset of that name.
    """
    known = preset_names()
    if name not in known:
        raise ConfigError(f"no preset named '{name}'{suggest(name, known)}")
    return (resources.files("evlcp_sdk.sim") / "presets" / f"{name}.toml").read_text(encoding="utf-8")


def load_scene(
    source: Path | str,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    registry: Registry | None = None,
    *,
    link: Link | Path | str | None = None,
) -> Scene:
    """Read a scene from a TOML file or a preset.

    Args:
        source: The file, or a preset's name.
        overrides: `"table.key=value"` texts, or a mapping from `"table.key"` to values; `bars.ppm` is that
            of every bar, `bars.1.ppm` that of the second, `duration_s` a key without a table;
            `link.air.chip_rate_hz` is a key of the scene's link, `bars.1.link.air.chip_rate_hz` one of the
            second bar's.
        registry: The algorithms of its links; None for all that are installed.
        link: A link, or a `link.toml`, instead of the scene's link.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or does not describe a scene; one line per fault.

    >>> load_scene("drive-30kmh", ["motion.distance_m=60"]).motion.distance_m
    60.0
    """
    name = str(source)
    folder: Path | None = None
    if isinstance(source, str) and source in preset_names():
        table, where = parse_toml(preset_text(source), name), f"preset {name}"
    else:
        path = Path(source)
        folder = path.parent
        where = name
        if not os.path.lexists(path) and not path.suffix:
            raise ConfigError(
                f"{name}: no such file, and no preset of that name{suggest(name, preset_names())}"
            )
        table = read_toml(path)
    if link is not None:
        table["link"] = _FileLink(link.table) if isinstance(link, Link) else _FileLink.read(link)
    _read_links(table, folder, f"{where}: ")
    texts = [overrides] if isinstance(overrides, str) else overrides
    pairs = texts.items() if isinstance(texts, Mapping) else map(_parse_override, texts)
    for key, value in pairs:
        _set_value(table, key, value)
        _read_links(table, folder, "--set ")
    return resolve_scene(table, registry, source=where, folder=folder)


def resolve_scene(
    table: Mapping[str, Any],
    registry: Registry | None = None,
    *,
    source: str = "",
    folder: Path | None = None,
) -> Scene:
    """Check the table of a scene, fill in defaults, and read files of links, so that each bar has its own.

    Args:
        table: The table, as read from TOML.
        registry: The algorithms of its links; None for all that are installed.
        source: Name of the scene in error messages.
        folder: The folder that `path_file`, `chips_file` and files of links are relative to; None for the
            current one.

    Raises:
        ConfigError: One line per fault, each with its path.
    """
    prefix = f"{source}: " if source else ""
    table = dict(table)
    default = _distribute_links(table, folder, prefix)
    if default:
        _resolve_link(default, registry, f"{prefix}link")
    bars = table.get("bars")
    for i, bar in enumerate(bars if isinstance(bars, list) else []):
        if isinstance(bar, dict) and isinstance(bar.get("link"), Mapping):
            _resolve_link(bar["link"], registry, f"{prefix}bars.{i}.link")
    with name_place(prefix):
        scene = build_spec(Scene, table, hint=_hint_at_link)
    if folder is not None:
        # File names are relative to the scene's own folder.
        path = scene.motion.path_file and str(folder / scene.motion.path_file)
        bars = (
            replace(bar, chips_file=bar.chips_file and str(folder / bar.chips_file)) for bar in scene.bars
        )
        scene = replace(scene, bars=tuple(bars), motion=replace(scene.motion, path_file=path))
    return scene


def links_of(scene: Scene, registry: Registry | None = None) -> tuple[Link, ...]:
    """Return the resolved link of each bar of a scene.

    Raises:
        ConfigError: A bar's link is not valid; one line per fault.
    """
    table: dict[str, Any] = {"link": scene.link, "bars": [{"link": bar.link} for bar in scene.bars]}
    _distribute_links(table, None, "")
    return tuple(
        _resolve_link(bar.get("link") or {}, registry, f"bars.{i}.link")
        for i, bar in enumerate(table["bars"])
    )


def _resolve_link(table: LinkTable, registry: Registry | None, where: str) -> Link:
    if isinstance(table, _FileLink) and table.file:
        where = f"{where}: {table.file}"
    with name_place(f"{where}: "):
        return _resolve_text(json.dumps(table, default=str), registry)


@lru_cache(maxsize=64)
def _resolve_text(text: str, registry: Registry | None) -> Link:
    return resolve(json.loads(text), registry)


class _FileLink(dict[str, Any]):
    """A link from a file, which is not laid over another; errors name its file."""

    file = ""

    @classmethod
    def read(cls, path: Path | str) -> "_FileLink":
        link = cls(load_led_file(read_toml(path), Path(path).parent, f"{path}: "))
        link.file = str(path)
        return link


def _read_links(table: dict[str, Any], folder: Path | None, prefix: str) -> None:
    """Replace the names of files of links by their tables."""

    def read(holder: dict[str, Any], where: str) -> None:
        link = holder.get("link")
        if isinstance(link, str):
            with name_place(f"{prefix}{where}: "):
                holder["link"] = _FileLink.read(link if folder is None else folder / link)
        elif isinstance(link, Mapping):
            complete = load_led_file(link, folder or Path(), f"{prefix}{where}: ")
            if isinstance(link, _FileLink):
                link.update(complete)
            else:
                holder["link"] = complete
        elif link is not None:
            raise ConfigError(f"{prefix}{where} = {link!r}: expected a link.toml, or tables as in one")

    read(table, "link")
    bars = table.get("bars")
    for i, bar in enumerate(bars if isinstance(bars, list) else []):
        if isinstance(bar, dict):
            read(bar, f"bars.{i}.link")


def _distribute_links(table: dict[str, Any], folder: Path | None, prefix: str) -> LinkTable | None:
    """Merge the scene's link into those of its bars, which are then complete; return it."""
    bars = table.get("bars")
    if table.get("link") is not None and bars is None:
        bars = [{}]
    if isinstance(bars, list | tuple):
        table["bars"] = [dict(bar) if isinstance(bar, Mapping) else bar for bar in bars]
    _read_links(table, folder, prefix)
    default: LinkTable | None = table.pop("link", None)
    if default is not None and isinstance(table["bars"], list):
        for bar in table["bars"]:
            if isinstance(bar, dict) and not isinstance(bar.get("link"), _FileLink):
                bar["link"] = _merge_links(default, bar.get("link") or {})
    return default


def _merge_links(under: LinkTable, over: LinkTable) -> dict[str, Any]:
    """Lay one link over another by sections; another algorithm or shape of the bar replaces its section."""
    found = dict(under)
    for section, keys in over.items():
        below = under.get(section, {})
        if not isinstance(keys, Mapping) or not isinstance(below, Mapping):
            found[section] = keys
            continue
        name, default = ("shape", "grid") if section == "bar" else ("id", None)
        if section in ROLES:
            default = ROLES[section].default
        is_same = keys.get(name, below.get(name, default)) == below.get(name, default)
        found[section] = {**below, **keys} if is_same else dict(keys)
    return found


_LINK_KEYS = {
    "clusters": "bar.rows, bar.cluster_rows",
    "leds": "bar.leds",
    "shape": "bar.shape",
    "length_m": "bar.rows, bar.led_pitch_m",
    "led_pitch_m": "bar.led_pitch_m",
    "profile": "modulation.id",
    "frames": "air.frames_per_packet",
    "pilot_every": "air.pilot_every",
    "chip_rate_hz": "air.chip_rate_hz",
    "error_correction": "error-correction.id",
}
"""Keys that one may expect in a bar, and those of its link that have them."""


def _hint_at_link(path: tuple[str, ...]) -> str | None:
    instead = _LINK_KEYS.get(path[-1]) if path[0] == "bars" else None
    return f"; its link says it: bars.link.{instead}" if instead else None


def _parse_override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {text}: expected table.key=value, e.g. motion.distance_m=60")
    return key.strip(), parse_value(value)


def _set_value(table: dict[str, Any], key: str, value: Any) -> None:
    head, *rest = parts = key.split(".")
    if rest and head not in (*_TABLES, *_LISTS, "link"):
        raise ConfigError(f"--set {key}: unknown table{suggest(head, [*_TABLES, *_LISTS, 'link'])}")
    holders = [table]
    if rest and head in _LISTS:
        holders = rows = table.setdefault(head, [{}])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ConfigError(f"--set {key}: {head} = {rows!r}: expected tables [[{head}]]")
        if len(rest) > 1 and (head, rest[0]) != ("bars", "link"):
            number, *rest = rest
            if not number.isdigit() or int(number) >= len(rows):
                raise ConfigError(
                    f"--set {key}: expected one of {format_count(len(rows), head[:-1])}, from 0 on"
                )
            holders = [rows[int(number)]]
        parts = rest
    if len(parts) > (3 if parts[0] == "link" else 1 if parts is rest else 2):
        raise ConfigError(f"--set {key}: expected table.key, or link.TABLE.KEY, e.g. link.air.chip_rate_hz")
    for holder in holders:
        _set_at(holder, parts, value.item() if isinstance(value, np.generic) else value, key)


def _set_at(holder: dict[str, Any], parts: Sequence[str], value: Any, key: str) -> None:
    """Set a value in a table, by the names of the tables in it on the way, which are copied."""
    *tables, last = parts
    for name in tables:
        inner = holder.get(name, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"--set {key}: {name} = {inner!r}: expected a table")
        holder[name] = copy(inner)
        holder = holder[name]
    holder[last] = value
    if tables[-1:] == ["bar"] and last == "leds_file":
        holder.pop("leds", None)
