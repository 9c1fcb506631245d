"""LED records of the emulators: the LEDs' states and times, chip by chip.

A record is 20 bytes, little-endian: u32 tick, u32 chip, 12 bytes of 96 LEDs (LED 0 the most significant bit
of the first byte). Chip numbers count from START; two special ones mark dark and the single-LED test.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import ConfigError, InputError
from evlcp_sdk.files import read_bytes
from firmware_host.protocol.generated.requests import CHIP_DARK, CHIP_TEST, ROW_BYTES
from firmware_host.protocol.rows import BOARD_LEDS

RECORD = np.dtype([("tick", "<u4"), ("chip", "<u4"), ("row", "u1", (ROW_BYTES,))])
"""One record."""


@dataclass(frozen=True, eq=False)
class LedRecord:
    """LED outputs in the order they happened.

    Attributes:
        ticks: Tick of each output, unwrapped, int64 (n,).
        numbers: Chip number of each, uint32 (n,).
        rows: LEDs, uint8 (n, 12).
        cut_bytes: Bytes of a last, incomplete record, which is left out.
    """

    ticks: NDArray[np.int64]
    numbers: NDArray[np.uint32]
    rows: NDArray[np.uint8]
    cut_bytes: int = 0

    @classmethod
    def of_records(cls, records: NDArray[np.void]) -> "LedRecord":
        """Convert an array of `RECORD`, whose tick counter wraps at 2**32."""
        tick = records["tick"].astype(np.uint32)
        steps = np.diff(tick, prepend=tick[:1])  # modulo 2**32
        ticks = tick[:1].astype(np.int64) + np.cumsum(steps, dtype=np.int64)
        return cls(ticks, records["chip"].astype(np.uint32), np.ascontiguousarray(records["row"]))

    @classmethod
    def read(cls, path: Path) -> "LedRecord":
        """Read a file that an emulator wrote.

        Raises:
            InputError: It cannot be read, has no whole record, or its chips are not consecutive.
        """
        data = read_bytes(path)
        whole, cut = divmod(len(data), RECORD.itemsize)
        if not whole:
            raise InputError(
                f"{path}: {len(data)} bytes, expected LED records of {RECORD.itemsize} bytes;"
                " the emulator writes them when the LEDs are lit"
            )
        records = np.frombuffer(data, RECORD, whole)
        chip = records["chip"].astype(np.int64)
        places = np.flatnonzero(chip < CHIP_TEST)
        chip = chip[places]
        # chips are consecutive from each START
        before = np.append(-1, chip[:-1])
        wrong = np.flatnonzero((chip != before + 1) & ((chip != 0) | (before == -1)))
        if len(wrong):
            at = wrong[0]
            after = f"after chip {before[at]}" if at else "at the start"
            raise InputError(
                f"{path}: at byte {places[at] * RECORD.itemsize}: chip {chip[at]} {after}:"
                " not an LED record, or a part of it is missing"
            )
        return replace(cls.of_records(records), cut_bytes=cut)

    def to_bytes(self) -> bytes:
        """The record as the content of a file for `read`."""
        records = np.empty(len(self), RECORD)
        records["tick"] = self.ticks.astype(np.uint64) & np.uint64(0xFFFFFFFF)
        records["chip"], records["row"] = self.numbers, self.rows
        return records.tobytes()

    def select_chips(self) -> "LedRecord":
        """The record without dark outputs and the single-LED test."""
        keep = (self.numbers != CHIP_DARK) & (self.numbers != CHIP_TEST)
        return LedRecord(self.ticks[keep], self.numbers[keep], self.rows[keep], self.cut_bytes)

    def chips(self, led_clusters: NDArray[np.int64] | None = BOARD_LEDS) -> NDArray[np.uint8]:
        """The chip table, uint8 (n, clusters).

        Args:
            led_clusters: The cluster of each LED; None for a column of every LED.

        Raises:
            ConfigError: LEDs of one cluster differ, or one without a cluster is lit.
        """
        leds = np.unpackbits(self.rows, axis=1)
        if led_clusters is None:
            return leds
        if len(led_clusters) > leds.shape[1]:
            raise ConfigError(f"rows of {leds.shape[1]} LEDs, the link's bar has {len(led_clusters)}")
        _, first = np.unique(led_clusters, return_index=True)
        chips = np.ascontiguousarray(leds[:, first])
        expected = np.zeros_like(leds)
        expected[:, : len(led_clusters)] = chips[:, led_clusters]
        wrong = np.argwhere(leds != expected)
        if len(wrong):
            chip, led = wrong[0]
            if led >= len(led_clusters):
                raise ConfigError(f"chip {chip}: LED {led} is lit, the link's bar has {len(led_clusters)}")
            raise ConfigError(
                f"chip {chip}: the LEDs of cluster {led_clusters[led]} differ; take every LED for itself"
                " with --per-led"
            )
        return chips

    def __len__(self) -> int:
        return len(self.ticks)
