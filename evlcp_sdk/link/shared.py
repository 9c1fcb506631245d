"""What both ends of a link must share, and where two links do not."""

from collections.abc import Iterator

import numpy as np

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import packet_bits
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.specs import shown

_MESSAGES_TRIED = 4


def differences(sent: Link, received: Link, *, messages: bool = False) -> tuple[str, ...]:
    """One text for each thing that both ends must share and do not; none when they fit.

    Chip rate, frames of a packet, pilots, codes, the layout of the clusters. What only one end needs, such as
    the camera or the decoding, may differ.

    Args:
        sent: The link of the transmitter.
        received: The link of the receiver.
        messages: Messages are sent, so that the error correction counts, too.

    >>> from evlcp_sdk.link.resolve import resolve
    >>> differences(resolve({"air": {"chip_rate_hz": 5000.0}}), resolve({}))
    ('air.chip_rate_hz: sent with 5000.0, received with 10000.0',)
    """
    return tuple(_differences(sent, received, messages))


def _differences(sent: Link, received: Link, messages: bool) -> Iterator[str]:
    for key in ("chip_rate_hz", "frames_per_packet", "pilot_every"):
        yield from _keys(sent, received, "air", key)
    if sent.codebook != received.codebook:
        yield from _codes(sent, received)
    if not _same_layout(sent, received):
        other_shape = [*_keys(sent, received, "bar", "shape")]
        yield from other_shape or _keys(sent, received, "bar", *sent.table["bar"])
    if messages and not _same_correction(sent, received):
        yield from _section(sent, received, "error-correction") or [
            _other_codes(sent, received, "error-correction")
        ]


def _codes(sent: Link, received: Link) -> Iterator[str]:
    """Why the codebooks differ; more clusters of one family show in the layout."""
    ours, theirs = sent.codebook, received.codebook
    if framing := _section(sent, received, "framing"):
        yield from framing
        return
    both = min(ours.clusters, theirs.clusters)
    if not (
        np.array_equal(ours.preamble, theirs.preamble)
        and np.array_equal(ours.pilots[:both], theirs.pilots[:both])
    ):
        yield from _section(sent, received, "pilots") or [_other_codes(sent, received, "pilots")]
    if ours.profile != theirs.profile or not np.array_equal(ours.codewords, theirs.codewords):
        yield from _section(sent, received, "modulation") or [_other_codes(sent, received, "modulation")]


def _other_codes(sent: Link, received: Link, role: str) -> str:
    """Codes that differ although all settings are the same."""
    role = role if role in sent.table else "framing"
    name, a, b = sent.table[role]["id"], sent.revisions[role], received.revisions[role]
    which = f"revision {a}, received with revision {b}" if a != b else "other codes than those received with"
    return f"{role}.id = {shown(name)}: sent with {which}"


def _same_layout(sent: Link, received: Link) -> bool:
    a, b = sent.bar.cluster_centres_m(), received.bar.cluster_centres_m()
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-6, atol=1e-9))


def _same_correction(sent: Link, received: Link) -> bool:
    """Whether both ends make the same coded bits of a message; how they are decoded is the receiver's."""
    try:
        ours, theirs = (
            link.algorithm("error-correction").compile(packet_bits(link.codebook, link.packet))
            for link in (sent, received)
        )
    except ConfigError:
        return False
    if (ours.message_bits, ours.coded_bits) != (theirs.message_bits, theirs.coded_bits):
        return False
    rng = np.random.default_rng(0)
    tried = (rng.integers(0, 2, ours.message_bits, np.uint8) for _ in range(_MESSAGES_TRIED))
    return all(np.array_equal(ours.encode(bits), theirs.encode(bits)) for bits in tried)


def _section(sent: Link, received: Link, role: str) -> list[str]:
    """Where the settings of a role differ: its algorithm, or else that one's parameters."""
    if role not in sent.table or role not in received.table:
        return []
    found = list(_keys(sent, received, role, "id"))
    return found or list(_keys(sent, received, role, *sent.table[role]))


def _keys(sent: Link, received: Link, section: str, *keys: str) -> Iterator[str]:
    for key in keys:
        a, b = sent.table[section].get(key), received.table[section].get(key)
        if a != b:
            yield f"{section}.{key}: sent with {shown(a)}, received with {shown(b)}"
