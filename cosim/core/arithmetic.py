"""What this machine makes of sines, powers and the like, told as a hash of their bits.

No standard says how the last bit of a sine is rounded. The C library's libm has a way for each kind of processor (with
fused multiply-add, without), and so has numpy (AVX-512, or not): two machines with the same packages may come to other
bits, two with other C libraries to the same. So what is recorded of a machine is not their names but what they answer.
"""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache

import numpy as np

_ASKED = 4096
"""Arguments of each function. Where two ways of rounding differ at all they do so for one in some hundred."""


@lru_cache(maxsize=1)
def arithmetic() -> str:
    """Hash of the bits of what the simulation computes with, over fixed arguments; 6 ms, once in a process."""
    share = np.arange(1, _ASKED + 1, dtype=np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32) / 2.0**32
    other = np.roll(share, 1)
    angle, ratio, power, much = (share - 0.5) * 40.0, 2.0 * share - 1.0, (share - 0.5) * 20.0, share * 100.0
    of_one = (
        (math.sin, np.sin, angle),
        (math.cos, np.cos, angle),
        (math.tan, None, angle),
        (math.atan, np.arctan, angle),
        (math.asin, np.arcsin, ratio),
        (math.acos, np.arccos, ratio),
        (math.exp, np.exp, power),
        (math.log, np.log, much),
    )
    of_two = ((math.atan2, np.arctan2), (math.hypot, np.hypot), (math.pow, np.power))
    bits = hashlib.blake2b(digest_size=8)
    for plain, array, asked in of_one:
        bits.update(np.array([plain(value) for value in asked.tolist()]).tobytes())
        if array is not None:
            bits.update(array(asked).tobytes())
    for plain_2, array_2 in of_two:
        pairs = zip(much.tolist(), other.tolist(), strict=True)
        bits.update(np.array([plain_2(one, two) for one, two in pairs]).tobytes())
        bits.update(array_2(much, other).tobytes())
    return bits.hexdigest()
