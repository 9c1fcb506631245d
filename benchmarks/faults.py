"""What positions make of one fault, on rendered drives: simulated events, received, positioned.

    python benchmarks/faults.py [--seeds 2] [--duration 0.4]

The drives are those of examples/campaigns/position.toml with two and three bars, at 35 to 80 m, vibration and
all. Each is simulated and received once: all faults are made on the way from packets to positions, one at a
time, and nobody is told of them. A row has all drives of one setting:

- refused: as a misfit, as not determined, or as contradicted by the beacons; others are in no column
- silent: given, with an error beyond the 99.73 % bound of the fix's own covariance
- not covered: the same, and no protection level covers it
- excluded: given without a part that is named
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.place.positioner import Positioner
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.scene.attitude import Attitude
from evlcp_sdk.scene.sites import BarSite, LocalAxes
from evlcp_sdk.sim import Scene, Simulation, Truth, truth_of
from evlcp_sdk.sim.world import attitude_log
from evlcp_sdk.study.campaign.task import plan_of
from evlcp_sdk.study.measure import sites_seen
from evlcp_sdk.values import Packet

CAMPAIGN = Path(__file__).parents[1] / "examples" / "campaigns" / "position.toml"
BOUND = 14.156
"""99.73 % of chi squared with 3 degrees of freedom."""

AttitudeAt = Callable[[float], Attitude | None]


@dataclass(frozen=True)
class Told:
    """What a positioner is told, which a fault changes."""

    sites: list[BarSite]
    attitude_at: AttitudeAt
    link: Link


Fault = Callable[[Told], Told]


def nothing(told: Told) -> Told:
    """All is as said."""
    return told


def moved(numbers: tuple[int, ...], *way_m: float) -> Fault:
    """Sites are surveyed so far to the east, north and up of where they are."""

    def fault(told: Told) -> Told:
        axes, sites = LocalAxes.of(told.sites), list(told.sites)
        for i in numbers[: len(sites)]:
            site = sites[i]
            enu = axes.to_enu(site.latitude_deg, site.longitude_deg, site.height_m) + np.array(way_m)
            latitude, longitude, height = (float(v) for v in axes.to_geodetic(enu))
            sites[i] = replace(site, latitude_deg=latitude, longitude_deg=longitude, height_m=height)
        return replace(told, sites=sites)

    return fault


def unheard(fault: Fault) -> Fault:
    """The same where beacons, which would tell, are not believed."""

    def silent(told: Told) -> Told:
        wrong = fault(told)
        position = replace(wrong.link.position, beacons="none")
        return replace(wrong, link=replace(wrong.link, position=position))

    return silent


def swapped(told: Told) -> Told:
    """The first two sites stand at each other's place."""
    one, two, *rest = told.sites
    swap = {"transmitter_id": one.transmitter_id, "transmitter": one.transmitter}
    back = {"transmitter_id": two.transmitter_id, "transmitter": two.transmitter}
    return replace(told, sites=[replace(two, **swap), replace(one, **back), *rest])  # type: ignore[arg-type]


def refocused(told: Told) -> Told:
    """The focal length is half a percent off."""
    camera = replace(told.link.camera, focal_mm=told.link.camera.focal_mm * 1.005)
    return replace(told, link=replace(told.link, camera=camera))


def turned(pitch_deg: float, roll_deg: float, heading_deg: float) -> Fault:
    """Angles are off."""

    def fault(told: Told) -> Told:
        def at(t_us: float) -> Attitude | None:
            said = told.attitude_at(t_us)
            if said is None:
                return None
            return replace(
                said,
                pitch_deg=said.pitch_deg + pitch_deg,
                roll_deg=said.roll_deg + roll_deg,
                heading_deg=None if said.heading_deg is None else (said.heading_deg + heading_deg) % 360,
            )

        return replace(told, attitude_at=at)

    return fault


def late(told: Told) -> Told:
    """The attitude is 10 ms old."""
    return replace(told, attitude_at=lambda t_us: told.attitude_at(t_us - 10_000))


FAULTS: dict[str, Fault] = {
    "nothing": nothing,
    "a site .5 m to the east": moved((0,), 0.5, 0.0, 0.0),
    "the same, beacons not believed": unheard(moved((0,), 0.5, 0.0, 0.0)),
    "a site .5 m to the north, the same": unheard(moved((0,), 0.0, 0.5, 0.0)),
    "a site .5 m up, the same": unheard(moved((0,), 0.0, 0.0, 0.5)),
    "all sites .9 m from their beacons": moved((0, 1, 2), 0.9, 0.0, 0.0),
    "two sites swapped": swapped,
    "the same, no beacons believed": unheard(swapped),
    "focal length .5 % off": refocused,
    "pitch 1 degree off": turned(1.0, 0.0, 0.0),
    "roll 1 degree off": turned(0.0, 1.0, 0.0),
    "heading 1 degree off": turned(0.0, 0.0, 1.0),
    "attitude 10 ms late": late,
}
KNOWN = {"gravity, heading": 3, "gravity": 2, "nothing": 0}


