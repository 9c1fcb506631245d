"""Worked values of docs/messages.md: prints messages.json."""

import hashlib
import json
from itertools import product

from evlcp_sdk.air.beacons import Beacon
from evlcp_sdk.air.blocks import Kind, Message, split_message
from evlcp_sdk.air.signing import signature_input
from evlcp_sdk.link.blocks import interleaver_order
from evlcp_sdk.link.resolve import load_link

PROFILES = ("wh4x2", "wh8", "raw8")


def messages():
    beacon = Beacon(35.156789012, -136.965432101, 52.345, 123.45, 2.5, 0.96, b"lane 2")
    return [
        Message(Kind.BEACON, 7, 1_800_000_000, beacon.pack()),
        Message(Kind.TEXT, 0xFFFFFFFF, 1, "Tempo 30 für die nächsten zwei Kilometer".encode()),
        Message(Kind.DATA, 1, 0, bytes(100)),
        Message(Kind.SIGNATURE, 7, 1_800_000_000, bytes(range(72))),
    ]


def vectors():
    packets = []
    for profile, code in product(PROFILES, ("polar", "none")):
        overrides = [f"modulation.id={profile}", f"error-correction.id={code}"]
        coder = load_link(overrides=overrides).block_coder()
        for message in messages():
            for block in split_message(message, coder.digest, coder.block_bytes):
                packed = block.pack(coder.block_bytes)
                symbols = coder.encode_symbols(packed).astype("uint8").tobytes()
                packet = {
                    "profile": profile,
                    "error_correction": code,
                    "codebook": coder.digest.hex(),
                    "kind": block.kind.name.lower(),
                    "transmitter_id": block.transmitter_id,
                    "sequence": block.sequence,
                    "index": block.index,
                    "length": block.length,
                    "part": block.part.hex(),
                    "block": packed.hex(),
                    "symbols": symbols.hex(),
                }
                if code != "none":
                    packet["symbols"] = "sha256:" + hashlib.sha256(symbols).hexdigest()
                packets.append(packet)
    digest = load_link().block_coder().digest
    return {
        "interleaver_960": interleaver_order(960).tolist(),
        "signed_bytes": signature_input(messages()[0], digest).hex(),
        "packets": packets,
    }


if __name__ == "__main__":
    print(json.dumps(vectors(), indent=1))
