"""Event pedestrians as pure state machines: (event, state, what the robot does) -> (state,
pedestrians).

Definitions and triggers follow the paper's table of event-based behaviours; every constant that the
paper leaves open stands in the event's file with its unit. A further kind of event is one more row
of `EVENT_KINDS`.
"""

from scenarios.events.react import react
from scenarios.events.table import EVENT_KINDS

__all__ = ["EVENT_KINDS", "react"]
