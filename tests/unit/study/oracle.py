"""A scorer in plain loops that shares nothing with the SDK, and receivers that make faults."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

Row = dict[str, str]

COLUMNS = (
    *("transmitter", "t_us", "symbols", "distance_m", "x_px", "y_px"),
    *("distance_sigma_m", "distance_filtered_m", "echo_of"),
)


@dataclass(frozen=True)
class Lengths:
    """What a link is, in chips, by hand."""

    rate_hz: float = 1e4
    preamble: int = 26
    pilot: int = 16
    info: int = 16
    pilot_every: int = 1
    bits: int = 6

    @property
    def chip_us(self) -> float:
        return 1e6 / self.rate_hz

    def frames(self, frames: int) -> list[tuple[int, int]]:
        """(first chip, chips) of every frame of a packet."""
        found, at = [], self.preamble
        for f in range(frames):
            long = self.info + (self.pilot if f % self.pilot_every == 0 else 0)
            found.append((at, long))
            at += long
        return found

    def packet(self, frames: int) -> int:
        return self.frames(frames)[-1][0] + self.frames(frames)[-1][1]


def at(t_us: float, truth: dict[str, Any], values: list[float]) -> float:
    return float(np.interp(t_us, np.array(truth["t_s"]) * 1e6, values))


def hidden_clusters(
    bar: dict[str, Any], clusters: int, begin: float, end: float, recovery: float
) -> tuple[set, set]:
    """Clusters that are hidden from begin to end, and at any time of it."""
    whole, part = set(bar.get("covered", ())), set(bar.get("covered", ()))
    poles = [(a, b, 0, clusters - 1) for a, b in bar.get("pole_s", ())]
    for a, b, first, last in [*bar.get("cover_s", ()), *poles]:
        if begin < b * 1e6 + recovery and end > a * 1e6:
            part |= set(range(first, last + 1))
        if begin >= a * 1e6 and end <= b * 1e6:
            whole |= set(range(first, last + 1))
    return whole, part


def score(rows: list[Row], truth: dict[str, Any], lengths: Lengths, *, road: bool) -> dict[str, Any]:
    """The counts of a score, one dict a lit bar."""
    t0, duration = truth["scene"]["t0_us"], truth["scene"]["duration_s"] * 1e6
    chip = lengths.chip_us
    near = (lengths.pilot if lengths.pilot_every == 1 else min(lengths.pilot, lengths.info)) / 2 * chip
    tail, long = 2 * chip, (lengths.pilot + lengths.info + 2) * chip
    bars = []
    for i, bar in enumerate(truth["bars"]):
        if bar.get("led_w_m2") is not None and bar["led_w_m2"] <= 1e-6:
            continue
        rate = lengths.rate_hz * (1 + bar["ppm"] * 1e-6)
        sent, cut = [], []
        for q, packet in enumerate(bar["symbols"]):
            for f, (first, chips) in enumerate(lengths.frames(len(packet))):
                begin = (q * lengths.packet(len(packet)) + first - bar["start_chip"]) / rate * 1e6
                end = begin + chips / rate * 1e6
                whole, part = (
                    hidden_clusters(bar, len(packet[f]), begin, end, 3 * chip) if road else (set(), set())
                )
                if begin >= 0 and end + tail < duration and len(part) < len(packet[f]):
                    middle = (lengths.pilot if chips > lengths.info else lengths.info) / 2 * chip
                    true_m = at(begin + middle, truth, truth["distance_m"][i])
                    sent.append((begin, packet[f], true_m, whole, part))
                elif road:
                    cut.append(begin)
        bars.append(
            {"i": i, "bar": bar, "sent": sent, "cut": cut, "hit": set(), "found": 0, "wrong": 0, "bits": 0}
            | {"visible": 0, "erased": 0, "hidden": 0, "claimed": 0, "errors": [], "nees": [], "filtered": []}
        )
    unmatched = echoes = 0
    for row in rows:
        t = float(row["t_us"]) - t0
        if road and row.get("echo_of"):
            echoes += 1
            continue
        if not bars:
            unmatched += 1
            continue

        def apart(one: dict[str, Any], row: Row = row, t: float = t) -> float:
            x, y = (at(t, truth, truth["bar_centre_px"][one["i"]][axis]) for axis in (0, 1))
            return math.hypot(float(row["x_px"]) - x, float(row["y_px"]) - y)

        best = min(bars, key=apart)
        away, starts = apart(best), [abs(begin - t) for begin, *_ in best["sent"]]
        off = min(starts, default=math.inf)
        j = starts.index(off) if starts else -1
        if off > near or away > 60 or j in best["hit"]:
            dark = road and any(
                t < b * 1e6 + long and t + long > a * 1e6 for a, b in best["bar"].get("pole_s", ())
            )
            ends = t < tail or t + long > duration
            is_cut = any(abs(begin - t) <= near for begin in best["cut"])
            unmatched += not (away <= 60 and (ends or dark) and (is_cut or j not in best["hit"]))
            continue
        best["hit"].add(j)
        best["found"] += 1
        _, wanted, true_m, whole, part = best["sent"][j]
        got = row["symbols"].split()
        for k, symbol in enumerate(wanted):
            reported = got[k] if k < len(got) else "-"
            if k in whole:
                best["hidden"] += 1
                best["claimed"] += reported != "-"
            elif k not in part:
                best["visible"] += 1
                if reported == "-":
                    best["erased"] += 1
                else:
                    best["bits"] += lengths.bits
                    best["wrong"] += (int(reported) ^ symbol).bit_count()
        if row.get("distance_m"):
            error = float(row["distance_m"]) - true_m
            best["errors"].append(error)
            if row.get("distance_sigma_m"):
                best["nees"].append((error / float(row["distance_sigma_m"])) ** 2)
        if row.get("distance_filtered_m"):
            best["filtered"].append(float(row["distance_filtered_m"]) - true_m)
    return {"rows": len(rows), "unmatched": unmatched, "echoes": echoes, "bars": bars}


def faulty_rows(truth: dict[str, Any], lengths: Lengths, seed: int = 0) -> list[Row]:
    """Rows of a receiver that makes some faults of every kind."""
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    chip = lengths.chip_us
    for i, bar in enumerate(truth["bars"]):
        rate = lengths.rate_hz * (1 + bar["ppm"] * 1e-6)
        for q, packet in enumerate(bar["symbols"]):
            for f, (first, _) in enumerate(lengths.frames(len(packet))):
                begin = (q * lengths.packet(len(packet)) + first - bar["start_chip"]) / rate * 1e6
                if rng.random() < 0.1:
                    continue
                symbols = ["-" if rng.random() < 0.1 else str(s ^ int(rng.random() < 0.1)) for s in packet[f]]
                if rng.random() < 0.05:
                    symbols = symbols[: rng.integers(0, len(symbols))]
                elif rng.random() < 0.05:
                    symbols.append("1")
                distance = at(begin + 8 * chip, truth, truth["distance_m"][i]) + rng.normal(0, 0.3)
                x, y = (at(begin, truth, truth["bar_centre_px"][i][axis]) for axis in (0, 1))
                late = float(rng.choice([0.15, 7.9, 9.0, -9.0], p=[0.85, 0.05, 0.05, 0.05])) * chip
                away = rng.choice([0.0, 59.0, 100.0], p=[0.9, 0.05, 0.05])
                ranged = rng.random() < 0.95
                rows.append(
                    {
                        "transmitter": str(i),
                        "t_us": repr(float(begin + late + truth["scene"]["t0_us"])),
                        "symbols": " ".join(symbols),
                        "distance_m": repr(float(distance)) if ranged else "",
                        "x_px": repr(float(x + away)),
                        "y_px": repr(float(y)),
                        "distance_sigma_m": repr(float(rng.uniform(0.05, 0.5))) if rng.random() < 0.9 else "",
                        "distance_filtered_m": repr(float(distance) - 0.01) if rng.random() < 0.9 else "",
                        "echo_of": "0" if rng.random() < 0.1 else "",
                    }
                )
                if rng.random() < 0.05:
                    rows.append(rows[-1])
    return rows


def text_of(rows: list[Row], columns: tuple[str, ...] = COLUMNS) -> str:
    """Rows as `frames.csv`."""
    lines = [",".join(columns), *(",".join(row[c] for c in columns) for row in rows)]
    return "\n".join(lines) + "\n"
