"""Bounding boxes as command-line options."""

from __future__ import annotations

from cosim.core.errors import UsageError

_Box = tuple[float, float, float, float]


def parse_box(option: str, words: str, sides: str = "west,south,east,north") -> _Box:
    """Parse the four numbers of a bounding-box option.

    option: the option's name, for the error.
    words: the option's value.
    sides: the order of the numbers, for the error. Raises UsageError.
    """
    try:
        x0, y0, x1, y1 = (float(word) for word in words.split(","))
    except ValueError:
        raise UsageError(
            f"{option} takes four numbers with commas between them, not '{words}'"
        ) from None
    if not (x0 < x1 and y0 < y1):
        raise UsageError(f"{option} is {sides}: '{words}' is empty")
    return x0, y0, x1, y1


def check_overlap(option: str, part: _Box, bounds: _Box) -> None:
    """Raise UsageError with the bounds of the place when a box does not overlap them."""
    (x0, y0, x1, y1) = part
    (west, south, east, north) = bounds
    if x1 <= west or x0 >= east or y1 <= south or y0 >= north:
        ends = ",".join(f"{end:.0f}" for end in bounds)
        raise UsageError(
            f"{option} shows nothing of the place, which reaches over {ends}: give a part of that"
        )
