"""Turns and crosswalks of a route, and instructions that announce them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Polyline, wrap_angle
from cosim.spec.scenario import RouteCrossing

_ARM_M: Final = 6.0
"""Length of the route before and after a place whose angle is its turn, in metres."""
_BEND_RAD: Final = math.radians(35.0)
"""Angle from which a bend is an instruction."""
_TURN_RAD: Final = math.radians(60.0)
"""Angle from which an instruction says "turn" instead of "bear"."""
_ANNOUNCED_M: Final = 20.0
"""Distance from which instructions announce a turn, in metres."""
_DUE_M: Final = 2.5
"""Distance from which instructions say that a turn is due, in metres."""


class Manoeuvre(NamedTuple):
    """Part of the route with an instruction, as an interval of arc length."""

    s_m: float
    end_s_m: float
    words: str


def manoeuvres(route: Polyline, crossings: Sequence[RouteCrossing] = ()) -> tuple[Manoeuvre, ...]:
    """Return the turns and crosswalks of a route in order.

    Bends of less than 35 degrees within 12 m are ignored.

    >>> [(one.s_m, one.words) for one in manoeuvres(Polyline([(0, 0), (20, 0), (20, 20)]))]
    [(20.0, 'turn left')]
    """
    found = [
        Manoeuvre(one.enter_s_m, one.leave_s_m, "cross the street at the crosswalk")
        for one in crossings
    ]
    s_m = np.arange(1.0, route.length_m - 0.5)
    turns = np.array([_turn_at(route, s) for s in s_m.tolist()])
    bent = np.where(np.abs(turns) >= _BEND_RAD, np.sign(turns), 0.0)
    starts = np.flatnonzero(np.diff(bent, prepend=0.0))
    for first, last in zip(starts, [*starts, len(bent)][1:], strict=True):
        if bent[first]:
            peak = first + int(np.argmax(np.abs(turns[first:last])))
            how = "turn" if abs(turns[peak]) >= _TURN_RAD else "bear"
            side = "left" if turns[peak] > 0.0 else "right"
            found.append(Manoeuvre(float(s_m[peak]), float(s_m[peak]) + 1.0, f"{how} {side}"))
    return tuple(sorted(found))


def _turn_at(route: Polyline, s_m: float) -> float:
    """Return the angle of the route around a place, left positive, in radians."""
    before, here, behind = (route.at(s).xy for s in (s_m - _ARM_M, s_m, s_m + _ARM_M))
    (ax, ay) = (here - before).tolist()
    (bx, by) = (behind - here).tolist()
    return wrap_angle(math.atan2(by, bx) - math.atan2(ay, ax))


def instruction_at(route_s_m: float, steps: Sequence[Manoeuvre]) -> str:
    """Return the instruction at an arc length: due manoeuvres, then the next one within 20 m.

    Distances are rounded to 5 m.

    >>> ways = manoeuvres(Polyline([(0, 0), (40, 0), (40, 20)]))
    >>> instruction_at(29.0, ways), instruction_at(39.0, ways)
    ('Follow the sidewalk. In 10 m, turn left.', 'Turn left.')
    """
    due = [one.words for one in steps if one.s_m - _DUE_M <= route_s_m < one.end_s_m]
    sentences = [f"{words.capitalize()}." for words in due] or ["Follow the sidewalk."]
    coming = [one for one in steps if _DUE_M < one.s_m - route_s_m <= _ANNOUNCED_M]
    if coming:
        far_m = max(5 * round((coming[0].s_m - route_s_m) / 5.0), 5)
        sentences.append(f"In {far_m} m, {coming[0].words}.")
    return " ".join(sentences)
