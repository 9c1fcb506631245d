"""Where a camera was while new bars were in view, by its own track: the poses that a survey goes by."""

import math
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from evlcp_sdk.place.navigator import Navigator, Placed, Settled
from evlcp_sdk.place.poses import KnownPose
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.spelling import counted
from evlcp_sdk.values import Packet

_MOST = 12
"""Poses by which a bar is surveyed: of more, errors of the track are the same ones again."""

_PAUSE_US = 200_000.0
"""Time without a bar's frames that ends its being in view."""


class OwnPoses:
    """Collects the poses of a recording's track at times when bars are in view that stand at no known site.

    Args:
        navigator: Computes the track; it knows the sites and the attitude.
        attitude_at: What is known of the camera's attitude at a time, us, for fixes that have none.
        recording: What the poses call the recording.
    """

    def __init__(
        self, navigator: Navigator, attitude_at: Callable[[float], Attitude | None], recording: str
    ) -> None:
        self._navigator = navigator
        self._attitude_at = attitude_at
        self._recording = recording
        self._spans: dict[int, list[tuple[float, float]]] = {}
        self._found: dict[float, KnownPose] = {}
        self._given, self._refused = 0, Counter[str]()

    def take(self, packet: Packet) -> None:
        """Take the receiver's next packet."""
        times = [f.points_t_us for f in packet.frames if math.isfinite(f.points_t_us)]
        if times and packet.echo_of is None:
            spans = self._spans.setdefault(packet.transmitter, [])
            start = min(times)
            if spans and start <= spans[-1][1] + _PAUSE_US:
                start = spans.pop()[0]
            spans.append((start, max(times)))
        self._navigator.seen(packet.t_us, packet.t_us)
        self._settle(self._navigator.feed([packet]))

    def close(self) -> list[KnownPose]:
        """End the recording; return the poses, in order of time, not more than 12 for each new bar."""
        placed, settled = self._navigator.close()
        self._settle(placed)
        for one in settled:
            self._keep(one)
        chosen: set[float] = set()
        for number in self._new():
            times = [t for t in self._found if self._in_view(number, t)]
            if times:
                rows = np.linspace(0, len(times) - 1, min(len(times), _MOST))
                chosen |= {times[row] for row in rows.round().astype(int).tolist()}
        return [self._found[t] for t in sorted(chosen)]

    @property
    def summary(self) -> str:
        """How many positions and new bars there were, in one line."""
        refused = "".join(f", {count} refused ({why})" for why, count in self._refused.most_common())
        ids = self._navigator.positioner.bars.ids
        new = ", ".join(str(ids.get(number, "without an id")) for number in self._new()) or "none"
        return f"{counted(self._given, 'position')}{refused}; new bars: {new}"

    def _settle(self, placed: Iterable[Placed]) -> None:
        for one in placed:
            self._given += not one.fix.refusal
            self._refused.update([one.fix.refusal] if one.fix.refusal else [])
            for settled in one.settled:
                self._keep(settled)

    def _keep(self, settled: Settled) -> None:
        fix, place = settled.fix, settled.smoothed
        if not any(self._in_view(number, fix.t_us) for number in self._new()):
            return
        attitude, sigma_deg = Attitude(fix.pitch_deg, fix.roll_deg, fix.heading_deg), fix.attitude_sigma_deg
        if not math.isfinite(fix.heading_deg):
            known = self._attitude_at(fix.t_us)
            if known is None or known.heading_deg is None:
                return
            worst = max(known.gravity_sigma_deg, known.heading_sigma_deg)
            attitude, sigma_deg = known, math.hypot(worst, known.white_sigma_deg)
        self._found[fix.t_us] = KnownPose(
            self._recording,
            fix.t_us,
            place.latitude_deg,
            place.longitude_deg,
            place.height_m,
            math.sqrt(float(np.linalg.eigvalsh(place.covariance_m2)[-1])),
            attitude,
            max(sigma_deg, 1e-6),
        )

    def _new(self) -> list[int]:
        """Transmitters that stand at no known site."""
        known = self._navigator.positioner.bars.stands_at
        return [number for number in self._spans if number not in known]

    def _in_view(self, number: int, t_us: float) -> bool:
        return any(start <= t_us <= end for start, end in self._spans[number])
