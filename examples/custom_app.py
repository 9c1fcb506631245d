"""A speed display that stands on hooks alone: `python examples/custom_app.py speed REC.raw`.

The plugin adds a command of its own and watches the receiver; the SDK does not know that it is there.
"""

import math
import sys
from collections import defaultdict, deque
from typing import Annotated

import numpy as np
import typer

import evlcp_sdk as evlcp


class SpeedDisplay:
    """How fast each transmitter comes nearer: the slope of a line through its newest distances.

    Args:
        frames: Distances that the line goes through, at most.
    """

    def __init__(self, frames: int = 60) -> None:
        self._seen: dict[int, deque[tuple[float, float]]] = defaultdict(lambda: deque(maxlen=frames))

    @evlcp.hookimpl
    def evlcp_stage_finished(self, stage: str, value: object) -> None:
        """Print a line for every frame that has a distance."""
        if stage != "frame" or not isinstance(value, evlcp.Frame) or math.isnan(value.range.distance_m):
            return
        self._seen[value.transmitter].append((value.t_us * 1e-6, value.range.distance_m))
        place = f"{value.t_us / 1e3:9.1f} ms  bar {value.transmitter}  {value.range.distance_m:7.2f} m"
        speed_m_s, sigma_m_s = self.speed(value.transmitter)
        shown = f"{speed_m_s:6.2f} ± {sigma_m_s:5.2f} m/s  {3.6 * speed_m_s:6.1f} km/h"
        print(place, "too early for a speed" if math.isnan(speed_m_s) else shown, sep="  ", flush=True)

    @evlcp.hookimpl
    def evlcp_register_commands(self, app: typer.Typer) -> None:
        """Add `speed`."""

        @app.command()
        def speed(
            recording: Annotated[str, typer.Argument(metavar="REC", help="A recording or a camera.")],
        ) -> None:
            """Show how fast the camera comes nearer to each bar."""
            registry = evlcp.Registry.load(self)
            link = evlcp.load_link(None, ["ranging.id=joint-scale"], registry)
            for _ in evlcp.receive(recording, link, registry=registry):
                pass  # the hook above has seen its frames

    def speed(self, transmitter: int) -> tuple[float, float]:
        """Speed towards a transmitter and its standard deviation, m/s; NaN before three distances.

        Ordinary least squares; the scatter of the distances about the line gives the deviation, so errors
        that drift across all of them are not in it.
        """
        t_s, distance_m = np.array(self._seen[transmitter]).reshape(-1, 2).T
        if len(t_s) < 3:
            return math.nan, math.nan
        t_s = t_s - t_s.mean()
        power = float(t_s @ t_s)
        slope = float(t_s @ distance_m) / power
        off = distance_m - distance_m.mean() - slope * t_s
        return -slope, math.sqrt(float(off @ off) / (len(t_s) - 2) / power)


def main() -> None:
    """Make a command line of what plugins add."""
    app = typer.Typer(no_args_is_help=True, add_completion=False)
    try:
        evlcp.Registry.load(SpeedDisplay()).hook.evlcp_register_commands(app=app)
        app()
    except evlcp.EvlcpError as fault:
        print(fault, file=sys.stderr)
        sys.exit(fault.exit_code)


if __name__ == "__main__":
    main()
