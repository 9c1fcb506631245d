"""The figures and the tables of docs/simulator.md: the simulator against measurement and closed forms.

    python docs/figures/simulator.py [-o docs/images]

Writes simulator-pixel.png and simulator-scene.png, prints the tables. The comparison with the independent
recording needs ../shared/recordings and is left out without it.
"""

import argparse
import math
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import j0, j1
from scipy.stats import binomtest, chi2, norm

from evlcp_sdk.io import read_events
from evlcp_sdk.report.drawing import INK_COLOUR, set_heading, style_axes
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.sim import (
    BackgroundSpec,
    LensSpec,
    Scene,
    SensorSpec,
    Simulation,
    Truth,
    read_truth,
    truth_of,
)
from evlcp_sdk.sim.optics import blur_of
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.measure import statistics_of
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Events

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.models.pixels import (
    MEASURED_AREA,
    MEASURED_LATENCY,
    events_per_edge,
    latency_us,
    latency_with_readout_us,
    pixel_events,
    step_response,
)
from tests.models.truths import scene_of_truth

SHARED = Path(__file__).parents[3] / "shared" / "recordings"
SENSOR = SensorSpec()
IDEAL = replace(SENSOR, noise_ln=0.0, th_spread=0.0, p_on_miss=0.0, p_off_miss=0.0)
ON, OFF, INK = "#d55e00", "#0072b2", INK_COLOUR


def label_axes(axis: Axes, title: str, x: str, y: str) -> None:
    set_heading(axis, title)
    style_axes(axis)
    axis.set(xlabel=x, ylabel=y)


def draw_latency(axis: Axes) -> None:
    lights = np.geomspace(0.005, 0.5, 13)
    both = np.array([latency_us(SENSOR, e, SENSOR.dark_w_m2) for e in lights])
    for column, colour, name in ((0, ON, "ON"), (1, OFF, "OFF")):
        axis.loglog(lights, both[:, column], color=colour, label=f"{name}, simulated")
        axis.plot(
            list(MEASURED_LATENCY), [m[column] for m in MEASURED_LATENCY.values()], "o", color=colour, ms=4,
            label=f"{name}, measured",
        )  # fmt: skip
    axis.legend(frameon=False, fontsize=8)
    label_axes(axis, "latency of the first event", "light, W/m2", "us")
    print("| W/m2 | ON us | measured | OFF us | measured |\n|---|---|---|---|---|")
    for light, (on, off) in MEASURED_LATENCY.items():
        a, b = latency_us(SENSOR, light, SENSOR.dark_w_m2)
        print(f"| {light} | {a:.0f} | {on} ({a / on - 1:+.0%}) | {b:.0f} | {off} ({b / off - 1:+.0%}) |")


def draw_area(axis: Axes) -> None:
    sides = list(MEASURED_AREA)
    for row_us, style in ((0.2, "-"), (0.25, "--")):
        found = [latency_with_readout_us(replace(SENSOR, t_row_us=row_us), 0.277, n) for n in sides]
        axis.plot(sides, found, style, color=ON, label=f"simulated, {row_us} us a row")
        counts = ", ".join(
            f"{n} px {f:.0f} ({f / m - 1:+.0%})"
            for (n, m), f in zip(MEASURED_AREA.items(), found, strict=True)
        )
        print(f"area, {row_us} us a row: {counts}")
    axis.plot(sides, list(MEASURED_AREA.values()), "o", color=INK, ms=4, label="measured")
    axis.legend(frameon=False, fontsize=8)
    label_axes(axis, "latency of a lit square, 0.277 W/m2", "side, px", "us")


def draw_edges(axis: Axes) -> None:
    contrast = np.linspace(0.05, 2.5, 50)
    found = [events_per_edge(IDEAL, c, rising=True, steps=1000) for c in contrast]
    axis.step(
        contrast, np.floor(contrast / IDEAL.th_on), where="post", color=INK, label="floor(ln C / threshold)"
    )
    axis.plot(contrast, found, ".", color=ON, label="simulated")
    axis.legend(frameon=False, fontsize=8)
    label_axes(axis, "events of a slow, noiseless edge", "ln contrast", "events")


