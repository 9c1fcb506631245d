"""Many boards at once, from one inventory."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from evlcp_sdk.errors import ConfigError, EvlcpError, InputError, name_place
from evlcp_sdk.formatting import format_value
from evlcp_sdk.link.compose import encode_messages, encode_utf8, make_messages
from evlcp_sdk.link.resolve import Link, load_link, resolve
from evlcp_sdk.plugin.registry import Registry
from evlcp_sdk.specs import build_spec, read_toml
from firmware_host.board.bank import Bank, make_bank, random_packets, read_masks
from firmware_host.board.board import Board, Settings, provision
from firmware_host.board.keys import read_board_key
from firmware_host.board.messages import choose_site
from firmware_host.board.session import Session
from firmware_host.board.symbols import read_symbols
from firmware_host.emulators.opening import open_port
from firmware_host.errors import FleetError, IncompatibleError
from firmware_host.protocol.client import Timing
from firmware_host.protocol.generated.requests import DEFAULT_BAUD


@dataclass(frozen=True, kw_only=True)
class FleetEntry(Settings):
    """One board of an inventory: its payload and `Settings`; paths are relative to the inventory's.

    Attributes:
        id: Transmitter id, unique in the inventory.
        port: Port, as for `--port`, unique in the inventory.
        position_m: Coordinates x, y, z of the bar's centre, m.
        payload: Symbols `[packet][frame][cluster]` in a JSON file, or chip masks in a `.npy` file.
        random: Instead of `payload`: number of packets of random symbols.
        text: Instead of `payload`: a text message.
        beacon: Instead of `payload`, or with `text`: the file of sites with the bar of the beacon.
        user: The user's own bytes in the beacon, as text.
        key: File of the private key that signs the beacon.
        transmitter_id: Transmitter id in its messages; without it the site's, or 0.
        sequence: Number of its messages: raise it when they change.
        repeat: Times in a row that each packet is sent.
        link: The link, a file or its tables. Without it a payload's own, or all defaults.
        unique_id: The part's unique id in hex, as `evlcp board hello` shows it, unique, too; another board is
            refused.
        baud: Line rate, bit/s.
        board_key: File of the board's key.

    Raises:
        ConfigError: Not exactly one of payload, random and a message is given.
    """

    id: Annotated[str, Field(min_length=1)]
    port: Annotated[str, Field(min_length=1)]
    position_m: Annotated[list[float], Field(min_length=3, max_length=3)]
    payload: str | None = None
    random: Annotated[int, Field(ge=1, le=65535)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    text: Annotated[str, Field(min_length=1)] | None = None
    beacon: str | None = None
    user: str = ""
    key: str | None = None
    transmitter_id: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    sequence: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    repeat: Annotated[int, Field(ge=1, le=1000)] = 1
    link: str | dict[str, Any] | None = None
    unique_id: Annotated[str, Field(pattern="^[0-9a-f]{24}$")] | None = None
    baud: Annotated[int, Field(ge=1200)] = DEFAULT_BAUD
    board_key: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        given = (self.payload is not None, self.random is not None, self.has_message)
        if sum(given) != 1:
            raise ConfigError("give payload or random or a message (text, beacon), one of them")
        if self.has_message and self.sequence is None:
            raise ConfigError("a message needs sequence: raise it when the message changes")
        if self.beacon is None and (self.key is not None or self.user):
            raise ConfigError("key and user belong to a beacon: give beacon, too")

    @property
    def has_message(self) -> bool:
        """Whether it sends a message."""
        return self.text is not None or self.beacon is not None


@dataclass(frozen=True)
class _Tables:
    board: Annotated[list[dict[str, Any]], Field(min_length=1)]
    defaults: dict[str, Any] = field(default_factory=dict)


def read_inventory(path: Path) -> tuple[tuple[FleetEntry, ...], dict[str, Bank]]:
    """Read the boards of an inventory, and the bank of each by its id.

    Raises:
        ConfigError: See `read_entries`; or a link or a message is wrong, or a board cannot play it.
        InputError: A payload or a key cannot be read.
        IncompatibleError: A payload was made with another link.
    """
    entries, registry = read_entries(path), Registry.load()
    return entries, {entry.id: _load_bank(path, n, entry, registry) for n, entry in enumerate(entries)}


def read_entries(path: Path) -> tuple[FleetEntry, ...]:
    """Read the boards of an inventory: `[[board]]` tables, and `[defaults]` with any key of a board.

    Raises:
        ConfigError: The inventory cannot be read, or a value is wrong; the message names the place, the value
            and what was expected.
    """
    table = read_toml(path)
    with name_place(f"{path}: "):
        tables = build_spec(_Tables, table)
    entries = []
    for i, row in enumerate(tables.board):
        with name_place(f"{path}: board[{i}]: "):
            entries.append(build_spec(FleetEntry, tables.defaults | row))
    for key in ("id", "port", "unique_id"):
        first: dict[str | None, int] = {}
        for i, entry in enumerate(entries):
            value = getattr(entry, key)
            if value is not None and value in first and not value.startswith("native:"):
                raise ConfigError(
                    f"{path}: board[{i}]: {key} = {format_value(value)},"
                    f" expected another than board[{first[value]}]'s"
                )
            first[value] = i
    return tuple(entries)


def _load_bank(path: Path, index: int, entry: FleetEntry, registry: Registry) -> Bank:
    folder, given, named = path.parent, None, entry.link
    try:
        if isinstance(named, str):
            given = load_link(folder / named, (), registry)
        elif named is not None:
            given = resolve(named, registry, source="link")
        if entry.payload is not None and not entry.payload.endswith(".npy"):
            symbols, link = read_symbols(folder / entry.payload, given, registry)
            return make_bank(symbols, link)
        link = given or resolve({}, registry)
        if entry.has_message:
            return _message_bank(folder, entry, link)
        if entry.payload is not None:
            return read_masks(folder / entry.payload, link)
        return make_bank(random_packets(entry.random or 0, link, entry.seed), link)
    except EvlcpError as fault:
        kind = next(
            k for k in (IncompatibleError, InputError, ConfigError, EvlcpError) if isinstance(fault, k)
        )
        place = f"{path}: board[{index}]"
        raise kind("\n".join(f"{place}: {line}" for line in str(fault).splitlines())) from fault


def _message_bank(folder: Path, entry: FleetEntry, link: Link) -> Bank:
    site = None
    if entry.beacon is not None:
        site = choose_site(folder / entry.beacon, entry.transmitter_id, "transmitter_id")
    messages = make_messages(
        link,
        text=entry.text,
        beacon=site,
        user=encode_utf8(entry.user, "user"),
        key=None if entry.key is None else folder / entry.key,
        transmitter_id=entry.transmitter_id,
        sequence=entry.sequence,
    )
    return make_bank(encode_messages(messages, link.block_coder(), entry.repeat), link)


@contextlib.contextmanager
def open_entry(entry: FleetEntry, folder: Path) -> Iterator[Board]:
    """Open the board of an inventory's entry; paths are relative to the folder.

    Raises:
        IncompatibleError: Another board is on its port.
        InputError: Its key cannot be read.
        NoBoardError: None answers there.
        RefusedError: It has another key.
    """
    key = None if entry.board_key is None else read_board_key(folder / entry.board_key)
    with Session(open_port(entry.port, entry.baud), Timing(entry.baud), key=key) as session:
        board = Board(session)
        found = board.info.unique_id.hex()
        if entry.unique_id not in (None, found):
            raise IncompatibleError(
                f"{entry.port}: unique_id {found}, the inventory expects {entry.unique_id};"
                " plug in that board or correct the inventory"
            )
        yield board


Work = Callable[[FleetEntry, Board], tuple[str, dict[str, Any]]]
"""Works on a board; returns the result as text and as plain values."""

Report = Callable[[str, dict[str, Any]], None]
"""Called with each board's result when it is done: a line of text, and plain values."""


