"""`report.html`: a recording on one page, which opens anywhere without a network, also on a phone.

A bounded share of the data is kept as it comes, so that recordings of any length take constant memory; all
frames are in `frames.csv`, all messages in `packets.jsonl`.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from evlcp_sdk.diagnosis.facts import Diagnostic
from evlcp_sdk.formatting import format_count
from evlcp_sdk.plugin.hooks import hookimpl
from evlcp_sdk.report.colours import transmitter_colour
from evlcp_sdk.report.motion import Motion
from evlcp_sdk.report.pages import render_page
from evlcp_sdk.report.plots import SCRIPT, Plot, render_plot
from evlcp_sdk.report.recording import (
    ChartSink,
    TimeAxis,
    label_frames,
    name_transmitter,
    plot_distances,
    plot_positions,
    plot_quality,
    seconds_axis,
)
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.sink import Run
from evlcp_sdk.values import Frame, FrameView, Packet, ReceivedMessage

_MAX_MESSAGES = 50
_MAX_TEXT = 2_000
_MAX_MOTIONS = 3
"""Transmitters of a link with a frame in slow motion."""

_LONG_S = 5.0
"""Duration of a recording from which on its charts are in seconds."""


class Report(ChartSink):
    """Writes `report.html`."""

    def __init__(self, folder: ResultFolder, run: Run) -> None:
        super().__init__(folder, run)
        self._view: FrameView | None = None
        self._motions: dict[int, Motion] = {}
        self._messages: list[ReceivedMessage] = []
        self._latest: deque[ReceivedMessage] = deque(maxlen=_MAX_MESSAGES)
        self._message_count = 0

    @hookimpl
    def evlcp_stage_finished(self, stage: str, value: Any) -> None:
        """Keep of the first transmitters the frame that shows most."""
        if stage == "view":
            self._view = value
        elif stage == "frame":
            view, self._view = self._view, None
            # A frame without a pilot has no view, and looks as the one with its pilot.
            if view is not None and view.soft.symbols.shape == value.soft.symbols.shape:
                self._keep_motion(value, view)

    def _keep_motion(self, frame: Frame, view: FrameView) -> None:
        last = self._motions.get(frame.transmitter)
        has_room = len(self._motions) < _MAX_MOTIONS * max(len(self.run.links), 1)
        if has_room if last is None else last.shows_less_than(frame, view):
            self._motions[frame.transmitter] = Motion.of(frame, view)

    def packet(self, packet: Packet) -> None:
        """Keep frames and messages."""
        super().packet(packet)
        for message in packet.messages:
            self._message_count += 1
            (self._messages if len(self._messages) < _MAX_MESSAGES else self._latest).append(message)

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Write the page, the same for the same recording."""
        axis = TimeAxis("ms since the first event", self.first_us or 0, 1.0)
        if summary["recording"]["duration_s"] > _LONG_S:
            axis = seconds_axis(axis.zero_us)
        motions = [
            motion.to_dict(link.codebook, link.packet.chip_us, axis.ms)
            for number, motion in sorted(self._motions.items())
            # Transmitters that another link fitted better are not given.
            if number in self.transmitters or not self.run.links
            for link in [self.run.link_of(motion.frame.link)]
        ]
        frames = self.frames()
        distances = [p for number, one in frames.items() for p in plot_distances(number, *one, axis)]
        navigator = self.run.navigator
        places = None
        if navigator is not None:
            places = plot_positions([*self.track], navigator.bars_enu_m(), axis)
        frame_plots = [*distances, plot_quality(frames, axis), self._plot_places(frames, axis)]
        plots = frame_plots * bool(self.transmitters) + (places or [])
        messages = [*self._messages, *self._latest]
        rendered = {plot.id: render_plot(plot) for plot in plots}
        page = render_page(
            "recording.html",
            f"{self.run.name}: report",
            [SCRIPT, files("evlcp_sdk.report").joinpath("report.js").read_text(encoding="utf-8")],
            {
                "plots": {id: labels for id, (_, labels) in rendered.items()},
                "report": {"motions": motions},
            },
            name=self.run.name,
            summary=summary,
            figures=self._headline_figures(summary),
            warnings=[Diagnostic(**one) for one in summary["warnings"]],
            notes=[Diagnostic(**one) for one in summary["notes"]],
            counts={name: value for name, value in summary["counts"].items() if value},
            motions=motions,
            charts={id: chart for id, (chart, _) in rendered.items()},
            distances=distances,
            transmitters=self.transmitters,
            received=sum(one.count for one in self.transmitters.values()),
            shown=sum(len(one.frames) for one in self.transmitters.values()),
            places=places,
            placed=len(self.track) > 0,
            messages=[
                (
                    f"{axis.ms(m.t_us):.1f}",
                    m.kind.name,
                    m.message.transmitter_id,
                    m.trust,
                    m.summary(_MAX_TEXT),
                )
                for m in messages
            ],
            left_out=self._message_count - len(messages),
            axis=axis,
            books={number: self.run.link_of(one.link).codebook for number, one in self.transmitters.items()},
            name_transmitter=name_transmitter,
            counted=format_count,
        )
        self.folder.open("report.html").write(page)

    def _headline_figures(self, summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
        recording = summary["recording"]
        bars = [t for t in summary["transmitters"] if t["echo_of"] is None]
        given = sum(t["symbols_given"] for t in bars)
        found, expected = (sum(t[key] for t in bars) for key in ("frames_found", "frames_expected"))
        figures = [("frames", f"{found:,}", f"of {expected:,} sent" if found else "")]
        if found:
            erased = sum(t["symbols_erased"] for t in bars)
            bits = sum(
                t["symbols_given"] * self.run.link_of(t.get("link", "")).codebook.bits_per_symbol
                for t in bars
            )
            erased_note = f"{erased / (given + erased):.1%} of symbols not given" if erased else ""
            quality = sum(t["quality"] * t["frames_found"] for t in bars) / found
            figures += [
                ("bits", f"{bits:,}", erased_note),
                ("quality", f"{quality:.1%}", "of frames expected to be right"),
            ]
        figures += _distance_figures(bars)
        if len(summary["transmitters"]) > 1:
            echoes = len(summary["transmitters"]) - len(bars)
            note = f"and {echoes} reflection{'s' * (echoes != 1)}" if echoes else ""
            figures.append(("transmitters", str(len(bars)), note))
        if summary["messages_off"] is None:
            figures.append(("messages", f"{summary['counts'].get('messages', 0):,}", ""))
        if "positions" in summary:
            refused = sum(summary["positions"]["refused"].values())
            note = f"{refused} refused" if refused else ""
            figures.append(("positions", f"{summary['positions']['fixes']:,}", note))
        figures += [
            ("recording", f"{recording['duration_s']:.3g} s", f"{recording['counts']['events']:,} events")
        ]
        return figures

    def _plot_places(self, shown: Mapping[int, tuple[str, Sequence[Frame]]], axis: TimeAxis) -> Plot:
        camera = self.run.link.camera
        image = Plot(
            "image",
            "column, px",
            "row, px",
            aspect=camera.width / camera.height,
            x_limits=(0, camera.width),
            # Rows grow downwards.
            y_limits=(camera.height, 0),
        )
        for number, (name, frames) in shown.items():
            places = np.array([(frame.x_px, frame.y_px) for frame in frames])
            labels = label_frames(name, frames, axis)
            image.add_dots(places[:, 0], places[:, 1], transmitter_colour(number), name, labels)
            if np.isfinite(places[-1]).all():
                image.add_name(float(places[-1, 0]), float(places[-1, 1]), str(number))
        return image


def _distance_figures(transmitters: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Range of distances of the transmitters, and their number; empty if no frame has one."""
    distances = [t[key] for t in transmitters for key in ("distance_first_m", "distance_last_m")]
    distances = [d for d in distances if d is not None]
    if not distances:
        return []
    text = f"{distances[0]:.2f} to {distances[-1]:.2f} m"
    if len(transmitters) > 1:
        text = f"{min(distances):.1f} to {max(distances):.1f} m"
    return [("distance", text, f"{sum(t['frames_ranged'] for t in transmitters):,} frames have one")]