@dataclass
class Count:
    """What is counted of the fixes of one row."""

    refused: int = 0
    silent: int = 0
    uncovered: int = 0
    excluded: int = 0
    protected: int = 0
    errors: list[float] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)


def count(into: Count, packets: list[Packet], truth: Truth, told: Told) -> None:
    """Position by what is told, and hold the fixes against the truth."""
    link = told.link
    positioner = Positioner(
        link.camera,
        link.bar,
        link.packet.packet_chips * link.packet.chip_us,
        told.sites,
        told.attitude_at,
        link.position,
    )
    # What is wrong with the first site moves the origin, not the camera.
    axes, path = positioner.axes, truth.camera_path
    assert axes is not None
    for fix in [*positioner.feed(packets), *positioner.close()]:
        if fix.refusal:
            into.refused += fix.refusal in ("misfit", "not-determined", "site-contradicted")
            continue
        place = [
            np.interp(fix.t_us - truth.t0_us, truth.t_us, path[key])
            for key in ("latitude_deg", "longitude_deg", "height_m")
        ]
        error = fix.enu_m - axes.to_enu(*place)
        into.errors.append(float(np.linalg.norm(error)))
        into.squares.append(float(error @ np.linalg.solve(fix.covariance_m2, error)))
        inside = math.hypot(error[0], error[1]) <= fix.hpl_m and abs(error[2]) <= fix.vpl_m
        protected = math.isfinite(fix.hpl_m) and math.isfinite(fix.vpl_m)
        into.excluded += bool(fix.excluded)
        into.protected += protected
        into.silent += into.squares[-1] > BOUND
        into.uncovered += into.squares[-1] > BOUND and not (protected and inside)


def drive(scene: Scene, seed: int) -> tuple[list[Packet], Truth, Told]:
    """A drive's packets, their truth, and what a positioner is told where nothing is wrong."""
    link = load_link()
    simulation = Simulation(scene, seed)
    truth = truth_of(simulation)
    log = attitude_log(scene, seed, simulation.path)
    assert log is not None
    receiver = Receiver(link, attitude=log)
    packets = [packet for events in simulation.stream() for packet in receiver.feed(events)]
    packets += receiver.close()
    return packets, truth, Told(sites_seen(packets, truth), log.at, link)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--duration", type=float, default=0.4)
    args = parser.parse_args()
    counts: dict[tuple[int, str, str], Count] = {}
    for case in plan_of(CAMPAIGN).scenes:
        if len(case.value.bars) < 2:
            continue
        world = replace(case.value.world, attitude="heading")
        scene = replace(case.value, world=world, duration_s=args.duration)
        for seed in range(1, args.seeds + 1):
            packets, truth, told = drive(scene, seed)
            for known, angles in KNOWN.items():
                if len(scene.bars) == 2 and not angles:
                    continue
                for what, fault in FAULTS.items():
                    if (angles < 3 and "heading" in what) or (
                        not angles and ("degree" in what or "attitude" in what)
                    ):
                        continue
                    wrong = fault(told)
                    if angles < 3:
                        wrong = replace(wrong, attitude_at=without(wrong.attitude_at, angles))
                    into = counts.setdefault((len(scene.bars), known, what), Count())
                    count(into, packets, truth, wrong)
    head = ("bars", "known", "what is wrong", "given", "refused", "excluded", "median, m", "NEES", "silent")
    print("| " + " | ".join((*head, "not covered", "protected")) + " |")
    print("|---" * (len(head) + 2) + "|")
    for (bars, known, what), found in sorted(counts.items(), key=lambda item: item[0][:2]):
        given = len(found.errors)
        middle = f"{np.median(found.errors):.3f} | {np.mean(found.squares):.2g}" if given else "- | -"
        cells = (f"{bars} | {known} | {what} | {given} | {found.refused} | {found.excluded} | {middle}"
                 f" | {found.silent} | {found.uncovered} | {found.protected}")  # fmt: skip
        print(f"| {cells} |")


def without(attitude_at: AttitudeAt, angles: int) -> AttitudeAt:
    """An attitude of fewer angles."""

    def at(t_us: float) -> Attitude | None:
        said = attitude_at(t_us) if angles else None
        return None if said is None else replace(said, heading_deg=None)

    return at


if __name__ == "__main__":
    main()
