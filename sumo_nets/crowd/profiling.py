"""For the bench: how much of the crowd's time is SUMO's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import libsumo

_Timed = Callable[[str, Callable[..., Any]], Callable[..., Any]]


def put_crowd_stopwatch(timed: _Timed) -> None:
    """Replace SUMO's step by a timed one, for the rest of this process."""
    libsumo.simulationStep = timed("crowd", libsumo.simulationStep)
