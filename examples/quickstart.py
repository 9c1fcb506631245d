"""Decode a recording and print every frame: `python examples/quickstart.py REC.raw`."""

import sys

import evlcp_sdk as evlcp


def main(path: str) -> None:
    """Print time, symbols and distance of each frame, as soon as its packet is complete."""
    for packet in evlcp.receive(path):
        for frame in packet.frames:
            symbols = " ".join(f"{s:2}" if s >= 0 else " -" for s in frame.soft.symbols)
            print(f"{frame.t_us / 1e3:9.2f} ms  {symbols}  {frame.range.distance_m:.2f} m")


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except evlcp.EvlcpError as fault:
        print(fault, file=sys.stderr)
        sys.exit(fault.exit_code)
