"""LED records of the emulators: what each LED did, chip by chip, and when.

A record is 20 bytes, little-endian: u32 tick, u32 chip, 12 bytes of 96 LEDs (LED 0 the most significant bit
of the first byte). Chip numbers count from START; two of them mean no chip: dark, and the single-LED test.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError
from firmware_host.messages import CHIP_DARK, CHIP_TEST, ROW_BYTES
from firmware_host.payload import chips_of_rows

__all__ = ["RECORD", "Recording"]

RECORD = np.dtype([("tick", "<u4"), ("chip", "<u4"), ("row", "u1", (ROW_BYTES,))])
"""One record."""


@dataclass(frozen=True, eq=False)
class Recording:
    """LED outputs in the order they happened.

    Attributes:
        ticks: Tick of each output, unwrapped, int64 (n,).
        numbers: Chip number of each, uint32 (n,).
        rows: LEDs, uint8 (n, 12).
    """

    ticks: NDArray[np.int64]
    numbers: NDArray[np.uint32]
    rows: NDArray[np.uint8]

    @classmethod
    def of_records(cls, records: NDArray[np.void]) -> "Recording":
        """From an array of `RECORD`; the tick counter wraps at 2**32 and is unwrapped here."""
        tick = records["tick"].astype(np.uint32)
        steps = np.diff(tick)  # modulo 2**32
        start = tick[:1].astype(np.int64)
        ticks = np.concatenate([start, start + np.cumsum(steps, dtype=np.int64)]) if len(tick) else start
        return cls(ticks, records["chip"].astype(np.uint32), np.ascontiguousarray(records["row"]))

    @classmethod
    def read(cls, path: Path) -> "Recording":
        """Read a file that an emulator wrote.

        Raises:
            InputError: It cannot be read, or its length is no multiple of a record.
        """
        try:
            data = path.read_bytes()
        except OSError as fault:
            raise InputError(f"{path}: cannot be read: {fault.strerror}") from fault
        if len(data) % RECORD.itemsize:
            raise InputError(
                f"{path}: {len(data)} bytes, expected whole records of {RECORD.itemsize}; was it cut off?"
            )
        return cls.of_records(np.frombuffer(data, RECORD))

    def played(self) -> "Recording":
        """Without the records that are no chip: dark, and the single-LED test."""
        keep = (self.numbers != CHIP_DARK) & (self.numbers != CHIP_TEST)
        return Recording(self.ticks[keep], self.numbers[keep], self.rows[keep])

    def chips(self, clusters: int = 16) -> NDArray[np.uint8]:
        """The chip table, uint8 (n, clusters); 96 clusters give every LED.

        Raises:
            ConfigError: LEDs of one cluster differ.
        """
        return chips_of_rows(self.rows, clusters)

    def __len__(self) -> int:
        return len(self.ticks)
