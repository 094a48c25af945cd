"""What is written over a film: panels, figures, captions of events and failures."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from cosim.report.above import Colour, Image

INK: Final[Colour] = (245, 245, 245)
QUIET: Final[Colour] = (190, 196, 204)
GOOD: Final[Colour] = (120, 220, 140)
BAD: Final[Colour] = (255, 110, 90)
CAPTION_S: Final = 2.5
"""How long a caption stays."""
_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_MARGIN_PX: Final = 16


def inset(image: Image, picture: Image, corner: tuple[int, int], title: str = "") -> None:
    """Lay a picture over the film at its top left corner (x, y), framed, with a title over its upper edge."""
    x, y = corner
    height, width = picture.shape[:2]
    image[y - 2 : y + height + 2, x - 2 : x + width + 2] = 250
    image[y : y + height, x : x + width] = picture
    if title:
        shade(image, (x, y, x + width, y + 22))
        words(image, title, (x + 7, y + 16), 0.45, QUIET)


def shade(image: Image, area: tuple[int, int, int, int], strength: float = 0.6) -> None:
    """Darken x0, y0, x1, y1, so that words can be read there."""
    x0, y0, x1, y1 = area
    image[y0:y1, x0:x1] = (image[y0:y1, x0:x1] * (1.0 - strength)).astype(np.uint8)


def words(image: Image, text: str, at: tuple[int, int], size: float, colour: Colour = INK) -> None:
    """One line of text; at: x, y of its lower left."""
    cv2.putText(image, text, at, _FONT, size, colour, 1, cv2.LINE_AA)


def bar(image: Image, left: str, right: str, share: float) -> None:
    """The bar along the lower edge: what runs, its figures, and how much of the way is done."""
    height, width = image.shape[:2]
    shade(image, (0, height - 40, width, height))
    words(image, left, (_MARGIN_PX, height - 14), 0.55)
    long = cv2.getTextSize(right, _FONT, 0.55, 1)[0][0]
    words(image, right, (width - _MARGIN_PX - long, height - 14), 0.55)
    image[height - 44 : height - 40, :] = 60
    image[height - 44 : height - 40, : round(width * min(max(share, 0.0), 1.0))] = (60, 150, 250)


def caption(image: Image, text: str, colour: Colour) -> None:
    """A line in the upper middle."""
    width = image.shape[1]
    long, tall = cv2.getTextSize(text, _FONT, 0.9, 1)[0]
    x = (width - long) // 2
    shade(image, (x - 18, 22, x + long + 18, 22 + tall + 26), 0.65)
    words(image, text, (x, 22 + tall + 12), 0.9, colour)
