"""Packets to messages: soft bits to blocks, blocks to messages, signatures to trust."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.blocks import HEADER_BYTES, Block, BlockError, Kind, Message, join_parts, total_bytes
from evlcp_sdk.air.kinds import BUILT_IN_KINDS, MessageKind
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.blocks import BlockCoder
from evlcp_sdk.link.resolve import Link
from evlcp_sdk.link.sections import MessageSpec
from evlcp_sdk.rx.trust import BeaconVerifier, TrustVerdict, describe_signature
from evlcp_sdk.utc import ClockZero, clock_zero_at
from evlcp_sdk.values import Packet, ReceivedMessage, remember_newest, replace_fields

_LLR_POWER, _MAX_LLR = 0.5, 7.0
"""Power that magnitudes of LLRs are raised to, as decoders are overconfident within a burst, and their limit
after that: no bit is surer than the sync that it depends on, which is wrong once in a thousand."""

_SAME_BLOCK_SIGMA = 6.0
"""Agreement of two packets' soft bits from which on they carry the same block: by chance once in 1e9
pairs."""

_MAX_TRANSMITTERS = 16
"""Transmitters whose messages are collected: those received last."""

_MAX_MESSAGES = 8
"""Messages of a transmitter that are collected at a time, and complete ones that are remembered."""

_COUNTS = (
    *("blocks_reflected", "blocks_tried", "blocks_decoded", "blocks_combined", "blocks_failed"),
    *("blocks_alike", "blocks_malformed", "blocks_other_codebook"),
    *("parts_repeated", "parts_conflicting", "parts_missing"),
    *("messages", "messages_mixed", "messages_undecodable"),
    *("beacons_verified", "beacons_unverified", "beacons_forged", "beacons_undated"),
)

_Key = tuple[int, int, int]
"""Transmitter id, kind and sequence of a message."""


@dataclass
class _BlockSum:
    """The sum of the LLRs of packets with the same block, float32 (bits,), which is not decoded yet."""

    llr: NDArray[np.float32]
    packets: int


@dataclass
class _PartialMessage:
    """A message as far as it is known.

    Attributes:
        length: Its bytes.
        total: Bytes that all its parts carry.
        parts: Known parts by number.
        payload: Its bytes, once all are known.
        delivered: The verdict that was delivered last; None before.
    """

    length: int
    total: int
    parts: dict[int, bytes] = field(default_factory=dict)
    payload: bytes = b""
    delivered: TrustVerdict | None = None


@dataclass
class _Inbox:
    """Blocks and messages of one transmitter, in bounded memory."""

    sums: list[_BlockSum] = field(default_factory=list)
    incomplete: dict[_Key, _PartialMessage] = field(default_factory=dict)
    complete: dict[_Key, _PartialMessage] = field(default_factory=dict)


class MessageAssembler:
    """Decodes the blocks of packets and assembles messages from them, transmitter by transmitter.

    A packet is decoded by itself first. If that fails, its LLRs are added to those of earlier packets that
    carry the same block, if there are any, and the sum is decoded. Two packets carry the same block if the
    products of their soft bits add up to more than six standard deviations of what chance gives, whatever the
    order in which the transmitter repeats its blocks. So a packet is decoded twice at most, and noise is
    taken for a block at most twice as often as in a single decoding.

    Args:
        coder: Decodes the blocks of packets.
        spec: The configuration.
        kinds: The known kinds of messages, by number; blocks of others count as malformed.
        clock_zero: UTC of the camera clock's 0; None if it is not known.

    Attributes:
        counts: Blocks and messages tried, decoded and lost so far.

    Raises:
        ConfigError: A trusted key is not valid, or there are keys and the extra `sign` is not installed.
    """

    def __init__(
        self,
        coder: BlockCoder,
        spec: MessageSpec,
        kinds: Mapping[int, MessageKind] = BUILT_IN_KINDS,
        clock_zero: ClockZero = None,
    ) -> None:
        self._coder = coder
        self._kinds = kinds
        self._spec = spec
        self._room = coder.block_bytes - HEADER_BYTES
        self._beacon_verifier = BeaconVerifier(spec, coder.digest)
        self._clock_zero = clock_zero
        self._inboxes: dict[int, _Inbox] = {}
        self.counts = dict.fromkeys(_COUNTS, 0)

    @classmethod
    def of(cls, link: Link, clock_zero: ClockZero = None) -> Self | None:
        """The assembler of a link's messages; None if that is turned off, or packets are too short for them.

        Raises:
            ConfigError: As above.
        """
        if not link.messages.decode:
            return None
        try:
            coder = link.block_coder()
        except ConfigError:
            return None
        return cls(coder, link.messages, link.kinds, clock_zero)

    def add(self, packet: Packet) -> Packet:
        """Decode a packet; return it with its block and the messages that it completes.

        A reflection is left out: it repeats what its transmitter sends, with more errors.
        """
        if packet.echo_of is not None:
            self.counts["blocks_reflected"] += 1
            return packet
        inbox = self._inboxes.get(packet.transmitter, _Inbox())
        for old in remember_newest(self._inboxes, packet.transmitter, inbox, _MAX_TRANSMITTERS).values():
            self._count_missing(old.incomplete.values())
        self.counts["blocks_tried"] += 1
        content, packets = self._decode_packet(inbox, self._calibrate_llr(packet))
        if content is None:
            self.counts["blocks_failed"] += 1
            return packet
        self.counts["blocks_decoded" if packets == 1 else "blocks_combined"] += 1
        try:
            block = Block.unpack(content, self._kinds)
        except BlockError:
            self.counts["blocks_malformed"] += 1
            return packet
        if block.codebook != self._coder.digest:
            self.counts["blocks_other_codebook"] += 1
            return packet
        messages = tuple(self._add_block(inbox, block, packet))
        return replace_fields(packet, block=block, block_packets=packets, messages=messages)

    def close(self) -> None:
        """End the stream: parts of incomplete messages count as missing."""
        for inbox in self._inboxes.values():
            self._count_missing(inbox.incomplete.values())
        self._inboxes.clear()

    def _calibrate_llr(self, packet: Packet) -> NDArray[np.float32]:
        """Calibrated LLRs of a packet's bits in the order on air, 0 where a frame is missing."""
        llr = np.zeros((packet.sent, self._coder.bits // packet.sent), np.float32)
        for frame in packet.frames:
            llr[frame.frame] = frame.soft.llr.ravel()
        magnitude = np.minimum(np.abs(llr) ** _LLR_POWER, _MAX_LLR)
        return np.copysign(magnitude, llr).ravel()

    def _decode_packet(self, inbox: _Inbox, llr: NDArray[np.float32]) -> tuple[bytes | None, int]:
        """The bytes of a packet's block, None if they are not known yet, and the packets that it took."""
        content = self._coder.decode_block(llr)
        if content is not None or not self._spec.combine_packets:
            return content, 1
        agreements = [_agreement(llr, earlier.llr) for earlier in inbox.sums]
        best = int(np.argmax(agreements)) if agreements else -1
        if best < 0 or agreements[best] < _SAME_BLOCK_SIGMA:
            inbox.sums = [*inbox.sums, _BlockSum(llr, 1)][-self._spec.combine_packets :]
            return None, 0
        self.counts["blocks_alike"] += 1
        earlier = inbox.sums.pop(best)
        total = _BlockSum(earlier.llr + llr, earlier.packets + 1)
        content = self._coder.decode_block(total.llr)
        if content is None:
            inbox.sums.append(total)
        return content, total.packets

    def _add_block(self, inbox: _Inbox, block: Block, packet: Packet) -> list[ReceivedMessage]:
        """Add a block to its message; return what can be delivered now."""
        key = (block.transmitter_id, block.kind, block.sequence)
        known = inbox.complete.get(key) or inbox.incomplete.get(key)
        if known and known.length == block.length and known.parts.get(block.index) == block.part:
            self.counts["parts_repeated"] += 1
            return self._deliver(inbox, key, packet)
        if known and (known.length != block.length or block.index in known.parts):
            # Two messages under one number: the later one is collected anew.
            self.counts["parts_conflicting"] += 1
            inbox.complete.pop(key, None)
            if key in inbox.incomplete:
                self._count_missing([inbox.incomplete.pop(key)])
        total = total_bytes(block.length, self._room)
        partial = inbox.incomplete.get(key, _PartialMessage(block.length, total))
        partial.parts[block.index] = block.part
        self._count_missing(remember_newest(inbox.incomplete, key, partial, _MAX_MESSAGES).values())
        if sum(map(len, partial.parts.values())) != partial.total:
            return []
        try:
            partial.payload = join_parts([partial.parts[i] for i in sorted(partial.parts)], partial.length)
        except BlockError:
            # Two messages under one number, mixed: the newest part is surely of the newest.
            self.counts["messages_mixed"] += 1
            partial.parts = {block.index: block.part}
            return []
        remember_newest(inbox.complete, key, inbox.incomplete.pop(key), _MAX_MESSAGES)
        return self._deliver(inbox, key, packet)

    def _deliver(self, inbox: _Inbox, key: _Key, packet: Packet) -> list[ReceivedMessage]:
        """A complete message, if it is new or its verdict has changed; a signature delivers its beacon."""
        transmitter_id, number, sequence = key
        if number == Kind.SIGNATURE:
            key = (transmitter_id, Kind.BEACON, sequence)
        known = inbox.complete.get(key)
        if known is None:
            return []
        remember_newest(inbox.complete, key, known, _MAX_MESSAGES)
        message = Message(key[1], transmitter_id, sequence, known.payload)
        kind = self._kinds[message.kind]
        try:
            value = kind.unpack(message.payload)
        except (Exception, SystemExit):
            # Whatever a lamp sends, and whatever a plugin makes of it, the receiver goes on.
            self.counts["messages_undecodable"] += known.delivered is None
            known.delivered = TrustVerdict("unverified", "undecodable")
            return []
        beacon = value if message.kind == Kind.BEACON else None
        verdict = TrustVerdict("unverified", "not signed")
        zero = clock_zero_at(self._clock_zero, packet.t_us)
        now_s = None if zero is None else zero.timestamp() + packet.t_us * 1e-6
        if beacon is not None:
            signed = inbox.complete.get((transmitter_id, Kind.SIGNATURE, sequence))
            signature = None
            if signed is not None:
                signature = Message(Kind.SIGNATURE, transmitter_id, sequence, signed.payload)
            verdict = self._beacon_verifier.verify(message, beacon, signature, now_s)
        if verdict == known.delivered:
            return []
        self.counts["messages"] += known.delivered is None
        if beacon is not None and (known.delivered is None or known.delivered.trust != verdict.trust):
            self.counts[f"beacons_{verdict.trust}"] += 1
            self.counts["beacons_undated"] += verdict.trust == "verified" and now_s is None
        known.delivered = verdict
        where = (packet.transmitter, packet.packet, packet.t_us)
        reason, age_s = verdict.reason, None
        if verdict.trust == "verified":
            reason, age_s = describe_signature(message, now_s)
        elif message.kind == Kind.TIME and now_s is not None:
            age_s = now_s - value
        return [ReceivedMessage(*where, message, kind, value, verdict.trust, reason, age_s, packet.link)]

    def _count_missing(self, incomplete: Iterable[_PartialMessage]) -> None:
        for partial in incomplete:
            self.counts["parts_missing"] += -(-partial.total // self._room) - len(partial.parts)


def _agreement(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Agreement of two packets' soft bits, in standard deviations of that of independent bits."""
    product = a.astype(np.float64) * b
    spread = float(np.vdot(product, product)) ** 0.5
    return float(product.sum()) / spread if spread else 0.0
