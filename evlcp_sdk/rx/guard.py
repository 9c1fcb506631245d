"""Whose fault it is when a stage of the receiver fails."""

import traceback
from pathlib import Path
from types import TracebackType

import numpy as np

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.errors import EvlcpError, PluginError
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.values import SoftSymbols

__all__ = ["Guard"]


class Guard:
    """A context in which code of one algorithm runs: what it raises becomes a `PluginError` that names it.

    What the SDK itself raises on purpose passes. The original exception is the cause.

    Args:
        link: The configuration that names the algorithm.
        role: Its role.

    >>> from evlcp_sdk.link.resolve import load_link
    >>> with Guard(load_link(), "ranging"):
    ...     {}["boom"]
    Traceback (most recent call last):
    evlcp_sdk.errors.PluginError: ranging algorithm 'joint-scale': KeyError: 'boom' (...
    """

    def __init__(self, link: Link, role: str) -> None:
        id = link.table[role]["id"]
        self._who = f"{role} algorithm '{id}'"
        self._hint = f"try: evlcp check {role} {id}"

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(fault, Exception) and not isinstance(fault, EvlcpError):
            last = traceback.extract_tb(trace)[-1]
            what = f"{type(fault).__name__}: {fault}".splitlines()[0]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            raise PluginError(f"{self._who}: {what} ({where}); {self._hint}") from fault

    def expect(self, found: object, kind: type) -> None:
        """Check what an algorithm gave.

        Raises:
            PluginError: It is of another type.
        """
        if not isinstance(found, kind):
            name = type(found).__name__
            raise PluginError(f"{self._who}: gave {name}, expected {kind.__name__}; {self._hint}")

    def expect_symbols(self, soft: SoftSymbols, codebook: Codebook) -> None:
        """Check what a decoding gave.

        Raises:
            PluginError: It is not a `SoftSymbols`, or of other shapes than the codebook's.
        """
        self.expect(soft, SoftSymbols)
        for name, found, expected in (
            ("symbols", soft.symbols, (codebook.clusters,)),
            ("llr", soft.llr, (codebook.clusters, codebook.bits_per_symbol)),
        ):
            if np.shape(found) != expected:
                raise PluginError(
                    f"{self._who}: gave {name} of shape {np.shape(found)}, expected {expected}; {self._hint}"
                )
