"""`report.html`: a recording on one page, which opens anywhere, asks no network, and is read on a phone, too.

What is shown is kept as it comes, a bounded share of it, so that a recording of any length takes constant
memory; all frames are in `frames.csv`, all messages in `packets.jsonl`.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from evlcp_sdk.diagnosis.facts import Diagnostic
from evlcp_sdk.place.navigator import Settled
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.report.colours import transmitter_colour
from evlcp_sdk.report.figures import Thinned
from evlcp_sdk.report.motion import MotionProbe
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.report.plots import INK, SCRIPT, Plot, ellipse, enlarge_ellipses
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run, Sink
from evlcp_sdk.spelling import counted
from evlcp_sdk.values import Events, Frame, Packet

_MOST_TRANSMITTERS = 6
_MOST_POINTS = 512
_MOST_ROWS = 40
_MOST_MESSAGES = 50
_MOST_ELLIPSES = 40
_MOST_CHARACTERS = 2_000

_SECONDS = 5.0
"""Length of a recording whose charts count in seconds."""


@dataclass(eq=False)
class _Seen:
    """What is kept of a transmitter.

    Attributes:
        frames: A share of its frames, for the charts.
        first: The first ones, for the table.
        count: How many there were.
        echo_of: Of which transmitter it is a reflection, as the newest packet says.
        link: Name of its link, where there are several.
    """

    frames: Thinned[Frame] = field(default_factory=lambda: Thinned(_MOST_POINTS))
    first: list[Frame] = field(default_factory=list)
    count: int = 0
    echo_of: int | None = None
    link: str = ""


class Report(Sink):
    """Writes `report.html`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._motion = MotionProbe(3 * max(len(run.links), 1))
        self._track = Thinned[Settled](1024)
        self._seen: dict[int, _Seen] = {}
        self._first_us: int | None = None
        self._messages: list[tuple[str, ...]] = []
        self._latest: deque[tuple[str, ...]] = deque(maxlen=_MOST_MESSAGES)
        self._many_messages = 0
        self._axis, self._step_ms = "ms since the first event", 1.0

    def events(self, events: Events) -> None:
        """Note when the recording starts."""
        if self._first_us is None and len(events):
            self._first_us = int(events.t_us[0])

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep what frames look like."""
        self._motion.evlcp_stage_finished(stage, value)

    def packet(self, packet: Packet) -> None:
        """Keep frames and messages."""
        number = packet.transmitter
        if packet.frames and (number in self._seen or len(self._seen) < _MOST_TRANSMITTERS):
            seen = self._seen.setdefault(number, _Seen(link=packet.link))
            seen.echo_of = packet.echo_of
            for frame in packet.frames:
                seen.count += 1
                seen.frames.add(frame)
                if len(seen.first) < _MOST_ROWS:
                    seen.first.append(frame)
        for message in packet.messages:
            self._many_messages += 1
            row = (
                f"{self._ms(message.t_us):.1f}",
                message.kind.name,
                str(message.message.transmitter_id),
                message.trust,
                message.said(_MOST_CHARACTERS),
            )
            (self._messages if len(self._messages) < _MOST_MESSAGES else self._latest).append(row)

    def settle(self, settled: Sequence[Settled]) -> None:
        """Keep places."""
        for one in settled:
            self._track.add(one)

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Write the page, which is the same for the same recording: how long it took is not in it."""
        if summary["recording"]["duration_s"] > _SECONDS:
            self._axis, self._step_ms = "s since the first event", 1000.0
        motions = [
            motion.to_dict(link.codebook, link.packet.chip_us, self._ms)
            for motion in self._motion.motions()
            # What another link fitted better is not given.
            if motion.frame.transmitter in self._seen or not self.run.links
            for link in [self.run.link_of(motion.frame.link)]
        ]
        distances, quality, image = self._charts()
        places = self._map()
        plots = [*distances, quality, image] * bool(self._seen) + (places or [])
        messages = [*self._messages, *self._latest]
        # Its labels are known once a chart is drawn.
        held = {plot.id: plot.markup() for plot in plots}
        page = render_page(
            "recording.html",
            f"{self.run.name}: report",
            [SCRIPT, files("evlcp_sdk.report").joinpath("report.js").read_text(encoding="utf-8")],
            {"plots": {plot.id: plot.labels for plot in plots}, "report": {"motions": motions}},
            name=self.run.name,
            summary=summary,
            figures=self._headline(summary),
            warnings=[
                (Diagnostic(**{**one, "next_step": ""}), one["next_step"]) for one in summary["warnings"]
            ],
            notes=[Diagnostic(**one) for one in summary["notes"]],
            counts={name: value for name, value in summary["counts"].items() if value},
            motions=motions,
            held=held,
            distances=distances,
            seen=self._seen,
            received=sum(seen.count for seen in self._seen.values()),
            shown=sum(len(seen.frames) for seen in self._seen.values()),
            places=places,
            placed=len(self._track) > 0,
            messages=messages,
            left_out=self._many_messages - len(messages),
            symbols=self._symbols(),
        )
        self.folder.open("report.html").write(page)

    def _ms(self, t_us: float) -> float:
        """Time since the first event, ms."""
        return (t_us - (self._first_us or 0)) * 1e-3

    def _headline(self, summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
        """The figures that a reader looks for first: what each is, its value, and a note."""
        recording = summary["recording"]
        own = [t for t in summary["transmitters"] if t["echo_of"] is None]
        given = sum(t["symbols_given"] for t in own)
        found, expected = (sum(t[key] for t in own) for key in ("frames_found", "frames_expected"))
        figures = [("frames", f"{found:,}", f"of {expected:,} sent" if found else "")]
        if found:
            erased = sum(t["symbols_erased"] for t in own)
            bits = sum(
                t["symbols_given"] * self.run.link_of(t.get("link", "")).codebook.bits_per_symbol for t in own
            )
            not_seen = f"{erased / (given + erased):.1%} of symbols not given" if erased else ""
            quality = sum(t["quality"] * t["frames_found"] for t in own) / found
            figures += [
                ("bits", f"{bits:,}", not_seen),
                ("quality", f"{quality:.1%}", "of frames expected to be right"),
            ]
        figures += _distances(own)
        if len(summary["transmitters"]) > 1:
            echoes = len(summary["transmitters"]) - len(own)
            note = f"and {echoes} reflection{'s' * (echoes != 1)}" if echoes else ""
            figures.append(("transmitters", str(len(own)), note))
        if summary["messages_off"] is None:
            figures.append(("messages", f"{summary['counts'].get('messages', 0):,}", ""))
        if "positions" in summary:
            refused = sum(summary["positions"]["refused"].values())
            note = f"{refused} refused" if refused else ""
            figures.append(("positions", f"{summary['positions']['fixes']:,}", note))
        figures += [
            ("recording", f"{recording['duration_s']:.3g} s", f"{recording['counts']['events']:,} events"),
        ]
        return figures

    def _charts(self) -> tuple[list[Plot], Plot, Plot]:
        """Distance of each transmitter and quality over time, and where in the image."""
        camera = self.run.link.camera
        distances: list[Plot] = []
        quality = Plot("quality", self._axis, "quality", y_limits=(-0.03, 1.06))
        image = Plot(
            "image",
            "column, px",
            "row, px",
            aspect=camera.width / camera.height,
            down=True,
            x_limits=(0, camera.width),
            y_limits=(0, camera.height),
        )
        for number, seen in sorted(self._seen.items()):
            frames = sorted(seen.frames, key=lambda frame: frame.t_us)
            colour, who = transmitter_colour(number), _who(number, seen.echo_of, seen.link)
            t = np.array([self._ms(frame.t_us) for frame in frames]) / self._step_ms
            depth = np.array([frame.range.distance_m for frame in frames])
            sigma = np.array([frame.range.sigma_m for frame in frames])
            labels = [f"{who}\n{_describe(frame, self._ms(frame.t_us))}" for frame in frames]
            known = np.isfinite(depth)
            distance = Plot(f"distance-{number}", self._axis, "distance, m")
            distances.append(distance)
            name = f"{who}, with one sigma"
            distance.dots(t, depth, colour, name, labels)
            distance.band(t[known], (depth - sigma)[known], (depth + sigma)[known], colour, name)
            filtered = [math.nan if f.filtered is None else f.filtered.distance_m for f in frames]
            if np.isfinite(filtered).any():
                distance.line(t, filtered, colour, f"{who}, filtered")
            quality.dots(t, [frame.soft.quality for frame in frames], colour, who, labels)
            places = np.array([(frame.x_px, frame.y_px) for frame in frames])
            image.dots(places[:, 0], places[:, 1], colour, who, labels)
            if len(frames) and np.isfinite(places[-1]).all():
                image.name(float(places[-1, 0]), float(places[-1, 1]), str(number))
        return [plot for plot in distances if not plot.empty], quality, image

    def _map(self) -> list[Plot] | None:
        """Fixes and bars in local metres, and the sigmas over time; None where no positions are computed."""
        navigator = self.run.navigator
        if navigator is None:
            return None
        points = list(self._track)
        plan = Plot("map", "east, m", "north, m", aspect=4 / 3)
        close = Plot("track", "east, m", "north, m", aspect=4 / 3)
        height = Plot("height", self._axis, "up, m")
        spread = Plot("spread", self._axis, "sigma, m")
        if points:
            fixed = np.array([point.fix.enu_m for point in points])
            smooth = np.array([point.smoothed.enu_m for point in points])
            t_ms = np.array([self._ms(point.fix.t_us) for point in points])
            sigma = np.sqrt([np.diag(point.fix.covariance_m2) for point in points])
            labels = [
                f"{ms:.1f} ms, {p.fix.source}\neast {e:z.3f} ± {se:.2g} m\nnorth {n:z.3f} ± {sn:.2g} m"
                f"\nup {u:z.3f} ± {su:.2g} m"
                for p, ms, (e, n, u), (se, sn, su) in zip(
                    points, t_ms.tolist(), fixed.tolist(), sigma.tolist(), strict=True
                )
            ]
            chosen = points[:: max(1, -(-len(points) // _MOST_ELLIPSES))]
            larger = enlarge_ellipses([point.fix.covariance_m2 for point in chosen], fixed)
            name = "95 % ellipse" + (f", {larger} times as large" if larger > 1 else "")
            for point in chosen:
                covariance = point.fix.covariance_m2[:2, :2] * larger**2
                close.ring(ellipse(point.fix.enu_m[:2], covariance, 0.95), "#999999", name)
            for plot in (plan, close):
                plot.line(smooth[:, 0], smooth[:, 1], "#d55e00", "smoothed")
                plot.dots(fixed[:, 0], fixed[:, 1], "#56b4e9", "fix", labels)
            t = t_ms / self._step_ms
            height.band(t, fixed[:, 2] - sigma[:, 2], fixed[:, 2] + sigma[:, 2], "#56b4e9")
            height.dots(t, fixed[:, 2], "#56b4e9", "fix, with one sigma", labels)
            height.line(t, smooth[:, 2], "#d55e00", "smoothed")
            for i, name in enumerate(("east", "north", "up")):
                spread.dots(t, sigma[:, i], transmitter_colour(i), name, labels)
        for number, enu in sorted(navigator.bars_enu_m().items()):
            who = f"bar {number}"
            east, north, up = enu.tolist()
            place = f"{who}\neast {east:z.3f} m\nnorth {north:z.3f} m\nup {up:z.3f} m"
            plan.dots([east], [north], INK, "bar", [place])
            plan.name(east, north, who)
        return [plot for plot in (plan, close, height, spread) if not plot.empty]

    def _symbols(self) -> list[tuple[str, int, int, list[Any]]]:
        """The symbols of the first frames of each transmitter: title, clusters, codewords, and rows."""
        tables = []
        for number, seen in sorted(self._seen.items()):
            rows = []
            book = self.run.link_of(seen.link).codebook
            for frame in seen.first:
                depth = frame.range
                found = f"{depth.distance_m:.2f} ± {depth.sigma_m:.2f}"
                start = (
                    f"{frame.packet}/{frame.frame}",
                    f"{self._ms(frame.t_us):.1f}",
                    found if math.isfinite(depth.distance_m) else "-",
                    f"{frame.soft.quality:.2f}",
                )
                rows.append((start, frame.soft.symbols.tolist()))
            title = f"{_who(number, seen.echo_of, seen.link)}: {counted(seen.count, 'frame')}"
            title += f", the first {len(seen.first)}" * (seen.count > len(seen.first))
            tables.append((title, book.clusters, max(len(book.codewords), 1), rows))
        return tables


def _who(number: int, echo_of: int | None, link: str) -> str:
    who = f"transmitter {number}" + (f" ({link})" if link else "")
    return who + ("" if echo_of is None else f", reflection of {echo_of}")


def _describe(frame: Frame, ms: float) -> str:
    """A frame where the pointer is."""
    depth = frame.range
    lines = [f"packet {frame.packet}, frame {frame.frame}, {ms:.1f} ms"]
    if math.isfinite(depth.distance_m):
        lines.append(f"{depth.distance_m:.4f} ± {depth.sigma_m:.4f} m")
    lines.append(f"quality {frame.soft.quality:.4f}")
    return "\n".join(lines)


def _distances(own: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """From where to where transmitters are, and how often; nothing where no frame says so."""
    distances = [t[key] for t in own for key in ("distance_first_m", "distance_last_m")]
    distances = [d for d in distances if d is not None]
    if not distances:
        return []
    shown = f"{distances[0]:.2f} to {distances[-1]:.2f} m"
    if len(own) > 1:
        shown = f"{min(distances):.1f} to {max(distances):.1f} m"
    return [("distance", shown, f"{sum(t['frames_ranged'] for t in own):,} frames have one")]
