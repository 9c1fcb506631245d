"""What both ends of a link must share, and where two links do not."""

import numpy as np

from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import packet_bits
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.specs import format_value

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
    found = _keys(sent, received, "air", "chip_rate_hz", "frames_per_packet", "pilot_every")
    if sent.codebook != received.codebook:
        found += _codes(sent, received)
    ours, theirs = sent.bar.cluster_centres_m(), received.bar.cluster_centres_m()
    if ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=1e-6, atol=1e-9):
        other_shape = _keys(sent, received, "bar", "shape")
        found += other_shape or _keys(sent, received, "bar", *sent.table["bar"])
    if messages and not _same_correction(sent, received):
        found += _section(sent, received, "error-correction")
    return tuple(found)


def _codes(sent: Link, received: Link) -> list[str]:
    """Why the codebooks differ; more clusters of one family show in the layout."""
    ours, theirs = sent.codebook, received.codebook
    if framing := _settings(sent, received, "framing"):
        return framing
    both, found = min(ours.clusters, theirs.clusters), []
    if not (
        np.array_equal(ours.preamble, theirs.preamble)
        and np.array_equal(ours.pilots[:both], theirs.pilots[:both])
    ):
        found += _section(sent, received, "pilots")
    if ours.profile != theirs.profile or not np.array_equal(ours.codewords, theirs.codewords):
        found += _section(sent, received, "modulation")
    return found


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
    """Why codes of a role differ: by its settings, or although these are the same."""
    if found := _settings(sent, received, role):
        return found
    role = role if role in sent.table else "framing"
    name, a, b = sent.table[role]["id"], sent.revisions[role], received.revisions[role]
    which = f"revision {a}, received with revision {b}" if a != b else "other codes than those received with"
    return [f"{role}.id = {format_value(name)}: sent with {which}"]


def _settings(sent: Link, received: Link, role: str) -> list[str]:
    """Where the settings of a role differ: its algorithm, or else that one's parameters."""
    if role not in sent.table or role not in received.table:
        return []
    return _keys(sent, received, role, "id") or _keys(sent, received, role, *sent.table[role])


def _keys(sent: Link, received: Link, section: str, *keys: str) -> list[str]:
    values = ((key, sent.table[section].get(key), received.table[section].get(key)) for key in keys)
    return [
        f"{section}.{key}: sent with {format_value(a)}, received with {format_value(b)}"
        for key, a, b in values
        if a != b
    ]
