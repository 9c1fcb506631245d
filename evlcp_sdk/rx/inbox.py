"""Packets to messages: soft bits to blocks, blocks to messages, signatures to trust."""

from collections import OrderedDict
from collections.abc import Mapping
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
from evlcp_sdk.rx.guard import Guard
from evlcp_sdk.rx.trust import BeaconJudge, Standing, signed_text
from evlcp_sdk.utc import ClockZero, clock_zero_at
from evlcp_sdk.values import Packet, ReceivedMessage, replace_fields

_LLR_POWER, _MOST_LLR = 0.5, 7.0
"""Power that sizes of LLRs are raised to, as decoders are surer within a burst than they are right, and the
largest after that: no bit is surer than the sync it hangs on, which is wrong once in a thousand."""

_SAME_BLOCK_SIGMA = 6.0
"""Agreement of two packets' soft bits from which on they carry one block: by chance once in 1e9 pairs."""

_MOST_TRANSMITTERS = 16
"""Transmitters whose messages are collected; the one not received for longest makes way."""

_MOST_MESSAGES = 8
"""Messages of a transmitter that are collected at a time, and that are remembered when complete."""

_Key = tuple[int, int, int]


@dataclass
class _Sum:
    """Packets of one block that is not decoded yet: the sum of their LLRs, float32 (bits,), and how many."""

    llr: NDArray[np.float32]
    packets: int


@dataclass
class _Parts:
    """A message as far as it is known.

    Attributes:
        length: Its bytes.
        carried: Bytes that all its parts carry.
        parts: Known parts by number.
        payload: Its bytes, once all are known.
        given: The trust last handed on, and why not more; None before.
    """

    length: int
    carried: int
    parts: dict[int, bytes] = field(default_factory=dict)
    payload: bytes = b""
    given: Standing | None = None


@dataclass
class _Inbox:
    """What is known of one transmitter's messages, in bounded memory."""

    sums: list[_Sum] = field(default_factory=list)
    open: OrderedDict[_Key, _Parts] = field(default_factory=OrderedDict)
    done: OrderedDict[_Key, _Parts] = field(default_factory=OrderedDict)


