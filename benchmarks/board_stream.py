"""Delay of a streamed packet from the call to its first chip, at USB latencies of 0, 1 and 16 ms.

The board is simulated in virtual time, the line has 1 Mbit/s, the bridge hands on what it receives after its
latency, and USB takes a millisecond to it. `alone`: each packet when the board has none; else so many packets
are kept on the board. Round trips are requests a packet, repeated ones included.
"""

from dataclasses import dataclass

import numpy as np

from evlcp_sdk.link.resolve import load_link
from firmware_host.board.bank import random_symbols
from firmware_host.board.board import Board
from firmware_host.board.session import Session
from firmware_host.emulators.simulated import SimulatedBoard, UsbLine
from firmware_host.protocol.client import Timing

PACKETS = 200
FRAME_S = 1e-3
LATENCIES_S = (0.0, 1e-3, 16e-3)
AHEAD = (2, 4, 8)


@dataclass(frozen=True)
class Measured:
    """Delays, ms, of some packets, and what they took."""

    delays_ms: np.ndarray
    round_trips: float
    underruns: int


def measure(latency_s: float, ahead: int, pause_s: float, packets: int = PACKETS) -> Measured:
    """Stream packets, each `pause_s` after the one before has gone out."""
    link, device = load_link(), SimulatedBoard()
    symbols = random_symbols(packets, link.packet.frames, link.codebook, np.random.default_rng(0))
    session = Session(UsbLine(device, latency_s, frame_s=FRAME_S), Timing(), first=1, nonce=1)
    calls = []
    with Board(session).stream(link, ahead) as stream:
        for packet in symbols:
            calls.append(device.now_us)
            stream.send(packet)
            if pause_s:
                stream.wait(pause_s)
    played = device.records().played()
    starts = starts_of(played.chips(), played.ticks, symbols.shape[0], link.packet.packet_chips)
    delays = (np.array(starts) / (device.TICK_HZ / 1e6) - np.array(calls)) / 1e3
    return Measured(delays, stream.requests / packets, stream.underruns)


def starts_of(chips: np.ndarray, ticks: np.ndarray, packets: int, packet_chips: int) -> list[int]:
    """Tick of each packet's first chip; between packets there may be the idle pattern."""
    preamble = load_link().codebook.preamble
    found, at = [], 0
    while len(found) < packets:
        while not (chips[at : at + len(preamble)] == preamble[:, None]).all():
            at += 1
        found.append(int(ticks[at]))
        at += packet_chips
    return found


def main() -> None:
    packet_ms = 1e3 * load_link().packet.packet_chips / load_link().packet.chip_rate_hz
    print(f"{PACKETS} packets of {packet_ms:.1f} ms; delay from the call to the first chip, ms")
    print("| USB latency | queue | median | largest | round trips a packet | underruns |")
    print("|---|---|---|---|---|---|")
    for latency_s in LATENCIES_S:
        rows = [("alone", measure(latency_s, 4, 0.1))]
        rows += [(f"{ahead} on the board", measure(latency_s, ahead, 0.0)) for ahead in AHEAD]
        for name, m in rows:
            underruns = "-" if name == "alone" else m.underruns
            print(
                f"| {latency_s * 1e3:g} ms | {name} | {np.median(m.delays_ms):.1f} | {m.delays_ms.max():.1f}"
                f" | {m.round_trips:.2f} | {underruns} |"
            )


if __name__ == "__main__":
    main()
