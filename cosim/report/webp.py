"""Pictures of a page, as WebP in data URLs."""

from __future__ import annotations

import base64
from fractions import Fraction
from typing import Final

import av
import cv2
import numpy as np

from cosim.report.legend import Image

_QUALITY: Final = 58
_EFFORT: Final = "2"
"""Of 0 to 6: half the time of 4, which OpenCV takes, for 4 % more bytes and the same error."""
_CODER: Final = "libwebp"


def image_url(rgb: Image, quality: int = _QUALITY) -> str:
    """Return an (H, W, 3) picture as it stands in a page."""
    return "data:image/webp;base64," + base64.b64encode(as_webp(rgb, quality)).decode()


def as_webp(rgb: Image, quality: int = _QUALITY) -> bytes:
    """Return an (H, W, 3) picture as a WebP file."""
    if _CODER not in av.codecs_available:
        return cv2.imencode(".webp", rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    coder = av.CodecContext.create(_CODER, "w")
    coder.height, coder.width = rgb.shape[:2]
    coder.pix_fmt, coder.time_base = "yuv420p", Fraction(1)
    coder.options = {"quality": str(quality), "compression_level": _EFFORT}
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24").reformat(format="yuv420p")
    frame.pts = 0
    return b"".join(bytes(packet) for part in (frame, None) for packet in coder.encode(part))
