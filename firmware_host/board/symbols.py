"""Files of symbols and their link.

JSON: a list `[packet][frame][cluster]`, or an object with `symbols` and, as `evlcp tx` writes it, `link` (the
link's tables that determine the light) and `codebook`; further keys are ignored.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.errors import InputError, name_place
from evlcp_sdk.files import read_json
from evlcp_sdk.link.resolve import Link, resolve
from evlcp_sdk.link.shared import find_differences
from evlcp_sdk.plugin.registry import Registry
from firmware_host.errors import IncompatibleError

ON_AIR = ("air", "bar", "framing", "pilots", "modulation")
"""Tables of a link that determine symbols and chips; blocks depend on the error correction, too."""

_CORRECTION = "error-correction"

Symbols = NDArray[np.int64]


def symbols_table(symbols: Symbols, link: Link, *, messages: bool = False) -> dict[str, Any]:
    """The content of a file of symbols (packets, frames, clusters), plain values.

    With `messages` the error correction belongs to the link.
    """
    tables = (*ON_AIR, _CORRECTION) if messages else ON_AIR
    return {
        "link": {name: dict(link.table[name]) for name in tables if name in link.table},
        "codebook": link.codebook.digest,
        "symbols": symbols.tolist(),
    }


def read_symbols(path: Path, link: Link | None, registry: Registry | None = None) -> tuple[Symbols, Link]:
    """Symbols of a file, int64 (packets, frames, clusters), and their link.

    The link is the user's, if there is one, else the file's own, or all defaults.

    Raises:
        IncompatibleError: The file was made with another link, or with other codes than those of its link.
        InputError: The file cannot be read, is not JSON, or an element is missing, out of range or not an
            integer; the message names the place.
    """
    table = read_json(path)
    if isinstance(table, dict):
        if "link" in table:
            link = _load_link(path, table, link, registry)
        if "symbols" not in table:
            raise InputError(f"{path}: key symbols is missing, expected symbols[packet][frame][cluster]")
        table = table["symbols"]
    if link is None:
        link = resolve({}, registry)
    return parse_symbols(path, table, link), link


def _load_link(path: Path, table: dict[str, Any], given: Link | None, registry: Registry | None) -> Link:
    tables = table["link"]
    if not isinstance(tables, dict):
        raise InputError(f"{path}: link = {json.dumps(tables)[:40]}, expected the tables of a link")
    with name_place(f"{path}: link: ", InputError):
        own = resolve(tables, registry)
    digest = table.get("codebook", own.codebook.digest)
    if digest != own.codebook.digest:
        raise IncompatibleError(
            f"{path}: codebook = {json.dumps(digest)[:18]}, expected {own.codebook.digest[:16]}"
            f" ({own.codebook.profile}): made with other codes than those of its link; make the file again"
        )
    if given is not None:
        differ = find_differences(own, given, messages=_CORRECTION in tables)
        if differ:
            raise IncompatibleError(
                f"{path}: made with another link: {'; '.join(differ)}; leave out -c and --set to use its own"
            )
    return own


def parse_symbols(path: Path, packets: Any, link: Link) -> Symbols:
    """Symbols from a list `[packet][frame][cluster]`, int64; errors name `path`.

    Raises:
        InputError: An element is missing, out of range or not an integer; the message names the place.
    """
    book, frames = link.codebook, link.packet.frames
    place, top = "symbols", len(book.codewords) - 1
    _check_list(path, place, packets, "packets")
    for p, packet in enumerate(packets):
        _check_list(path, f"{place}[{p}]", packet, "frames", frames, "air.frames_per_packet")
        for f, frame in enumerate(packet):
            _check_list(path, f"{place}[{p}][{f}]", frame, "symbols", book.clusters, "one per cluster")
            for k, symbol in enumerate(frame):
                if type(symbol) is not int or not 0 <= symbol <= top:
                    raise InputError(
                        f"{path}: {place}[{p}][{f}][{k}] = {json.dumps(symbol)},"
                        f" expected an integer 0 to {top} ({book.profile})"
                    )
    return np.array(packets, np.int64)


def _check_list(
    path: Path, place: str, value: Any, of: str, length: int | None = None, why: str = ""
) -> None:
    if not isinstance(value, list) or not value or (length is not None and len(value) != length):
        found = f"{len(value)} elements" if isinstance(value, list) else json.dumps(value)[:40]
        wanted = f"a list of {of}" if length is None else f"{length} {of}, {why}"
        raise InputError(f"{path}: {place}: found {found}, expected {wanted}")
