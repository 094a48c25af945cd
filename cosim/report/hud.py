"""Layout and text overlays of a film: panels, figures, captions."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np

from cosim.report.legend import Image, Rgb255

INK: Final[Rgb255] = (245, 245, 245)
QUIET: Final[Rgb255] = (190, 196, 204)
GOOD: Final[Rgb255] = (120, 220, 140)
BAD: Final[Rgb255] = (255, 110, 90)
CAPTION_S: Final = 2.5
"""Time, seconds, that a caption is shown."""
_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_MARGIN_PX: Final = 16


class Area(NamedTuple):
    """Rectangle of the film in pixels: upper left corner, width, height."""

    x: int
    y: int
    width: int
    height: int


class Layout(NamedTuple):
    """Areas of a film: main view, second view (4:3) above the map on its right, bar below."""

    view: Area
    second: Area
    map: Area
    bar: Area

    @classmethod
    def of(cls, width: int, height: int) -> Layout:
        """Build the layout for a film size, without overlaps."""
        bar_px = max(22, height * 44 // 720)
        tall = height - bar_px
        column = min(width * 3 // 10, tall * 4 // 7) // 4 * 4
        left = width - column
        upper = column * 3 // 4
        return cls(
            view=Area(0, 0, left, tall),
            second=Area(left, 0, column, upper),
            map=Area(left, upper, column, tall - upper),
            bar=Area(0, tall, width, bar_px),
        )


def fill(image: Image, area: Area, picture: Image, title: str = "") -> None:
    """Copy a picture of the area's size into it, with a title along its upper edge."""
    image[area.y : area.y + area.height, area.x : area.x + area.width] = picture
    if area.x:
        image[area.y : area.y + area.height, area.x : area.x + 2] = 250
    if area.y:
        image[area.y : area.y + 2, area.x : area.x + area.width] = 250
    if title:
        size = max(0.33, 0.45 * len(image) / 720)
        height = cv2.getTextSize(title, _FONT, size, 1)[0][1]
        shade(image, (area.x, area.y, area.x + area.width, area.y + height + 12))
        words(image, title, (area.x + 7, area.y + height + 6), size, QUIET)


def shade(image: Image, area: tuple[int, int, int, int], strength: float = 0.6) -> None:
    """Darken the area x0, y0, x1, y1 so that text is readable."""
    x0, y0, x1, y1 = area
    image[y0:y1, x0:x1] = (image[y0:y1, x0:x1] * (1.0 - strength)).astype(np.uint8)


def words(image: Image, text: str, at: tuple[int, int], size: float, colour: Rgb255 = INK) -> None:
    """Draw one line of text.

    at: x, y of its lower left corner.
    """
    cv2.putText(image, text, at, _FONT, size, colour, 1, cv2.LINE_AA)


def bar(image: Image, area: Area, left: str, right: str, share: float) -> None:
    """Draw the bar at the lower edge: two texts and the share of the route done."""
    line_px = max(2, area.height // 10)
    image[area.y :] = (18, 20, 26)
    image[area.y : area.y + line_px] = 60
    image[area.y : area.y + line_px, : round(area.width * min(max(share, 0.0), 1.0))] = (
        60,
        150,
        250,
    )
    unit_width = sum(cv2.getTextSize(text, _FONT, 1.0, 1)[0][0] for text in (left, right))
    size = min(max(0.4, 0.0125 * area.height), (area.width - 3 * _MARGIN_PX) / unit_width)
    width, height = cv2.getTextSize(right, _FONT, size, 1)[0]
    y = area.y + line_px + (area.height - line_px + height) // 2
    words(image, left, (_MARGIN_PX, y), size)
    words(image, right, (area.width - _MARGIN_PX - width, y), size)


def caption(image: Image, area: Area, text: str, colour: Rgb255) -> None:
    """Draw a line of text at the upper middle of an area."""
    size = max(0.5, 0.9 * area.height / 676)
    width, height = cv2.getTextSize(text, _FONT, size, 1)[0]
    x = area.x + (area.width - width) // 2
    y = area.y + height
    edge = height * 2 // 3
    shade(image, (max(x - edge, 0), y - edge, x + width + edge, y + height + edge), 0.65)
    words(image, text, (x, y + height), size, colour)
