"""Many boards at once, from one inventory."""

import time
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from evlcp_sdk.errors import EvlcpError, InputError
from firmware_host.board.bank import Bank, random_symbols, read_masks, read_symbols
from firmware_host.board.board import Board, Programmed, Settings, provision
from firmware_host.board.session import Session
from firmware_host.emulators.opening import open_port
from firmware_host.errors import FleetError, IncompatibleError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generate import codebook_of
from firmware_host.protocol.requests import DEFAULT_BAUD, Watchdog

if TYPE_CHECKING:
    from evlcp_sdk.air.codebook import Codebook

__all__ = ["Entry", "Inventory", "Result", "program_fleet", "raise_failures", "read_inventory"]


_MOST_FRAMES = 1_000_000
"""Random frames of a board at most; far beyond any bank, and within memory."""


class Entry(BaseModel):
    """One board of an inventory.

    Attributes:
        id: Transmitter id, unique in the inventory.
        port: Port, as for `--port`, unique in the inventory.
        position_m: Coordinates x, y, z of the bar's centre, m.
        payload: Symbols `[packet][frame][cluster]` in a JSON file, or chip masks in a `.npy` file.
        random: Instead of `payload`: that many packets of random symbols.
        seed: Seed of `random`.
        unique_id: The part's own number in hex, as `evlcp board hello` shows it; another board is refused.
        profile: Info-segment profile.
        frames: Frames per packet of `random` and of chip masks.
        pilot_every: Frames from one pilot to the next.
        chip_rate_hz: Chips per second.
        level_ma: LED current, mA.
        watchdog: What the board does when the host is silent.
        watchdog_ms: After which silence, ms.
        start: Whether to play when done.
        baud: Line rate, bit/s.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    id: Annotated[str, Field(min_length=1)]
    port: Annotated[str, Field(min_length=1)]
    position_m: Annotated[list[FiniteFloat | int], Field(min_length=3, max_length=3)]
    payload: str | None = None
    random: Annotated[int, Field(ge=1, le=65535)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    unique_id: Annotated[str, Field(pattern="^[0-9a-f]{24}$")] | None = None
    profile: str = "wh4x2"
    frames: Annotated[int, Field(ge=1, le=65535)] = 10
    pilot_every: Annotated[int, Field(ge=1, le=64)] = 1
    chip_rate_hz: Annotated[int, Field(ge=1, le=1_000_000)] = 10_000
    level_ma: Annotated[int, Field(ge=0, le=65535)] | None = None
    watchdog: Literal["keep", "idle", "dark"] | None = None
    watchdog_ms: Annotated[int, Field(ge=100, le=2**32 - 1)] = 5_000
    start: bool = True
    baud: Annotated[int, Field(ge=1200)] = DEFAULT_BAUD

    @model_validator(mode="after")
    def _one_payload(self) -> "Entry":
        if (self.payload is None) == (self.random is None):
            raise ValueError("give payload or random, one of the two")
        if self.random is not None and self.random * self.frames > _MOST_FRAMES:
            raise ValueError(f"random x frames = {self.random * self.frames}, at most {_MOST_FRAMES}")
        return self

    @property
    def settings(self) -> Settings:
        """What the board is set to."""
        watchdog = None if self.watchdog is None else Watchdog[self.watchdog.upper()]
        return Settings(self.chip_rate_hz, self.level_ma, watchdog, self.watchdog_ms, self.start)


@dataclass(frozen=True)
class Inventory:
    """The boards of a file, each with its payload.

    Attributes:
        path: The file.
        boards: Entry and payload of each board.
    """

    path: Path
    boards: tuple[tuple[Entry, Bank], ...]


@dataclass(frozen=True)
class Result:
    """How one board ended.

    Attributes:
        entry: The board.
        done: What was done, or None if it failed.
        fault: Why it failed.
        elapsed_s: How long it took, s.
    """

    entry: Entry
    done: Programmed | None
    fault: EvlcpError | None
    elapsed_s: float

    @property
    def line(self) -> str:
        """One line for a person."""
        head = f"{self.entry.id}  {self.entry.port}"
        if self.done is None:
            code = self.fault.exit_code if self.fault else 1
            return f"{head}  FAILED ({code}): {self.fault}"
        if not self.done.swapped:
            return f"{head}  was there already ({self.done.length} bytes)"
        return f"{head}  programmed {self.done.written} of {self.done.length} bytes in {self.elapsed_s:.2f} s"

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "id": self.entry.id,
            "port": self.entry.port,
            "position_m": list(self.entry.position_m),
            "ok": self.done is not None,
            "written_bytes": self.done.written if self.done else 0,
            "swapped": self.done.swapped if self.done else False,
            "exit_code": self.fault.exit_code if self.fault else 0,
            "fault": str(self.fault) if self.fault else None,
            "elapsed_s": round(self.elapsed_s, 3),
        }


def read_inventory(path: Path) -> Inventory:
    """Read an inventory: `[[board]]` tables, and `[defaults]` with any key of a board.

    Raises:
        InputError: The file or a payload it names cannot be read, or a value is wrong; the message names the
            place, the value and what was expected.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(f"{path}: cannot be read: {fault}") from fault
    except (tomllib.TOMLDecodeError, RecursionError) as fault:
        raise InputError(f"{path}: not TOML: {fault}") from fault
    unknown = sorted(set(table) - {"defaults", "board"})
    if unknown:
        raise InputError(f"{path}: {unknown[0]}: unknown table, expected [defaults] and [[board]]")
    defaults, rows = table.get("defaults", {}), table.get("board", [])
    if not isinstance(defaults, dict):
        raise InputError(f"{path}: defaults = {defaults!r}, expected a table [defaults]")
    if not isinstance(rows, list) or not rows or not all(isinstance(r, dict) for r in rows):
        raise InputError(f"{path}: board: expected at least one [[board]] table")
    books: dict[str, Codebook] = {}
    entries = [_entry(path, i, defaults | row) for i, row in enumerate(rows)]
    for key in ("id", "port"):
        first: dict[str, int] = {}
        for i, entry in enumerate(entries):
            value = getattr(entry, key)
            if value in first and not value.startswith(("native:", "qemu:")):
                raise InputError(
                    f"{path}: board[{i}].{key} = {value!r}, expected another than board[{first[value]}]'s"
                )
            first[value] = i
    return Inventory(path, tuple((e, _payload(path, i, e, books)) for i, e in enumerate(entries)))


