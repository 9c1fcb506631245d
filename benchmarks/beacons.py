"""Bit error rates of the outdoor beacons of Wang et al. (arXiv 2208.01710), beside theirs.

    python benchmarks/beacons.py DIR [--text FILE]

DIR has the public recordings (504hz_30m.mat and the other three), which are not ours to bring along. Each is
received as `evlcp receive` does by the link of docs/uart.md. The beacon sends a text and DEL again and again;
without --text what is sent is learned from the first recording with two repetitions, bit by bit by majority.
A lost character counts half its bits as wrong.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import evlcp_sdk as evlcp
from evlcp_sdk.run import receive

THEIRS = {"3125hz_30m": 1.35e-2, "3125hz_100m": 9.4e-2, "504hz_30m": 0.0, "504hz_100m": 1.7e-3}
BITS, SENT, DEL = 7, 619, 0x7F
LINK = (
    *("bar.rows=1", "bar.columns=1", "bar.cluster_rows=1", "bar.cluster_columns=1", "detection.id=whole"),
    *("air.frames_per_packet=100", "framing.id=uart", f"framing.data_bits={BITS}", "framing.parity=even"),
    *("framing.stop_bits=2", "framing.first_bit=highest"),
)
Values = NDArray[np.int64]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--text", type=Path, metavar="FILE", help="What was sent, without the DEL.")
    args = parser.parse_args()
    text = None
    if args.text is not None:
        text = np.append(np.frombuffer(args.text.read_bytes().rstrip(b"\r\n\x7f"), np.uint8), DEL).astype(int)
    print("| recording | characters | lost | wrong bits | bit error rate | the authors' |")
    print("|---|---|---|---|---|---|")
    # Those with repetitions go first.
    for path in (args.folder / f"{name}.mat" for name in THEIRS):
        if not path.exists():
            continue
        numbers, values = read(path)
        if text is None:
            if np.ptp(numbers) < 2 * SENT:
                parser.error(f"{path}: less than two repetitions of the text, give --text")
            text = learn(numbers, values)
        wrong = count_wrong(numbers, values, text)
        sent = int(np.ptp(numbers)) + 1
        lost = sent - len(values)
        rate = (wrong + lost * BITS / 2) / (sent * BITS)
        print(
            f"| {path.stem} | {sent} | {lost} | {wrong} of {len(values) * BITS} | {rate:.2g} "
            f"| {THEIRS[path.stem]:g} |"
        )


def read(path: Path) -> tuple[Values, Values]:
    """Numbers of the characters that are received, lost ones counted, and the characters, int64 (n,)."""
    link = evlcp.load_link(overrides=[*LINK, f"air.chip_rate_hz={path.stem.partition('hz')[0]}"])
    with receive(path, [link]) as packets:
        frames = [frame for packet in packets for frame in packet.frames]
    if not frames:
        raise SystemExit(f"{path}: no characters")
    numbers = [frame.packet * link.packet.frames + frame.frame for frame in frames]
    return np.array(numbers), np.array([int(frame.soft.symbols[0]) for frame in frames])


def learn(numbers: Values, values: Values) -> Values:
    """The text that is repeated, DEL last, int64 (SENT,)."""
    bits = values[:, None] >> np.arange(BITS) & 1
    ones, many = np.zeros((2, SENT, BITS))
    np.add.at(ones, numbers % SENT, bits)
    np.add.at(many, numbers % SENT, 1)
    text = (2 * ones > many) @ (1 << np.arange(BITS))
    return np.roll(text, -1 - int(np.argmax(text == DEL)))


def count_wrong(numbers: Values, values: Values, text: Values) -> int:
    """Wrong bits, from the place in the text on where most characters are right."""
    right = [int((np.roll(text, -k)[numbers % len(text)] == values).sum()) for k in range(len(text))]
    sent = np.roll(text, -int(np.argmax(right)))[numbers % len(text)]
    return int(np.bitwise_count(sent ^ values).sum())


if __name__ == "__main__":
    main()
