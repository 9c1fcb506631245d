"""Seals of requests: HMAC-SHA256 with the board's key, over the session's challenge. No I/O.

A seal is the first `SEAL_BYTES` of

```
HMAC( key, challenge | type u8 | SEALED u8 | session u16 | number u32 | payload )
```

`number` goes on where the sequence in the header wraps, so that no request of a session comes twice; the
challenge is another one in each session, so that none of an earlier session is taken again.
"""

import hashlib
import hmac
import struct
from dataclasses import dataclass

from firmware_host.protocol.generated.requests import KEY_NAME_BYTES, SEAL_BYTES, SEALED

_HEAD = struct.Struct("<BBHI")


def key_name(key: bytes) -> bytes:
    """What a key is called: the first bytes of its SHA-256."""
    return hashlib.sha256(key).digest()[:KEY_NAME_BYTES]


@dataclass(frozen=True)
class Sealer:
    """Seals the requests of one session.

    Attributes:
        key: The board's key.
        challenge: What the board drew for the session.
        start: Number of the request with token 0.
    """

    key: bytes
    challenge: bytes
    start: int

    def seal(self, type_: int, session: int, token: int, payload: bytes) -> bytes:
        """The seal that goes behind the payload of the request with a token."""
        head = _HEAD.pack(type_, SEALED, session, (self.start + token) & 0xFFFFFFFF)
        return hmac.digest(self.key, self.challenge + head + payload, "sha256")[:SEAL_BYTES]