def draw_s_curve(axis: Axes) -> None:
    sigma = math.hypot(SENSOR.noise_ln, SENSOR.th_spread * SENSOR.th_on)
    contrast = SENSOR.th_on + sigma * np.linspace(-4, 4, 17)
    share = step_response(replace(SENSOR, p_on_miss=0.0), contrast, pixels=2000)
    bounds = np.array([binomtest(round(s * 2000), 2000).proportion_ci() for s in share])
    axis.plot(contrast, norm.cdf((contrast - SENSOR.th_on) / sigma), color=INK, label="normal distribution")
    axis.errorbar(contrast, share, np.abs(bounds.T - share), fmt=".", color=ON, lw=1, label="simulated, 95 %")
    axis.legend(frameon=False, fontsize=8)
    label_axes(axis, "share of pixels that answer a step", "ln contrast", "")


def draw_asymmetry(axis: Axes) -> None:
    lights = np.geomspace(0.01, 10, 10)
    counts = []
    for light in lights:
        edges = np.arange(1000) * 100.0
        chips = np.random.default_rng(0).integers(0, 2, 500)
        lit = np.stack([1 - chips, chips], 1).ravel()
        sensor = replace(SENSOR, p_on_miss=0.0, p_off_miss=0.0)
        events = pixel_events(sensor, edges, light + 20.0 * lit, 1e5, pixels=40)
        on = int(events.on.sum())
        counts.append((len(events.on) - on) / max(on, 1))
    axis.semilogx(lights, counts, ".-", color=OFF)
    label_axes(axis, "OFF events for one ON event, chips at 20 W/m2", "background, W/m2", "")


def draw_intervals(axis: Axes) -> None:
    edges = np.arange(2000) * 100.0
    light = np.where(np.arange(2000) % 2, 20.0, 0.05)
    events = pixel_events(SENSOR, edges, light, 2e5, pixels=20)
    gaps = np.diff(events.request_us)[np.diff(events.pixel) == 0]
    axis.hist(gaps, np.arange(0, 121, 1), color=OFF)
    axis.axvline(SENSOR.refr_us, color=INK, lw=1)
    label_axes(axis, f"intervals in a pixel; refractory time {SENSOR.refr_us:g} us", "us", "events")
    print(f"shortest interval {gaps.min():.3f} us, refractory time {SENSOR.refr_us:g} us")


def print_lens() -> None:
    """Light beyond a radius: an ideal lens's closed form, its mean over a ring of the pattern, and ours."""
    camera, lens = CameraModel(), LensSpec(blur_px=0.05)
    ring_px = lens.wavelength_nm * 1e-3 * lens.f_number / camera.pitch_um
    blur = blur_of(lens.focus_m, lens, camera)
    print("| radius px | Airy | over a ring | here |\n|---|---|---|---|")
    for radius in (1.0, 2.0, 5.0, 10.0):
        v = math.pi * (radius + ring_px * np.linspace(-0.5, 0.5, 101)) / ring_px
        closed = j0(v) ** 2 + j1(v) ** 2
        ours = float((blur.share * np.exp(-0.5 * (radius / blur.sigma_px) ** 2)).sum())
        print(f"| {radius:g} | {closed[50]:.2%} | {closed.mean():.2%} | {ours:.2%} |")


def statistics(events: Events, centre: np.ndarray, duration_s: float) -> dict[str, float]:
    """Rate, share of ON events, busy pixels and their events, width of the bar in events."""
    per_pixel = np.bincount(events.y.astype(int) * 1280 + events.x, minlength=1280 * 720) / duration_s
    busy = per_pixel > 1000
    t_us = events.t_us.astype(float)
    off = events.x - np.interp(t_us, np.arange(len(centre[0])) * 1000.0, centre[0])
    near = np.abs(off) < 8
    return {
        "Mev/s": len(events) / duration_s / 1e6,
        "share of ON events": float(events.p.mean()),
        "pixels with over 1000 events/s": float(busy.sum()),
        "their median events/s": float(np.median(per_pixel[busy])),
        "rms distance from the bar's axis, px": float(np.sqrt((off[near] ** 2).mean())),
    }


def receive(pieces: Iterable[Events], truth: Truth) -> Tally:
    """What the receiver finds."""
    receiver = Receiver(truth.bars[0].link)
    packets = [packet for piece in pieces for packet in receiver.feed(piece)] + receiver.close()
    return statistics_of(frames_of(packets), truth).total()