class MessageAssembler:
    """Reads the blocks of packets and puts messages together, transmitter by transmitter.

    A packet is decoded by itself first. If that fails, its LLRs are added to those of earlier packets that
    carry the same block, if there are any, and the sum is decoded. Two packets carry the same block if the
    products of their soft bits add up to more than six standard deviations of what chance gives, whatever the
    order in which the transmitter repeats its blocks. So a packet is decoded twice at most, and the
    probability that noise is taken for a block is at most twice that of a single decoding.

    Args:
        coder: How packets carry blocks.
        spec: The configuration.
        kinds: The kinds of messages that are understood, by number; blocks of others count as malformed.
        guard: Names the error correction where it fails.
        clock_zero: UTC of the camera clock's 0; None if it is not known.

    Attributes:
        counts: What was tried, found and given up so far.

    Raises:
        ConfigError: A trusted key is not valid, or there are keys and the extra `sign` is not installed.
    """

    def __init__(
        self,
        coder: BlockCoder,
        spec: MessageSpec,
        kinds: Mapping[int, MessageKind] = BUILT_IN_KINDS,
        guard: Guard | None = None,
        clock_zero: ClockZero = None,
    ) -> None:
        self._coder = coder
        self._guard = guard
        self._kinds = kinds
        self._spec = spec
        self._room = coder.block_bytes - HEADER_BYTES
        self._beacons = BeaconJudge(spec, coder.digest)
        self._clock_zero = clock_zero
        self._inboxes: OrderedDict[int, _Inbox] = OrderedDict()
        self.counts = dict.fromkeys(
            (
                "blocks_reflected",
                "blocks_tried",
                "blocks_decoded",
                "blocks_combined",
                "blocks_failed",
                "blocks_alike",
                "blocks_malformed",
                "blocks_other_codebook",
                "parts_repeated",
                "parts_conflicting",
                "parts_missing",
                "messages",
                "messages_mixed",
                "messages_undecodable",
                "beacons_verified",
                "beacons_unverified",
                "beacons_forged",
                "beacons_undated",
            ),
            0,
        )

    @classmethod
    def of(cls, link: Link, clock_zero: ClockZero = None) -> Self | None:
        """What reads a link's messages; None where that is turned off, or packets are too short for them.

        Args:
            link: The link.
            clock_zero: UTC of the camera clock's 0; None if it is not known.

        Raises:
            ConfigError: As above.
        """
        if not link.messages.decode:
            return None
        try:
            with Guard(link, "error-correction", may_refuse=True):
                coder = link.block_coder()
        except ConfigError:
            return None
        guard = Guard(link, "error-correction")
        return cls(coder, link.messages, link.kinds, guard, clock_zero)

    def add(self, packet: Packet) -> Packet:
        """Read a packet; return it with its block and the messages that it completes.

        A reflection is left out: it repeats what its transmitter says, with more errors.
        """
        if packet.echo_of is not None:
            self.counts["blocks_reflected"] += 1
            return packet
        inbox = self._inboxes.setdefault(packet.transmitter, _Inbox())
        self._inboxes.move_to_end(packet.transmitter)
        while len(self._inboxes) > _MOST_TRANSMITTERS:
            self._give_up(self._inboxes.popitem(last=False)[1])
        self.counts["blocks_tried"] += 1
        content, packets = self._content(inbox, self._llr(packet))
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
        messages = tuple(self._take(inbox, block, packet))
        return replace_fields(packet, block=block, block_packets=packets, messages=messages)

    def close(self) -> None:
        """End the stream: what is still incomplete counts as missing."""
        for inbox in self._inboxes.values():
            self._give_up(inbox)
        self._inboxes.clear()

    def _llr(self, packet: Packet) -> NDArray[np.float32]:
        """Calibrated LLRs of a packet's bits in the order on air, 0 where a frame is missing."""
        llr = np.zeros((packet.sent, self._coder.bits // packet.sent), np.float32)
        for frame in packet.frames:
            llr[frame.frame] = frame.soft.llr.ravel()
        llr[np.isnan(llr)] = 0
        size = np.minimum(np.abs(llr) ** _LLR_POWER, _MOST_LLR)
        return np.copysign(size, llr).ravel()

    def _content(self, inbox: _Inbox, llr: NDArray[np.float32]) -> tuple[bytes | None, int]:
        """The bytes of a packet's block and the packets it took; None if that is not known yet."""
        found = self._block(llr)
        if found is not None or not self._spec.combine_packets:
            return found, 1
        alike = [_agreement(llr, earlier.llr) for earlier in inbox.sums]
        best = int(np.argmax(alike)) if alike else -1
        if best < 0 or alike[best] < _SAME_BLOCK_SIGMA:
            inbox.sums = [*inbox.sums, _Sum(llr, 1)][-self._spec.combine_packets :]
            return None, 0
        self.counts["blocks_alike"] += 1
        one = inbox.sums.pop(best)
        total = _Sum(one.llr + llr, one.packets + 1)
        found = self._block(total.llr)
        if found is None:
            inbox.sums.append(total)
        return found, total.packets

    def _block(self, llr: NDArray[np.float32]) -> bytes | None:
        try:
            return self._coder.decode_block(llr)
        except (Exception, SystemExit) as fault:
            if self._guard is not None:
                self._guard.reraise(fault)
            raise

    def _take(self, inbox: _Inbox, block: Block, packet: Packet) -> list[ReceivedMessage]:
        """Put a block into its message; give what can be handed on now."""
        key = (block.transmitter_id, block.kind, block.sequence)
        known = inbox.done.get(key) or inbox.open.get(key)
        if known and known.length == block.length and known.parts.get(block.index) == block.part:
            self.counts["parts_repeated"] += 1
            return self._hand_on(inbox, key, packet)
        if known and (known.length != block.length or block.index in known.parts):
            # Two messages under one number: the later one is collected anew.
            self.counts["parts_conflicting"] += 1
            inbox.done.pop(key, None)
            self._missing(inbox.open.pop(key, None))
        carried = total_bytes(block.length, self._room)
        parts = inbox.open.setdefault(key, _Parts(block.length, carried))
        inbox.open.move_to_end(key)
        parts.parts[block.index] = block.part
        while len(inbox.open) > _MOST_MESSAGES:
            self._missing(inbox.open.popitem(last=False)[1])
        if sum(map(len, parts.parts.values())) != parts.carried:
            return []
        try:
            parts.payload = join_parts([parts.parts[i] for i in sorted(parts.parts)], parts.length)
        except BlockError:
            # Two messages under one number, mixed: the newest part is surely of the newest.
            self.counts["messages_mixed"] += 1
            parts.parts = {block.index: block.part}
            return []
        inbox.done[key] = inbox.open.pop(key)
        while len(inbox.done) > _MOST_MESSAGES:
            inbox.done.popitem(last=False)
        return self._hand_on(inbox, key, packet)

    def _hand_on(self, inbox: _Inbox, key: _Key, packet: Packet) -> list[ReceivedMessage]:
        """A complete message, if it is new or its trust has changed; a signature's is its beacon."""
        transmitter_id, number, sequence = key
        if number == Kind.SIGNATURE:
            key = (transmitter_id, Kind.BEACON, sequence)
        parts = inbox.done.get(key)
        if parts is None:
            return []
        inbox.done.move_to_end(key)
        message = Message(key[1], transmitter_id, sequence, parts.payload)
        kind = self._kinds[message.kind]
        try:
            value = kind.unpack(message.payload)
        except (Exception, SystemExit):
            # Whatever a lamp says, and whatever a plugin makes of it, the receiver goes on.
            return self._undecodable(parts)
        beacon = value if message.kind == Kind.BEACON else None
        verdict, now_s = Standing("unverified", "not signed"), None
        if message.kind in (Kind.BEACON, Kind.TIME):
            zero = clock_zero_at(self._clock_zero, packet.t_us)
            now_s = None if zero is None else zero.timestamp() + packet.t_us * 1e-6
        if beacon is not None:
            signed = inbox.done.get((transmitter_id, Kind.SIGNATURE, sequence))
            signature = None
            if signed is not None:
                signature = Message(Kind.SIGNATURE, transmitter_id, sequence, signed.payload)
            verdict = self._beacons.judge(message, beacon, signature, now_s)
        if verdict == parts.given:
            return []
        self.counts["messages"] += parts.given is None
        if beacon is not None and (parts.given is None or parts.given.trust != verdict.trust):
            self.counts[f"beacons_{verdict.trust}"] += 1
            self.counts["beacons_undated"] += verdict.trust == "verified" and now_s is None
        parts.given = verdict
        where = (packet.transmitter, packet.packet, packet.t_us)
        reason, age_s = verdict.why, None
        if verdict.trust == "verified":
            reason, age_s = signed_text(message, now_s)
        elif message.kind == Kind.TIME and now_s is not None:
            age_s = now_s - value
        return [ReceivedMessage(*where, message, kind, value, verdict.trust, reason, age_s, packet.link)]

    def _undecodable(self, parts: _Parts) -> list[ReceivedMessage]:
        """Count a message whose bytes mean nothing, once."""
        if parts.given is None:
            parts.given = Standing("unverified", "undecodable")
            self.counts["messages_undecodable"] += 1
        return []

    def _missing(self, parts: _Parts | None) -> None:
        if parts is not None:
            self.counts["parts_missing"] += -(-parts.carried // self._room) - len(parts.parts)

    def _give_up(self, inbox: _Inbox) -> None:
        for parts in inbox.open.values():
            self._missing(parts)


def _agreement(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """How much two packets' soft bits agree, in standard deviations of what independent bits would."""
    product = a.astype(np.float64) * b
    spread = float(np.vdot(product, product)) ** 0.5
    return float(product.sum()) / spread if spread else 0.0
