"""Event pedestrians as pure state machines: (event, state, what the robot does) -> (state, pedestrians).

Definitions and triggers follow the paper's table of event-based behaviours; every constant that the paper leaves open
stands in the event's file with its unit. A further event is one more `Behavior` in `BEHAVIORS`.
"""

from scenarios.events.react import BEHAVIORS, behavior_of, react

__all__ = ["BEHAVIORS", "behavior_of", "react"]
