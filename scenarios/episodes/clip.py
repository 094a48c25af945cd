"""Encoding of the pictures of an episode as an H.264 clip, and joining of clips to one .mp4.

Joining does not encode again. The same pictures give the same bytes, and decode to the same
pictures: the encoder uses one thread, no date, no B-frames and no processor-specific code, which
with AVX-512 varies between calls. Colors are converted here in integers (BT.601), because the
library's rounding depends on the alignment of its buffers.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Final

import av
import cv2
import numpy as np
from av.container import OutputContainer
from numpy.typing import NDArray

from cosim.core.errors import RunError

CODEC: Final = "h264"
PIXELS: Final = "yuv420p"
_OPTIONS: Final = {
    "crf": "18",
    "preset": "veryfast",
    "bf": "0",
    "g": "10",
    "threads": "1",
    "flags": "+bitexact",
    "x264-params": "cpu-independent=1",
}
_MUXED: Final = {"fflags": "+bitexact"}


class Clip:
    """Encoder of one clip. size: width and height in pixels; fps: pictures per second."""

    def __init__(self, size: tuple[int, int], fps: int) -> None:
        self._bytes = io.BytesIO()
        self._file: OutputContainer = av.open(self._bytes, "w", format="mp4", options=_MUXED)
        self._stream = self._file.add_stream("libx264", rate=fps, options=_OPTIONS)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = PIXELS
        self._stream.codec_context.thread_count = 1

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Add the next picture, (H, W, 3)."""
        frame = av.VideoFrame.from_ndarray(_planes_of(rgb), format=PIXELS)
        self._file.mux(self._stream.encode(frame))

    def finished(self) -> bytes:
        """Return the .mp4 of all pictures, and end the encoding."""
        self._file.mux(self._stream.encode(None))
        self._file.close()
        return self._bytes.getvalue()


def join_clips(clips: Iterable[bytes], lengths: Sequence[int], path: Path, fps: int) -> None:
    """Write clips one after another into one .mp4.

    Picture k is shown k / fps seconds after the beginning.

    lengths: number of pictures of each clip.
    Raises RunError for a clip with another number of pictures.
    """
    with av.open(
        str(path), "w", format="mp4", options={**_MUXED, "movflags": "+faststart"}
    ) as joined:
        stream = None
        before = 0
        for clip, length in zip(clips, lengths, strict=True):
            with av.open(io.BytesIO(clip), "r") as one:
                source = one.streams.video[0]
                assert source.time_base is not None
                if stream is None:
                    stream = joined.add_stream_from_template(source)
                    stream.time_base = source.time_base
                step = round(1 / (fps * source.time_base))
                packets = [packet for packet in one.demux(source) if packet.dts is not None]
                if [packet.pts for packet in packets] != [k * step for k in range(length)]:
                    raise RunError(
                        f"{path}: a clip has {len(packets)} pictures in place of {length}: "
                        f"collect it again"
                    )
                for number, packet in enumerate(packets, before):
                    packet.pts = packet.dts = number * step
                    packet.stream = stream
                    joined.mux(packet)
            before += length


def read_pictures(film_or_bytes: Path | bytes) -> Iterator[tuple[Fraction, NDArray[np.uint8]]]:
    """Yield the pictures of an .mp4 in order: the time in seconds, and RGB (H, W, 3)."""
    one = film_or_bytes
    with av.open(io.BytesIO(one) if isinstance(one, bytes) else str(one), "r") as film:
        stream = film.streams.video[0]
        stream.codec_context.thread_count = 1
        for frame in film.decode(stream):
            assert frame.pts is not None
            assert frame.time_base is not None
            yield (
                frame.pts * frame.time_base,
                _rgb_of(frame.to_ndarray().astype(np.uint8, copy=False)),
            )


_TO_YUV: Final = ((16829, 33039, 6416), (-9714, -19070, 28784), (28784, -24103, -4681))
"""Factors of red, green and blue in Y, U and V, in units of 1 / 65536."""
_TO_RGB: Final = ((76309, 0, 104597), (76309, -25675, -53279), (76309, 132201, 0))
"""Factors of Y, U and V in red, green and blue, in units of 1 / 65536."""
_BLACK: Final = (16, 128, 128)
"""YUV of black."""
_HALF: Final = 1 << 15
"""Half a unit of the result, added before the shift by 16 bits so that it rounds."""


def _mixed(channels: Sequence[NDArray[np.int32]], factors: Sequence[int]) -> NDArray[np.int32]:
    """Return the rounded sum of channels times factors in units of 1 / 65536; exact in 32 bits."""
    total = channels[0] * np.int32(factors[0])
    for channel, factor in zip(channels[1:], factors[1:], strict=True):
        if factor:
            total += channel * np.int32(factor)
    total += np.int32(_HALF)
    total >>= 16
    return total


def _planes_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert RGB (H, W, 3) to the planes (3 H / 2, W): luma, and below it both chroma planes of
    half the size."""
    high, wide, _ = rgb.shape
    small = cv2.resize(rgb, (wide // 2, high // 2), interpolation=cv2.INTER_AREA)
    planes = [
        _mixed(np.moveaxis(of, 2, 0).astype(np.int32), factors) + black
        for of, factors, black in zip((rgb, small, small), _TO_YUV, _BLACK, strict=True)
    ]
    return np.concatenate([one.ravel() for one in planes]).astype(np.uint8).reshape(-1, wide)


def _rgb_of(planes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert the planes of `_planes_of` to RGB (H, W, 3)."""
    high = planes.shape[0] * 2 // 3
    wide = planes.shape[1]
    colours = planes[high:].reshape(2, high // 2, wide // 2)
    large = [cv2.resize(one, (wide, high), interpolation=cv2.INTER_LINEAR) for one in colours]
    yuv = [
        one.astype(np.int32) - np.int32(black)
        for one, black in zip((planes[:high], *large), _BLACK, strict=True)
    ]
    rgb = np.empty((high, wide, 3), np.uint8)
    for k, factors in enumerate(_TO_RGB):
        rgb[:, :, k] = _mixed(yuv, factors).clip(0, 255)
    return rgb
