"""EVT3: 16-bit words that each state what changes (time, row, columns); native to the IMX636."""

from typing import Final

import numpy as np

from evlcp_sdk.io import _words
from evlcp_sdk.io._codec import Codec

EVT3: Final = Codec(
    name="EVT3",
    version="3.0",
    word=np.dtype("<u2"),
    burst=12,
    types=frozenset(
        {
            _words.EVT3_ADDR_Y,
            _words.EVT3_ADDR_X,
            _words.EVT3_VECT_BASE_X,
            _words.EVT3_VECT_12,
            _words.EVT3_VECT_8,
            _words.EVT3_TIME_LOW,
            _words.EVT3_CONTINUED_4,
            _words.EVT3_TIME_HIGH,
            _words.EVT3_EXT_TRIGGER,
            _words.EVT3_OTHERS,
            _words.EVT3_CONTINUED_12,
        }
    ),
    channels=16,
    time_bits=(12, 12),
    rollover=(0x8555, 0x6000, 0x8AAA, 0x6000, 0x8FFF, 0x6000, 0x8000, 0x6000, 0x8000, 0x6000),
    decoder="decode_evt3",
    encoder="encode_evt3",
)
"""t = rollovers * 2^24 + TIME_HIGH * 2^12 + TIME_LOW, us."""
