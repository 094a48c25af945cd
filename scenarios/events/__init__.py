"""Event pedestrians as pure state machines: (event, state, robot motion) -> (state, pedestrians).

Definitions and triggers follow the paper's table of event-based behaviours. Constants that the
paper leaves open are in the module of their event, with units. To add a kind of event, add a row to
`EVENT_KINDS`.
"""

from scenarios.events.react import EVENT_KINDS, react

__all__ = ["EVENT_KINDS", "react"]
