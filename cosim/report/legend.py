"""Legend below a picture: coloured text cells, wrapped into lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb255 = tuple[int, int, int]
Image = NDArray[np.uint8]

LINE_PX: Final = 22
MARGIN_PX: Final = 8
GAP_PX: Final = 24
"""Gap between two cells of a line, pixels."""
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_SIZE: Final = 0.5


def legend(image: Image, cells: Sequence[tuple[str, Rgb255]]) -> Image:
    """Append a white band with text cells below an (H, W, 3) uint8 RGB picture.

    cells: text and colour

    Cells wrap to the next line; a cell wider than the picture breaks at blanks.
    """
    lines = _lines(cells, image.shape[1])
    band: Image = np.full(
        (LINE_PX * len(lines) + 2 * MARGIN_PX, image.shape[1], 3), 255, dtype=np.uint8
    )
    for row, line in enumerate(lines):
        x = MARGIN_PX
        y = MARGIN_PX + LINE_PX * row + 16
        for words, colour in line:
            cv2.putText(band, words, (x, y), _FONT, _SIZE, colour, 1, cv2.LINE_AA)
            x += text_width_px(words) + GAP_PX
    return np.concatenate([image, band])


def text_width_px(words: str, size: float = _SIZE) -> int:
    """Return the width of a line of text, pixels."""
    return int(cv2.getTextSize(words, _FONT, size, 1)[0][0])


def _lines(cells: Sequence[tuple[str, Rgb255]], width_px: int) -> list[list[tuple[str, Rgb255]]]:
    """Wrap cells into lines no wider than the picture, unless a single word is wider."""
    room = width_px - 2 * MARGIN_PX
    lines: list[list[tuple[str, Rgb255]]] = [[]]
    left = room
    for words, colour in cells:
        for piece in _pieces(words, room):
            needed = text_width_px(piece)
            if needed > left and lines[-1]:
                lines.append([])
                left = room
            lines[-1].append((piece, colour))
            left -= needed + GAP_PX
    return lines


def _pieces(words: str, room_px: int) -> list[str]:
    """Split a cell at blanks into pieces that fit into a line."""
    pieces = [""]
    for word in words.split():
        longer = f"{pieces[-1]} {word}".strip()
        if pieces[-1] and text_width_px(longer) > room_px:
            pieces.append(word)
        else:
            pieces[-1] = longer
    return pieces
