"""The pictures of docs/how.md: real output of the receiver on the recording that comes with the package.

    python docs/figures/how.py docs/images

The last one simulates a still camera at several distances and takes a minute.
"""

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from evlcp_poc.correlation import full_band, phase_only_correlation
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import evlcp_sdk as evlcp
from evlcp_sdk.air.codebook import edges_of_chips
from evlcp_sdk.report.colours import cluster_colours
from evlcp_sdk.report.drawing import set_heading, style_axes
from evlcp_sdk.study.bound import frame_bound

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "examples" / "recordings" / "night-50m-30kmh-cut.raw"
ON, OFF, INK = "#d99a00", "#2f7fd6", "#333333"
SHOWN = 3
"""Which frame of the recording the pictures show."""


class Probe:
    """What the stages of the receiver find."""

    def __init__(self) -> None:
        self.found: dict[str, list[Any]] = defaultdict(list)

    @evlcp.hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep it."""
        self.found[stage].append(value)


class Recording:
    """The recording, and what the receiver says of it."""

    def __init__(self) -> None:
        probe = Probe()
        registry = evlcp.Registry.load(probe)
        self.link = evlcp.load_link()
        self.packets = list(evlcp.receive(RECORDING, self.link, registry=registry))
        self.events = evlcp.read_events(RECORDING)
        self.found = probe.found
        self.frame = self.found["frame"][SHOWN]
        self.view = self.found["view"][SHOWN]
        self.lock = self.found["synchronization"][0]
        self.chip_us = self.lock.chip_us

    def near_the_bar(self) -> np.ndarray:
        """Which events lie where the bar is at one time or another of the recording."""
        e, paths = self.events, self.found["regions"]
        left, right = min(r.x_px for r in paths) - 8, max(r.x_px for r in paths) + 8
        return (e.x >= left) & (e.x <= right) & (np.abs(e.y - self.frame.y_px) <= 110)


def pixel(r: Recording) -> Figure:
    """The events of one pixel beside the chips that its cluster sent."""
    frame, link, chip = r.frame, r.link, r.chip_us
    start, e = frame.t_us, r.events
    e = e[(e.t_us >= start) & (e.t_us < start + 32 * chip)]
    cluster = 7
    x, y = np.rint(frame.points_px[cluster]).astype(int)
    sent = np.concatenate(
        [link.codebook.pilots[cluster], link.codebook.codewords[frame.soft.symbols[cluster]]]
    )
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(8, 3.6), height_ratios=(1, 2), sharex=True)
    top.stairs(sent, np.arange(33) * chip / 1e3, fill=True, color="#f0b429")
    top.set(ylim=(-0.1, 1.2), yticks=(0, 1), yticklabels=("dark", "lit"))
    set_heading(top, f"What cluster {cluster} sent in a frame, and what four of its pixels saw")
    for row in range(4):
        mine = e[(e.x == x) & (e.y == y - 2 + row)]
        for value, colour in ((1, ON), (0, OFF)):
            times = (mine.t_us[mine.p == value] - start) / 1e3
            bottom.vlines(
                times, row + (0 if value else -0.4), row + (0.4 if value else 0), color=colour, lw=1.6
            )
        bottom.axhline(row, color="#bbbbbb", lw=0.6)
    bottom.set(yticks=range(4), yticklabels=[f"row {y - 2 + row}" for row in range(4)], xlabel="ms")
    bottom.set(xlim=(0, 32 * chip / 1e3))
    for axis in (top, bottom):
        style_axes(axis)
    bottom.plot([], [], color=ON, label="brighter (ON)")
    bottom.plot([], [], color=OFF, label="darker (OFF)")
    bottom.legend(loc="upper center", bbox_to_anchor=(0.5, -0.3), ncols=2, frameon=False)
    return figure


def codes(r: Recording) -> Figure:
    """The pilots, how they correlate with one another, and the preamble with itself."""
    book = r.link.codebook
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(9, 3))
    left.imshow(book.pilots, cmap=mpl.colors.ListedColormap(["#3a3a3a", "#f0b429"]), aspect="auto")
    left.set(xlabel="chip", ylabel="cluster")
    set_heading(left, "Pilots, lit or dark")
    values = book.pilot_edges.astype(float)
    shown = middle.imshow(values @ values.T / values.shape[1], cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(shown, ax=middle, shrink=0.8)
    middle.set(xlabel="cluster", ylabel="cluster")
    set_heading(middle, "Correlation of pilots")
    barker = edges_of_chips(book.preamble)[::2].astype(float)
    against = np.correlate(barker, barker, "full")
    right.stem(np.arange(len(against)) - len(barker) + 1, against, basefmt=" ")
    right.set(xlabel="shift, values", ylabel="correlation")
    set_heading(right, "Preamble against itself")
    style_axes(right)
    return figure


def regions(r: Recording) -> Figure:
    """Four milliseconds of events, and how long after another pixels rise again."""
    e, frame = r.events, r.frame
    now = e[(e.t_us >= frame.t_us) & (e.t_us < frame.t_us + 4000)]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=(1, 1.2))
    left.scatter(now.x[::3], now.y[::3], s=0.4, c=np.where(now.p[::3], ON, OFF), linewidths=0)
    region = r.found["regions"][5]
    corner = (region.x_px - region.width_px / 2 - 6, region.y_px - region.height_px / 2 - 6)
    left.add_patch(
        mpl.patches.Rectangle(
            corner, region.width_px + 12, region.height_px + 12, fill=False, color="#c0272d"
        )
    )
    left.set(xlim=(0, 1280), ylim=(720, 0), aspect="equal", xlabel="column, px", ylabel="row, px")
    set_heading(left, "Events of 4 ms, and the region found")
    inside = r.near_the_bar()
    for chosen, name, colour in ((inside, "where the bar is", "#c0272d"), (~inside, "elsewhere", "#888888")):
        apart = rises_apart(e[chosen]) / r.chip_us
        count, edges = np.histogram(apart, bins=np.arange(0.5, 8.5, 0.05))
        right.stairs(count, edges, color=colour, label=f"{name}: {len(apart)} pairs")
    right.set(xlabel="from one rise of a pixel to the next, chips", ylabel="pairs of rises")
    right.legend(frameon=False)
    set_heading(right, "The rhythm of the rises")
    style_axes(right)
    return figure


def rises_apart(e: "evlcp.Events") -> np.ndarray:
    """Times between rises of the same pixel, us; a rise is an ON event more than 60 us after another."""
    on = e[e.p == 1]
    pixels = on.y.astype(np.int64) * 1280 + on.x
    order = np.lexsort((on.t_us, pixels))
    apart, same = np.diff(on.t_us[order]), np.diff(pixels[order]) == 0
    first = np.concatenate([[True], ~same | (apart > 60)])
    times, where = on.t_us[order][first], pixels[order][first]
    between = np.diff(times)[np.diff(where) == 0]
    return between[between < 800]


def timing(r: Recording) -> Figure:
    """The preamble's correlation with the signed events of the region."""
    book, chip, e = r.link.codebook, r.chip_us, r.events[r.near_the_bar()]
    step = chip / 10
    signed, edges = np.histogram(e.t_us, bins=np.arange(e.t_us[0], e.t_us[-1], step), weights=2.0 * e.p - 1.0)
    window = np.convolve(signed, np.ones(10), "valid")
    template = edges_of_chips(book.preamble)[::2].astype(float)
    taps = np.arange(len(template)) * 20 + 10
    most = len(window) - taps[-1]
    windows = np.stack([window[t : t + most] for t in taps])
    score = template @ windows / (np.linalg.norm(template) * np.linalg.norm(windows, axis=0) + 1e-9)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), width_ratios=(2, 1), sharey=True)
    at = edges[:most]
    left.plot(at / 1e3, score, color=INK, lw=0.7)
    for lock in r.found["synchronization"]:
        left.axvline(lock.packet_t_us / 1e3, color="#c0272d", lw=1, ls=":")
    left.set(xlabel="camera time, ms", ylabel="correlation")
    set_heading(left, "Correlation with the preamble; dotted: packets that the receiver found")
    right.plot((at - r.lock.packet_t_us) / chip, score, ".-", color=INK, lw=0.8, ms=3)
    right.set(xlim=(-4, 4), xlabel="chips from the packet's start")
    set_heading(right, "The first peak")
    for axis in (left, right):
        style_axes(axis)
    return figure


