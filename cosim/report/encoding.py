"""Encode videos (H.264 by PyAV) and pictures (WebP data URLs)."""

from __future__ import annotations

import base64
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import RunError, unwritable
from cosim.core.files import atomic_file
from cosim.report.legend import Image

_MAX_PX = 4096
"""Longest side of a video, pixels."""


class Video:
    """Video file (.mp4) that is being written; use in a `with` block.

    size: width, height, both even
    fps: frames per second

    The file appears at the end of the block, only without an error. Raises MachineError if it
    cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int) -> None:
        if path.suffix != ".mp4":
            raise RunError(f"{path}: a video's name ends in .mp4")
        if any(side % 2 or not 16 <= side <= _MAX_PX for side in size):
            raise RunError(
                f"a video of {size[0]}x{size[1]} pixels: both sides must be even, from 16 to "
                f"{_MAX_PX}"
            )
        self._path = path
        try:
            with ExitStack() as stack:
                part = stack.enter_context(atomic_file(path))
                part.touch()
                self._file = av.open(str(part), "w", format="mp4")
                stack.callback(self._file.close)
                self._context = stack.pop_all()
        except OSError as error:
            raise unwritable(path, error) from error
        self._stream = self._file.add_stream(
            "libx264", rate=fps, options={"crf": "21", "preset": "veryfast"}
        )
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"

    def __enter__(self) -> Self:
        return self

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append a frame (height, width, 3)."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        self._write(frame)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                with self._context:
                    self._write(None)
            else:
                self._context.__exit__(kind, error, trace)
        except OSError as problem:
            raise unwritable(self._path, problem) from problem

    def _write(self, frame: av.VideoFrame | None) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._file.mux(packet)
        except OSError as error:
            raise unwritable(self._path, error) from error


_QUALITY: Final = 58
_EFFORT: Final = "2"
"""WebP effort, 0 to 6: half the time of 4, OpenCV's default, for 4 % more bytes."""
_CODEC: Final = "libwebp"


def image_url(rgb: Image, quality: int = _QUALITY) -> str:
    """Return an (H, W, 3) picture as a WebP data URL."""
    return "data:image/webp;base64," + base64.b64encode(as_webp(rgb, quality)).decode()


def as_webp(rgb: Image, quality: int = _QUALITY) -> bytes:
    """Encode an (H, W, 3) picture as WebP."""
    if _CODEC not in av.codecs_available:
        return cv2.imencode(".webp", rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])[
            1
        ].tobytes()
    codec = av.CodecContext.create(_CODEC, "w")
    codec.height, codec.width = rgb.shape[:2]
    codec.pix_fmt = "yuv420p"
    codec.time_base = Fraction(1)
    codec.options = {"quality": str(quality), "compression_level": _EFFORT}
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24").reformat(
        format="yuv420p"
    )
    frame.pts = 0
    return b"".join(bytes(packet) for part in (frame, None) for packet in codec.encode(part))
