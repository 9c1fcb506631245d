"""Seals of requests: HMAC-SHA256 with the board's key, over the session's challenge. No I/O.

A seal is the first `SEAL_BYTES` of

```
HMAC( key, challenge | type u8 | SEALED u8 | session u16 | number u32 | payload )
```

`number` does not wrap with the sequence in the header, so that no request of a session is repeated; each
session has another challenge, so that no request of an earlier one is accepted.
"""

import hashlib
import hmac
import struct
from dataclasses import dataclass

from firmware_host.protocol.generated.requests import KEY_NAME_BYTES, SEAL_BYTES, SEALED

_HEAD = struct.Struct("<BBHI")


def key_name(key: bytes) -> bytes:
    """A key's name: the first bytes of its SHA-256."""
    return hashlib.sha256(key).digest()[:KEY_NAME_BYTES]


@dataclass(frozen=True)
class Sealer:
    """Seals the requests of one session.

    Attributes:
        key: The board's key.
        challenge: The board's random bytes for the session.
        start: Number of the request with token 0.
    """

    key: bytes
    challenge: bytes
    start: int

    def seal(self, type_: int, session: int, token: int, payload: bytes) -> bytes:
        """The seal that follows the payload of the request with a token."""
        head = _HEAD.pack(type_, SEALED, session, (self.start + token) & 0xFFFFFFFF)
        return hmac.digest(self.key, self.challenge + head + payload, "sha256")[:SEAL_BYTES]