def compare() -> None:
    paths = sorted(SHARED.glob("*-*m-*kmh.raw"))
    if not paths:
        print("no ../shared/recordings: comparison left out")
        return
    truth = read_truth(SHARED / "night-50m-30kmh.truth.json")
    scene = scene_of_truth(truth.table)
    columns = []
    for events, truth_ in (
        (read_events(SHARED / "night-50m-30kmh.raw"), truth),
        *(
            (Events.concat(Simulation(made).stream()), truth_of(made))
            for made in (
                scene,
                replace(scene, sensor=SENSOR),
                replace(scene, sensor=SENSOR, lens=replace(scene.lens, wings=True)),
            )
        ),
    ):
        columns.append(statistics(events, truth_.bars[0].centre_px.T, scene.duration_s))
    print("| | recording | its parameters here | our sensor | our sensor and lens |\n|---|---|---|---|---|")
    for key in columns[0]:
        print(f"| {key} | " + " | ".join(f"{c[key]:.4g}" for c in columns) + " |")
    print("| | Mev/s | ON share | frames | wrong bits | RMSE m (95 %) |\n|---|---|---|---|---|---|")
    for path in paths:
        truth = read_truth(path.with_suffix(".truth.json"))
        made = scene_of_truth(truth.table)
        for name, events, truth_ in (
            (path.stem, read_events(path), truth),
            ("simulated", Events.concat(Simulation(made).stream()), truth_of(made)),
        ):
            score = receive([events], truth_)
            tails = chi2.ppf([0.975, 0.025], score.ranged)
            low, high = score.rmse_m * np.sqrt(score.ranged / tails)
            print(
                f"| {name} | {len(events) / made.duration_s / 1e6:.2f} | {events.p.mean():.3f}"
                f" | {score.frames_found}/{score.frames_sent} | {score.bit_errors}"
                f" | {score.rmse_m:.3f} ({low:.3f} to {high:.3f}) |",
                flush=True,
            )


def compare_road() -> None:
    paths = sorted((SHARED / "road").glob("*.raw"))
    if not paths:
        print("no ../shared/recordings/road: comparison left out")
        return
    print("| recording | Mev/s | here | share of ON events | here |\n|---|---|---|---|---|")
    for path in paths:
        truth = read_truth(path.with_suffix(".truth.json"))
        made = scene_of_truth(truth.table)
        theirs, ours = read_events(path), Events.concat(Simulation(made).stream())
        rates = (f"{len(events) / made.duration_s / 1e6:.2f}" for events in (theirs, ours))
        shares = (f"{events.p.mean():.3f}" for events in (theirs, ours))
        print(f"| {path.stem} | " + " | ".join((*rates, *shares)) + " |", flush=True)


def draw_scene(figure: Figure) -> None:
    image, chips = figure.subplots(1, 2, width_ratios=[1, 2.2])
    scene = Scene(duration_s=0.02, background=BackgroundSpec(light_w_m2=0.05))
    events = Events.concat(Simulation(scene).stream())
    counts = np.zeros((720, 1280))
    np.add.at(counts, (events.y, events.x), 1)
    x, y = (int(np.median(v)) for v in (events.x, events.y))
    image.imshow(
        np.log1p(counts[y - 90 : y + 90, x - 25 : x + 25]), cmap="Greys", interpolation="nearest",
        extent=(x - 25.5, x + 24.5, y + 89.5, y - 90.5), zorder=1,
    )  # fmt: skip
    label_axes(image, "events of 20 ms, 50 m ahead", "column, px", "row, px")
    shown = (events.t_us >= 8000) & (events.t_us < 10_000)
    for on, colour in ((1, ON), (0, OFF)):
        some = shown & (events.p == on)
        chips.plot(events.t_us[some] / 1e3, events.y[some], ",", color=colour)
    chips.set(ylim=(y + 90, y - 90))
    label_axes(chips, "the same, ON red, OFF blue", "ms", "row, px")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path(__file__).parents[1] / "images")
    args = parser.parse_args()
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    draws = (draw_latency, draw_area, draw_edges, draw_s_curve, draw_asymmetry, draw_intervals)
    for axis, draw in zip(axes, draws, strict=True):
        draw(axis)
    figure.savefig(args.out / "simulator-pixel.png", dpi=110)
    print_lens()
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    draw_scene(figure)
    figure.savefig(args.out / "simulator-scene.png", dpi=110)
    compare()
    compare_road()


if __name__ == "__main__":
    main()
