"""The result of one run: packets in; tallies, positions and files out."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from evlcp_sdk.diagnosis.facts import Facts
from evlcp_sdk.diagnosis.probe import find_other_codewords
from evlcp_sdk.diagnosis.readout import ReadoutTally
from evlcp_sdk.diagnosis.tallies import PositionTally, RunTally
from evlcp_sdk.files import writing
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.several import name_links, select_positioning_links
from evlcp_sdk.plugin.records import SUMMARY, choose_sinks, find_sinks
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.results.folder import ResultFolder
from evlcp_sdk.results.lines import JsonLines
from evlcp_sdk.results.sink import Run
from evlcp_sdk.results.sinks import Sinks, load_sinks
from evlcp_sdk.results.summary import RunEnd, build_summary, messages_off_reason
from evlcp_sdk.scene.attitude import Attitude, AttitudeLog
from evlcp_sdk.utc import ClockZero, PulseClock
from evlcp_sdk.values import Events, Packet

if TYPE_CHECKING:
    from evlcp_sdk.place.navigator import Navigator, Placed, PositionPlan


class ResultWriter:
    """Writes one recording's result into a folder; use as a context manager, end with `finish`.

    Create the receiver in the context, where the registry calls sinks that have hooks.

    Args:
        folder: Created if need be; `finish` replaces an earlier result in it. None to write nothing.
        link: The receiver's configuration, or several.
        registry: Where sinks are found; None for all that are installed.
        name: Name of the recording, for titles.
        plan: What positions are computed from; None for no positions.
        attitude: The camera's known attitude, for positions; None where it is not known.
        clock_zero: UTC of the camera clock's 0, or pulses that give it; None if it is not known.
        sinks: Output formats beside the default ones, by name; none without a folder.
        lines: Takes frames, messages and fixes as lines of JSON as they come.
        on_fix: Takes fixes, with their filtered places, as they come.

    Raises:
        OutputError: The folder cannot be written.
        ConfigError: A sink cannot be used.
        PluginError: A sink fails.
    """

    def __init__(
        self,
        folder: Path | None,
        link: Link | Sequence[Link],
        registry: Registry | None = None,
        *,
        name: str = "",
        plan: PositionPlan | None = None,
        attitude: Attitude | AttitudeLog | None = None,
        clock_zero: ClockZero = None,
        sinks: Sequence[str] = (),
        lines: Callable[[str], None] | None = None,
        on_fix: Callable[[Placed], None] | None = None,
    ) -> None:
        self._on_fix = on_fix
        self._registry = Registry.load() if registry is None else registry
        self._links = name_links(link)
        first = next(iter(self._links.values()))
        placing = select_positioning_links(self._links) if plan is not None else {}
        self._navigator: Navigator | None = None
        if plan is not None:
            # Imported here: it takes a tenth of a start.
            from evlcp_sdk.place.navigator import Navigator

            plan.check_links(list(self._links))
            self._navigator = Navigator(placing, plan, attitude)
        self._placing = next(iter(placing), "")
        self._tally = RunTally({name: one.packet for name, one in self._links.items()})
        self._positions = PositionTally()
        self._readout = ReadoutTally()
        several = self._links if len(self._links) > 1 else {}
        self._pulses = clock_zero if isinstance(clock_zero, PulseClock) else None
        run = Run(name, first, plan, self._navigator, clock_zero, several)
        self._lines = None if lines is None else JsonLines(lines, run)
        self._folder: ResultFolder | None = None
        self._sinks = Sinks()
        with ExitStack() as stack:
            if folder is not None:
                classes = load_sinks(choose_sinks(self._registry, sinks, positions=plan is not None))
                files = [file for s in find_sinks(self._registry).values() for file in s.record.files]
                self._folder = stack.enter_context(ResultFolder(folder, files))
                self._sinks.open(classes, self._folder, run)
                stack.enter_context(self._registry.add_temporarily(*self._sinks.all))
            self._stack = stack.pop_all()

    def events(self, events: Events) -> None:
        """Take the receiver's next events."""
        self._readout.add(events)
        if self._navigator is not None and len(events):
            self._navigator.extend_span(int(events.t_us[0]), int(events.t_us[-1]))
        self._sinks.call("events", events)

    def write(self, packets: Iterable[Packet]) -> None:
        """Take the receiver's next packets.

        Raises:
            OutputError: A file cannot be written, e.g. the disk is full.
            PluginError: A sink fails.
        """
        for packet in packets:
            self._tally.add(packet)
            self._sinks.call("packet", packet)
            if self._lines is not None:
                self._lines.packet(packet)
            if self._navigator is not None:
                self._write_fixes(self._navigator.feed([packet]))

    def finish(self, end: RunEnd) -> dict[str, Any]:
        """Finish the sinks, move all files into place, the summary last, and remove an earlier result.

        Returns:
            The content of `summary.json`.

        Raises:
            OutputError: A file cannot be written, e.g. the disk is full.
            PluginError: A sink fails.
        """
        positions: dict[str, Any] = {}
        if self._navigator is not None:
            fixes, settled = self._navigator.close()
            self._write_fixes(fixes)
            self._sinks.call("settle", settled)
            positions = self._positions.to_dict(self._navigator)
        facts = self._collect_facts(end, positions)
        table = build_summary(
            end,
            facts,
            self._registry.versions(),
            self._sinks.finish(),
            None if self._pulses is None else self._pulses.to_dict(),
        )
        table["files"] = {}
        if self._folder is not None:
            self._sinks.conclude(table)
            table["files"] = self._folder.digests()
            with writing(self._folder.folder):
                self._folder.open(SUMMARY).write(json.dumps(table, indent=2) + "\n")
            self._folder.finish()
        return table

    def _collect_facts(self, end: RunEnd, positions: Mapping[str, Any]) -> Facts:
        recording = end.recording
        first_us, last_us = recording.get("first_us"), recording.get("last_us")
        read = recording.get("counts", {})
        facts = Facts(
            next(iter(self._links.values())),
            self._tally,
            end.counts,
            math.nan if first_us is None else first_us,
            math.nan if last_us is None else last_us,
            end.lit_us,
            self._readout,
            tuple(end.losses.values()),
            guessed=str(recording.get("guessed", "")),
            step_us=recording.get("step_us", 0),
            skipped_silences=(read.get("silences_skipped", 0), read.get("silences_skipped_us", 0)),
            late_events=(end.live or {}).get("shed", {}).get("too_late", 0),
            positions=positions,
        )
        parts = {
            name: replace(
                facts,
                link=link,
                tally=self._tally.of_link(name),
                counts=end.link_counts.get(name, end.counts),
                reads_messages=messages_off_reason(link) is None,
                other_codewords=partial(find_other_codewords, link, self._registry),
                positions=positions if name == self._placing else {},
            )
            for name, link in self._links.items()
        }
        if len(parts) == 1:
            return next(iter(parts.values()))
        return replace(facts, reads_messages=any(p.reads_messages for p in parts.values()), parts=parts)

    def _write_fixes(self, fixes: Iterable[Placed]) -> None:
        for placed in fixes:
            self._positions.add(placed)
            self._sinks.call("fix", placed.fix, placed.filtered)
            if placed.settled:
                self._sinks.call("settle", placed.settled)
            if self._lines is not None:
                self._lines.fix(placed.fix)
            if self._on_fix is not None:
                self._on_fix(placed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        """Drop what `finish` has not moved into place."""
        self._stack.close()