def run_fleet(path: Path, entries: Sequence[FleetEntry], work: Work, report: Report) -> None:
    """Work on all boards of an inventory at once; one that fails does not stop the others.

    Raises:
        FleetError: A board failed; it has the exit code of the first of them.
    """
    codes: dict[str, int] = {}

    def run_entry(entry: FleetEntry) -> tuple[str, dict[str, Any]]:
        start = time.monotonic()
        table, code, fault = dict[str, Any](), 0, None
        try:
            with open_entry(entry, path.parent) as board:
                summary, table = work(entry, board)
        except EvlcpError as failure:
            code, fault = failure.exit_code, str(failure)
            codes[entry.id] = code
            summary = f"FAILED ({code}): {fault}"
        elapsed_s = round(time.monotonic() - start, 3)
        head = {"id": entry.id, "port": entry.port, "position_m": list(entry.position_m), "ok": not code}
        result = {"exit_code": code, "fault": fault, "elapsed_s": elapsed_s}
        return f"{entry.id}  {entry.port}  {summary}", head | table | result

    with ThreadPoolExecutor(min(64, len(entries))) as pool:
        for future in as_completed([pool.submit(run_entry, entry) for entry in entries]):
            report(*future.result())
    failed = [entry.id for entry in entries if entry.id in codes]
    if failed:
        raise FleetError(
            f"{path}: {len(failed)} of {len(entries)} boards failed"
            f" ({', '.join(failed)}); the others are done; run it again for the rest",
            codes[failed[0]],
        )


def program_fleet(
    path: Path, entries: Sequence[FleetEntry], banks: Mapping[str, Bank], verify: bool, report: Report
) -> None:
    """Program all boards of an inventory at once; errors as of `run_fleet`."""

    def work(entry: FleetEntry, board: Board) -> tuple[str, dict[str, Any]]:
        start = time.monotonic()
        done = provision(board, banks[entry.id], entry, verify)
        table = {"written_bytes": done.written, "swapped": done.swapped}
        if not done.swapped:
            return f"was there already ({done.length} bytes)", table
        elapsed = time.monotonic() - start
        return f"programmed {done.written} of {done.length} bytes in {elapsed:.2f} s", table

    run_fleet(path, entries, work, report)
