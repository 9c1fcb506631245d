"""Where a command's symbols come from: a file, or random ones with a seed."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from evlcp_sdk.air.codebook import Codebook

__all__ = [
    "Frames",
    "PilotEvery",
    "ProfileName",
    "RandomPackets",
    "Seed",
    "SymbolsFile",
    "codebook",
    "symbols",
]

SymbolsFile = Annotated[
    Path | None, typer.Argument(metavar="SYMBOLS.json", help="Symbols \\[packet]\\[frame]\\[cluster].")
]
RandomPackets = Annotated[
    int | None, typer.Option("--random", metavar="N", help="N packets of random symbols.")
]
Seed = Annotated[int, typer.Option(help="Seed of --random.", min=0)]
Frames = Annotated[int, typer.Option(help="Frames per packet of --random and --masks.")]
PilotEvery = Annotated[
    int,
    typer.Option(min=1, max=64, metavar="N", help="Frames from one pilot to the next, as the receiver's."),
]
ProfileName = Annotated[str, typer.Option("--profile", help="Info-segment profile: wh4x2, wh8, raw8.")]

MOST = 1_000_000
"""Random frames at most: minutes of light at 10 000 chips/s, far beyond any bank, and within memory."""


def codebook(profile: str) -> "Codebook":
    """The codebook of a profile.

    Raises:
        UnknownAlgorithmError: No modulation has that name.
    """
    from firmware_host.protocol.generate import codebook_of

    return codebook_of(profile)


def symbols(
    path: Path | None, random: int | None, seed: int, frames: int, pilot_every: int, book: "Codebook"
) -> "NDArray[np.int64]":
    """Symbols (packets, frames, clusters) of a file, or `random` packets.

    Raises:
        ConfigError: Neither is given, or both.
        InputError: The file is wrong.
    """
    from firmware_host.board.bank import random_symbols, read_symbols

    if (path is None) == (random is None):
        raise ConfigError("give symbols as SYMBOLS.json or with --random N, one of the two")
    if path is not None:
        return read_symbols(path, book, pilot_every)
    import numpy as np

    if random is None or not (1 <= random <= MOST and 1 <= frames <= MOST and random * frames <= MOST):
        raise ConfigError(
            f"--random {random} --frames {frames}: expected at least 1 of each, at most {MOST} frames in all"
        )
    return random_symbols(random, frames, book, np.random.default_rng(seed))
