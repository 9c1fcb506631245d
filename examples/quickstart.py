"""Decode a recording and print every frame: `python examples/quickstart.py REC.raw`."""

import sys

from evlcp_sdk.io import open_source
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.rx.receiver import Receiver


def main(path: str) -> None:
    """Feed the recording to a receiver, piece by piece."""
    receiver = Receiver(load_link())
    packets = []
    with open_source(path) as source:
        for events in source.chunks():
            packets += receiver.feed(events)
    packets += receiver.close()
    for packet in packets:
        for frame in packet.frames:
            symbols = " ".join(f"{s:2}" for s in frame.soft.symbols)
            distance = frame.range
            print(f"{frame.t_us / 1e3:9.2f} ms  {symbols}  {distance.distance_m:.2f} m")


if __name__ == "__main__":
    main(sys.argv[1])
