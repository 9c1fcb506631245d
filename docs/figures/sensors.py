"""What other sensors read: the table of docs/sensors.md.

    python docs/figures/sensors.py [--seeds 3]

Each link of a sensor in examples/links receives a simulated drive at 30 km/h by day, for a packet and a
half, from where a cluster of the bar covers 4 px on. Pixels are those of the sensor model, as slow as the
data sheet's latency beside that of the IMX636; a sensor that reads images has the times of the slowest.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

from evlcp_sdk.link.resolve import Link, load_link
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.simulated import simulate
from evlcp_sdk.study.frames import frames_of
from evlcp_sdk.study.measure import statistics_of
from evlcp_sdk.study.tally import Tally
from evlcp_sdk.values import Events

LINKS = Path(__file__).parents[2] / "examples" / "links"
CLUSTER_PX = 4.0
"""What a cluster covers along the bar where a drive begins."""


@dataclass(frozen=True)
class Sensor:
    """What its data sheet says beside the geometry.

    Attributes:
        latency: Of a pixel, beside that of the IMX636.
        cap_mev_s: Events a second that it can read, in millions.
        image_us: From one image to the next, us; 1 of a sensor that reads events.
    """

    latency: float = 1.0
    cap_mev_s: float = 1000.0
    image_us: int = 1


SENSORS = {
    "imx646": Sensor(),
    "genx320": Sensor(latency=1.5),
    "dvxplorer": Sensor(cap_mev_s=165.0, image_us=200),
    "gen31": Sensor(latency=2.0, cap_mev_s=66.0),
    "davis346": Sensor(cap_mev_s=12.0),
}


def distance_m(link: Link) -> float:
    """Where a cluster covers `CLUSTER_PX`."""
    return link.bar.column_pitch_m * link.camera.focal_px / CLUSTER_PX


def drive(name: str, seed: int) -> Tally:
    """What is read of a drive towards a bar by a sensor's link."""
    link, sensor = load_link(LINKS / f"{name}.toml"), SENSORS[name]
    camera, air = link.table["camera"], link.table["air"]
    scene = {
        "duration_s": 1.5 * link.packet.packet_chips * link.packet.chip_us * 1e-6,
        "camera": camera,
        "link": {"air": air},
        "motion": {"distance_m": distance_m(link), "speed_mps": 8.333},
        "background": {"light_w_m2": 0.3},
        "bars": [{"x_m": -0.4}],
        "sensor": {"charge_us_w_m2": 14.6 * sensor.latency, "cap_mev_s": sensor.cap_mev_s},
    }
    with simulate(scene, seed) as source:
        seen, _ = source.read()
    seen = Events.of(seen.t_us // sensor.image_us * sensor.image_us, seen.x, seen.y, seen.p)
    receiver = Receiver(link)
    packets = receiver.feed(seen) + receiver.close()
    return statistics_of(frames_of(packets), source.truth).total()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    print("| link | distance | frames | wrong bits | RMSE |\n|---|---|---|---|---|")
    for name in SENSORS:
        total = sum((drive(name, seed) for seed in seeds), Tally())
        far = distance_m(load_link(LINKS / f"{name}.toml"))
        print(
            f"| `{name}` | {far:.0f} m | {total.frames_found} of {total.frames_sent}"
            f" | {total.bit_errors} of {total.bits} | {total.rmse_m:.2f} m |"
        )


if __name__ == "__main__":
    main()
