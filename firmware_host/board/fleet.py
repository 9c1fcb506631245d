"""Many boards at once, from one inventory."""

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.specs import SpecError, build, read_toml, shown
from firmware_host.board.bank import MOST_RANDOM_FRAMES, Bank, bank_of, check_link, random_symbols, read_masks
from firmware_host.board.board import Board, Programmed, Settings, provision
from firmware_host.board.session import Session
from firmware_host.board.symbols import read_symbols
from firmware_host.emulators.opening import open_port
from firmware_host.errors import FleetError, IncompatibleError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.requests import DEFAULT_BAUD, Watchdog

__all__ = ["Entry", "Inventory", "Result", "program_fleet", "raise_failures", "read_inventory"]


@dataclass(frozen=True)
class Entry:
    """One board of an inventory.

    Attributes:
        id: Transmitter id, unique in the inventory.
        port: Port, as for `--port`, unique in the inventory.
        position_m: Coordinates x, y, z of the bar's centre, m.
        payload: Symbols `[packet][frame][cluster]` in a JSON file, or chip masks in a `.npy` file.
        random: Instead of `payload`: that many packets of random symbols.
        seed: Seed of `random`.
        link: The link: a file, its path relative to the inventory's, or its tables. Without it a payload's
            own, or all defaults.
        unique_id: The part's own number in hex, as `evlcp board hello` shows it; another board is refused.
        level_ma: LED current, mA.
        watchdog: What the board does when the host is silent.
        watchdog_ms: After which silence, ms.
        start: Whether to play when done.
        baud: Line rate, bit/s.

    Raises:
        ConfigError: Not exactly one of payload and random is given.
    """

    id: Annotated[str, Field(min_length=1)]
    port: Annotated[str, Field(min_length=1)]
    position_m: Annotated[list[float], Field(min_length=3, max_length=3)]
    payload: str | None = None
    random: Annotated[int, Field(ge=1, le=65535)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    link: str | dict[str, Any] | None = None
    unique_id: Annotated[str, Field(pattern="^[0-9a-f]{24}$")] | None = None
    level_ma: Annotated[int, Field(ge=0, le=65535)] | None = None
    watchdog: Literal["keep", "idle", "dark"] | None = None
    watchdog_ms: Annotated[int, Field(ge=100, le=2**32 - 1)] = 5_000
    start: bool = True
    baud: Annotated[int, Field(ge=1200)] = DEFAULT_BAUD

    def __post_init__(self) -> None:
        if (self.payload is None) == (self.random is None):
            raise ConfigError("give payload or random, one of the two")

    @property
    def settings(self) -> Settings:
        """What the board is set to."""
        watchdog = None if self.watchdog is None else Watchdog[self.watchdog.upper()]
        return Settings(self.level_ma, watchdog, self.watchdog_ms, self.start)


@dataclass(frozen=True)
class Inventory:
    """The boards of a file, each with what it plays.

    Attributes:
        path: The file.
        boards: Entry and bank of each board.
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
        ConfigError: The inventory cannot be read, a value or a link is wrong, or a board cannot play a link;
            the message names the place, the value and what was expected.
        InputError: A payload cannot be read.
        IncompatibleError: A payload was made with another link.
    """
    table = read_toml(path)
    unknown = sorted(set(table) - {"defaults", "board"})
    if unknown:
        raise ConfigError(f"{path}: {unknown[0]}: unknown table, expected [defaults] and [[board]]")
    defaults, rows = table.get("defaults", {}), table.get("board", [])
    if not isinstance(defaults, dict):
        raise ConfigError(f"{path}: defaults = {shown(defaults)}, expected a table [defaults]")
    if not isinstance(rows, list) or not rows or not all(isinstance(r, dict) for r in rows):
        raise ConfigError(f"{path}: board: expected at least one [[board]] table")
    entries = [_entry(path, i, defaults | row) for i, row in enumerate(rows)]
    for key in ("id", "port"):
        first: dict[str, int] = {}
        for i, entry in enumerate(entries):
            value = getattr(entry, key)
            if value in first and not value.startswith(("native:", "qemu:")):
                raise ConfigError(
                    f"{path}: board[{i}].{key} = {shown(value)},"
                    f" expected another than board[{first[value]}]'s"
                )
            first[value] = i
    links = _Links(path)
    return Inventory(path, tuple((e, _bank(path, i, e, links)) for i, e in enumerate(entries)))


def _entry(path: Path, index: int, row: dict[str, Any]) -> Entry:
    place = f"{path}: board[{index}]"
    try:
        return build(Entry, row)
    except SpecError as refused:
        raise ConfigError("\n".join(refused.lines(f"{place}."))) from refused
    except ConfigError as fault:
        raise ConfigError(f"{place}: {fault}") from fault


class _Links:
    """The links of an inventory, each resolved once."""

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        self._found: dict[str, Link] = {}
        self.registry = Registry.load()

    def of(self, named: str | dict[str, Any]) -> Link:
        key = json.dumps(named, sort_keys=True, default=str)
        if key not in self._found:
            self._found[key] = (
                load_link(self._folder / named, (), self.registry)
                if isinstance(named, str)
                else resolve(named, self.registry, source="link")
            )
        return self._found[key]


def _bank(path: Path, index: int, entry: Entry, links: _Links) -> Bank:
    place = f"{path}: board[{index}]"
    try:
        given = None if entry.link is None else links.of(entry.link)
        if entry.payload is not None and not entry.payload.endswith(".npy"):
            symbols, link = read_symbols(path.parent / entry.payload, given, links.registry)
            return bank_of(symbols, link)
        link = given or links.of({})
        check_link(link)
        if entry.payload is not None:
            return read_masks(path.parent / entry.payload, link.codebook, link.packet)
        packets, frames = entry.random or 0, link.packet.frames
        if packets * frames > MOST_RANDOM_FRAMES:
            raise ConfigError(
                f"random = {packets}: {packets * frames} frames, expected at most {MOST_RANDOM_FRAMES}"
            )
        generator = np.random.default_rng(entry.seed)
        return bank_of(random_symbols(packets, frames, link.codebook, generator), link)
    except EvlcpError as fault:
        kind = next(
            k for k in (IncompatibleError, InputError, ConfigError, EvlcpError) if isinstance(fault, k)
        )
        raise kind("\n".join(f"{place}: {line}" for line in str(fault).splitlines())) from fault


def _program(entry: Entry, bank: Bank, verify: bool) -> Result:
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
            done = provision(board, bank, entry.settings, verify)
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
