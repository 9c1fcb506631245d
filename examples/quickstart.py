"""Send a text through the whole link and read it: `python examples/quickstart.py "Road works"`."""

import sys
from pathlib import Path

import numpy as np

import evlcp_sdk as evlcp
from firmware_host.loop import light_of


def main(text: str, folder: Path) -> None:
    """A text, an emulated board, its LEDs, a camera 60 m away, a recording, the text."""
    link = evlcp.load_link()
    symbols = evlcp.compose(link, text=text, transmitter_id=7)

    # The board's firmware plays them; what its 96 LEDs do becomes the light of a bar.
    packets = 2 * len(symbols) + 3
    light = light_of(symbols, link, chips=packets * link.packet.packet_chips)
    folder.mkdir(exist_ok=True)
    np.save(folder / "chips.npy", light.chips)

    bar = {"x_m": 0.0, "chips_file": str(folder / "chips.npy"), "start_chip": 100.0}
    duration_s = (packets - 1) * link.packet.packet_chips / light.rate_hz
    scene = {"duration_s": duration_s, "motion": {"distance_m": 60.0}, "bars": [bar]}
    evlcp.simulate(scene, seed=1).save(folder / "quickstart.raw")

    for packet in evlcp.receive(folder / "quickstart.raw", link):
        for frame in packet.frames:
            symbols_read = " ".join(f"{s:2}" if s >= 0 else " -" for s in frame.soft.symbols)
            print(f"{frame.t_us / 1e3:9.2f} ms  {symbols_read}  {frame.range.distance_m:.2f} m")
        for received in packet.messages:
            print(f"read: {received.value}")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else "Road works", Path("quickstart-out"))
    except evlcp.EvlcpError as fault:
        print(fault, file=sys.stderr)
        sys.exit(fault.exit_code)
