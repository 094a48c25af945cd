"""A box on a map, as the command line takes it."""

from __future__ import annotations

from cosim.core.errors import UsageError

_Box = tuple[float, float, float, float]


def box_of(option: str, words: str, sides: str = "west,south,east,north") -> _Box:
    """The four numbers in the words of an option. Raises UsageError naming the option and its
    `sides`."""
    try:
        x0, y0, x1, y1 = (float(word) for word in words.split(","))
    except ValueError:
        raise UsageError(
            f"{option} takes four numbers with commas between them, not '{words}'"
        ) from None
    if not (x0 < x1 and y0 < y1):
        raise UsageError(f"{option} is {sides}: '{words}' is empty")
    return x0, y0, x1, y1


def refuse_outside(option: str, part: _Box, bounds: _Box) -> None:
    """Raises UsageError, with the bounds of the place, when a part of it holds nothing of it."""
    (x0, y0, x1, y1) = part
    (west, south, east, north) = bounds
    if x1 <= west or x0 >= east or y1 <= south or y0 >= north:
        ends = ",".join(f"{end:.0f}" for end in bounds)
        raise UsageError(
            f"{option} shows nothing of the place, which reaches over {ends}: give a part of that"
        )
