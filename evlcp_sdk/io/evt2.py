"""EVT2: 32-bit words, one an event, with the low 6 bits of the time in each."""

from typing import Final

import numpy as np

from evlcp_sdk.io import _words
from evlcp_sdk.io._codec import Codec

EVT2: Final = Codec(
    name="EVT2",
    version="2.0",
    word=np.dtype("<u4"),
    burst=1,
    types=frozenset(
        {
            _words.EVT2_CD_OFF,
            _words.EVT2_CD_ON,
            _words.EVT2_TIME_HIGH,
            _words.EVT2_EXT_TRIGGER,
            _words.EVT2_OTHERS,
            _words.EVT2_CONTINUED,
        }
    ),
    channels=32,
    time_bits=(28, 6),
    rollover=(0x85555555, 0x8AAAAAAA, 0x8FFFFFFF, 0x80000000, 0x80000000),
    decoder="decode_evt2",
    encoder="encode_evt2",
)
"""t = rollovers * 2^34 + TIME_HIGH * 2^6 + the event's own 6 bits, us."""