def clusters(r: Recording) -> Figure:
    """Which cell shows which cluster."""
    shown = r.view.presence
    colours = cluster_colours(len(shown.probability))
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(9, 4.2), width_ratios=(1, 1, 3))
    total = np.abs(r.view.sums).sum(0)
    left.imshow(total, cmap="gray", aspect="equal")
    set_heading(left, "Events")
    picture = np.ones((*shown.selected.shape[1:], 3))
    for k, chosen in enumerate(shown.selected):
        picture[chosen] = colours[k][:3]
    middle.imshow(picture, aspect="equal")
    set_heading(middle, "Cells")
    for axis in (left, middle):
        axis.set(xticks=[], yticks=[])
    rows = np.arange(shown.pixels.shape[1])
    for k, each in enumerate(shown.pixels):
        right.plot(rows, each.sum(1), color=colours[k], lw=1.2)
        right.text(rows[each.sum(1).argmax()], each.sum(1).max(), str(k), ha="center", va="bottom", size=8)
    right.set(xlabel="row of the region, px", ylabel="correlation with the pilot")
    set_heading(right, "Each cluster's pilot, row by row")
    style_axes(right)
    return figure


def symbols(r: Recording) -> Figure:
    """One cluster's info values against all codewords, and the log-likelihood ratios of its bits."""
    k, book = 5, r.link.codebook
    cells = np.kron(r.view.presence.selected[k], np.ones((2, 2), bool))
    height, width = r.view.sums.shape[1:]
    cells = cells[:height, :width]
    counts = r.view.sums[:, : cells.shape[0], : cells.shape[1]][:, cells].sum(1).astype(float)
    values = counts[book.pilots.shape[1] :][1::2]
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(9, 3), width_ratios=(1, 1.6, 1))
    left.bar(range(len(values)), values, color=np.where(values > 0, ON, OFF))
    left.set(xticks=range(len(values)), xlabel="value", ylabel="ON less OFF events")
    set_heading(left, f"What cluster {k} showed")
    score = book.codeword_edges @ values
    symbol = r.frame.soft.symbols[k]
    middle.bar(range(len(score)), score, color="#999999")
    middle.bar([symbol], [score[symbol]], color="#c0272d")
    middle.set(xlabel="symbol", ylabel="correlation")
    set_heading(middle, f"Against all codewords: {symbol}")
    bits = r.frame.soft.llr[k]
    right.bar(range(len(bits)), bits, color=np.where(bits > 0, "#999999", "#333333"))
    right.axhline(0, color=INK, lw=0.6)
    right.set(xlabel="bit", ylabel="ln P(0) / P(1)")
    set_heading(right, f"Its bits: {symbol:06b}")
    for axis in (left, middle, right):
        style_axes(axis)
    return figure