def _entry(path: Path, index: int, row: dict[str, Any]) -> Entry:
    try:
        return Entry.model_validate(row)
    except ValidationError as fault:
        first = fault.errors()[0]
        place = ".".join([f"board[{index}]", *(str(part) for part in first["loc"])])
        value = "" if first["type"] in ("missing", "value_error") else f" = {first['input']!r}"
        raise InputError(f"{path}: {place}{value}: {first['msg']}") from fault


def _payload(path: Path, index: int, entry: Entry, books: "dict[str, Codebook]") -> Bank:
    try:
        book = books.setdefault(entry.profile, codebook_of(entry.profile))
        if entry.random is not None:
            generator = np.random.default_rng(entry.seed)
            symbols = random_symbols(entry.random, entry.frames, book, generator)
            return Bank.of_symbols(symbols, book, entry.pilot_every)
        file = path.parent / str(entry.payload)
        if file.suffix == ".npy":
            return read_masks(file, entry.frames, book, entry.pilot_every)
        return Bank.of_symbols(read_symbols(file, book, entry.pilot_every), book, entry.pilot_every)
    except EvlcpError as fault:
        raise InputError(f"{path}: board[{index}]: {fault}") from fault


def _program(entry: Entry, payload: Bank, verify: bool) -> Result:
    start = time.monotonic()
    try:
        with Session(open_port(entry.port, entry.baud), Timing(entry.baud)) as session:
            board = Board(session)
            found = board.about.unique_id.hex()
            if entry.unique_id not in (None, found):
                raise IncompatibleError(
                    f"{entry.port}: unique_id {found}, the inventory expects {entry.unique_id};"
                    " plug in that board or correct the inventory"
                )
            done = provision(board, payload, entry.settings, verify)
        return Result(entry, done, None, time.monotonic() - start)
    except EvlcpError as fault:
        return Result(entry, None, fault, time.monotonic() - start)


def program_fleet(
    inventory: Inventory, verify: bool = True, report: Callable[[Result], None] | None = None
) -> list[Result]:
    """Program all boards at once; one that fails does not hold up the others.

    Args:
        inventory: The boards.
        verify: Whether to compare what each board holds.
        report: Called with each result as it comes.

    Returns:
        The results in the inventory's order.
    """
    results: dict[str, Result] = {}
    with ThreadPoolExecutor(min(64, len(inventory.boards))) as pool:
        for future in as_completed([pool.submit(_program, e, p, verify) for e, p in inventory.boards]):
            result = future.result()
            results[result.entry.id] = result
            if report:
                report(result)
    return [results[entry.id] for entry, _ in inventory.boards]


def raise_failures(inventory: Inventory, results: list[Result]) -> None:
    """Raise FleetError, with the exit code of the first failure, if any board failed."""
    failed = [r for r in results if r.fault is not None]
    if failed and failed[0].fault is not None:
        raise FleetError(
            f"{inventory.path}: {len(failed)} of {len(results)} boards failed"
            f" ({', '.join(r.entry.id for r in failed)}); the others are programmed;"
            " run it again for the rest",
            failed[0].fault.exit_code,
        )
