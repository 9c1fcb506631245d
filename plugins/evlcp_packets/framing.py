"""The built-in framing."""

from dataclasses import dataclass
from typing import ClassVar

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.plugin.roles import STEPS, Deframer, Framing


@dataclass(frozen=True)
class Packets(Framing):
    """Packets of a preamble and frames of pilot and codeword; all steps are roles of their own."""

    roles: ClassVar[frozenset[str]] = STEPS

    def codebook(self, clusters: int) -> Codebook | None:
        """None: the codes are those of the roles."""
        return None

    def compile(self, codebook: Codebook, packet: PacketFormat) -> Deframer:
        """Not asked for."""
        raise NotImplementedError