def distance(r: Recording) -> Figure:
    """Phase-only correlation of two clusters, and errors of two rangings beside their bound."""
    maps = r.view.presence.pixels
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    size, pair = maps.shape[1:], (np.array([2]), np.array([13]))
    images, shifts = np.ascontiguousarray(maps.swapaxes(0, 1)), [range(n) for n in size]
    peak = phase_only_correlation(images, size, pair, full_band(*size), *shifts)[:, 0]
    left.plot(peak.max(1), ".-", color=INK, lw=0.8, ms=3)
    left.set(xlabel="shift down, px", ylabel="correlation")
    set_heading(left, "Phase-only correlation, clusters 2 and 13")
    style_axes(left)
    metres = (20, 35, 50, 65, 80, 95)
    rms: dict[str, list[float]] = defaultdict(list)
    for away in metres:
        scene = {
            "duration_s": 0.25,
            "motion": {"distance_m": float(away), "speed_mps": 0.0},
            "bars": [{"x_m": 0.0}],
        }
        for name in ("joint-scale", "poc"):
            link, probe = evlcp.load_link(overrides=[f"ranging.id={name}"]), Probe()
            with evlcp.simulate(scene, seed=away) as source:
                list(evlcp.receive(source, link, registry=evlcp.Registry.load(probe)))
            off = [f.range.distance_m - away for f in probe.found["frame"] if np.isfinite(f.range.distance_m)]
            rms[name].append(float(np.sqrt(np.mean(np.square(off)))))
            print(f"{name} at {away} m: {len(off)} frames, RMSE {rms[name][-1]:.4f} m", flush=True)
        bound = frame_bound(link)
        least = [bound(view).sigma_m for view in probe.found["view"]]
        rms["bound"].append(float(np.sqrt(np.nanmean(np.square(least)))))
        print(f"bound at {away} m: {rms['bound'][-1]:.4f} m", flush=True)
    for name, look in (("poc", {"color": OFF}), ("joint-scale", {"color": "#c0272d"})):
        right.plot(metres, rms[name], "o-", label=name, **look)
    right.plot(metres, rms["bound"], color=INK, ls="--", label="bound")
    right.set(yscale="log", xlabel="distance, m", ylabel="RMSE of a frame, m")
    right.legend(frameon=False)
    set_heading(right, "Errors and their bound")
    style_axes(right)
    return figure


PICTURES = {
    "pixel": pixel,
    "codes": codes,
    "regions": regions,
    "timing": timing,
    "clusters": clusters,
    "symbols": symbols,
    "distance": distance,
}


def main(folder: Path, names: list[str]) -> None:
    recording = Recording()
    for name in names or PICTURES:
        figure = PICTURES[name](recording)
        figure.tight_layout()
        figure.savefig(folder / f"how-{name}.png", dpi=110)
        plt.close(figure)


if __name__ == "__main__":
    mpl.use("Agg")
    mpl.rcParams.update({"font.size": 9})
    main(Path(sys.argv[1]), sys.argv[2:])
