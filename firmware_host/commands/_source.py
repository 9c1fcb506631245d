"""Where a command's symbols and their link come from: a file, or random ones with a seed."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.link.resolve import Link
    from firmware_host.board.bank import Bank

SymbolsFile = Annotated[
    Path | None,
    typer.Argument(metavar="SYMBOLS.json", help="Symbols \\[packet]\\[frame]\\[cluster], with their link."),
]
RandomPackets = Annotated[
    int | None, typer.Option("--random", metavar="N", help="N packets of random symbols.")
]
Seed = Annotated[int, typer.Option(help="Seed of --random.", min=0)]


def _given(link_file: str | None, overrides: list[str] | None) -> "Link | None":
    """The link that -c and --set name; None if neither is given."""
    if link_file is None and not overrides:
        return None
    from evlcp_sdk.link.resolve import load_link

    return load_link(link_file, overrides or [])


def _default() -> "Link":
    from evlcp_sdk.link.resolve import load_link

    return load_link()


def symbols(
    path: Path | None, random: int | None, seed: int, link_file: str | None, overrides: list[str] | None
) -> "tuple[NDArray[np.int64], Link]":
    """Symbols (packets, frames, clusters) of a file, or `random` packets, and the link they are sent with.

    Raises:
        ConfigError: Neither is given, or both, or the link is wrong.
        IncompatibleError: The file was made with another link.
        InputError: The file is wrong.
    """
    if (path is None) == (random is None):
        raise ConfigError("give symbols as SYMBOLS.json or with --random N, one of the two")
    link = _given(link_file, overrides)
    if path is not None:
        from firmware_host.board.symbols import read_symbols

        return read_symbols(path, link)
    import numpy as np

    from firmware_host.board.bank import MOST_RANDOM_FRAMES, random_symbols

    link = link or _default()
    frames = link.packet.frames
    if random is None or not (random >= 1 and random * frames <= MOST_RANDOM_FRAMES):
        raise ConfigError(
            f"--random {random}, air.frames_per_packet = {frames}: expected at least 1 packet,"
            f" at most {MOST_RANDOM_FRAMES} frames in all"
        )
    return random_symbols(random, frames, link.codebook, np.random.default_rng(seed)), link


def bank(
    path: Path | None,
    random: int | None,
    masks: Path | None,
    seed: int,
    link_file: str | None,
    overrides: list[str] | None,
) -> "Bank":
    """The content of a bank, of symbols or of chip masks.

    Raises:
        ConfigError: Not one of them is given, the link is wrong, or a board cannot play it.
        IncompatibleError: The file was made with another link.
        InputError: The file is wrong.
    """
    from firmware_host.board.bank import bank_of, read_masks

    if masks is None:
        return bank_of(*symbols(path, random, seed, link_file, overrides))
    if path is not None or random is not None:
        raise ConfigError("--masks, --random and SYMBOLS.json: give one of them")
    link = _given(link_file, overrides) or _default()
    return read_masks(masks, link)
