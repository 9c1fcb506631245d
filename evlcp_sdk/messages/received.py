"""A message as a receiver hands it on."""

from dataclasses import dataclass
from typing import Literal

from evlcp_sdk.messages.beacon import Beacon
from evlcp_sdk.messages.block import Message

__all__ = ["ReceivedMessage", "Trust"]

Trust = Literal["verified", "unverified", "forged"]
"""Signed by a trusted key and not replayed; not known to be; or known not to be."""


@dataclass(frozen=True)
class ReceivedMessage:
    """A message that is complete, and how far it may be believed.

    Attributes:
        transmitter: Number of the transmitter, as in `Packet`.
        packet: Number of the packet that completed it, or that changed how far it may be believed.
        t_us: Start of that packet's first preamble chip on the camera's clock, us.
        message: What was received.
        beacon: What a beacon says; None for other kinds.
        trust: How far it may be believed. Texts and data are not signed, so they are `unverified`.
        reason: Why it is not `verified`; empty where it is.
    """

    transmitter: int
    packet: int
    t_us: float
    message: Message
    beacon: Beacon | None
    trust: Trust
    reason: str
