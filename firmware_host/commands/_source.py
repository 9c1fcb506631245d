"""Options for a command's symbols and their link: a file, or random symbols with a seed."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evlcp_sdk.cli import _sdk as sdk
from evlcp_sdk.cli._common import LinkFile, Overrides
from evlcp_sdk.errors import ConfigError
from firmware_host.commands import _host as host

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class SymbolOptions:
    """Symbols and their link."""

    symbols: Annotated[
        Path | None, typer.Argument(metavar="SYMBOLS.json", help="Symbols and their link.")
    ] = None
    random: Annotated[int | None, typer.Option(metavar="N", help="N packets of random symbols.")] = None
    seed: Annotated[int, typer.Option(help="Seed of --random.", min=0, metavar="N", show_default=False)] = 0
    link_file: LinkFile = None
    overrides: Overrides = None

    def load_given_link(self) -> "sdk.resolve.Link | None":
        """Load the link of -c and --set; None if neither is given."""
        if self.link_file is None and not self.overrides:
            return None
        return sdk.resolve.load_link(self.link_file, self.overrides or [])

    def load(self) -> "tuple[NDArray[np.int64], sdk.resolve.Link]":
        """Load symbols (packets, frames, clusters) from the file, or draw random ones; with their link.

        Raises:
            ConfigError: Neither or both are given, or the link is wrong.
            IncompatibleError: The file was made with another link.
            InputError: The file is wrong.
        """
        link = self.load_given_link()
        if self.symbols is not None and self.random is None:
            return host.symbols.read_symbols(self.symbols, link)
        if self.random is None or self.symbols is not None:
            raise ConfigError("give symbols as SYMBOLS.json or with --random N, one of the two")
        link = link or sdk.resolve.load_link()
        return host.bank.random_packets(self.random, link, self.seed), link


@dataclass(frozen=True)
class BankOptions(SymbolOptions):
    """A board's payload: symbols, or chips."""

    masks: Annotated[Path | None, typer.Option(metavar="FILE.npy", help="Chips instead of symbols.")] = None

    def load_bank(self) -> "host.bank.Bank":
        """Load the bank; errors as of `load`, or a board cannot play it."""
        if self.masks is None:
            return host.bank.make_bank(*self.load())
        if self.symbols is not None or self.random is not None:
            raise ConfigError("--masks, --random and SYMBOLS.json: give one of them")
        return host.bank.read_masks(self.masks, self.load_given_link() or sdk.resolve.load_link())
