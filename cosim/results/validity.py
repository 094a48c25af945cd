"""Rules for the status of an episode whose event did not begin or was not seen.

They apply to scenarios that end on a failure, in episodes that reached the goal without a failure.
If the simulator owes the event (`TriggeredEvent.staged` is False), the episode is invalid. If the
robot alone bypassed the event, the episode counts as not solved. Otherwise a policy could leave
difficult episodes out of its own share.
"""

from __future__ import annotations

from cosim.results.record import Record, TriggeredEvent
from cosim.spec.events import Event
from cosim.spec.scenario import Scenario

BYPASSED = "bypassed: "
"""Start of the reason of an episode whose event the robot bypassed."""


def why_invalid(record: Record, scenario: Scenario) -> str:
    """Return why the simulator owes an event of an episode; "" if the episode is valid."""
    return _why_unseen(record, scenario, staged=False)


def why_bypassed(record: Record, scenario: Scenario) -> str:
    """Return how the robot bypassed an event; "" if it did not, or if the episode is invalid."""
    if why_invalid(record, scenario):
        return ""
    words = _why_unseen(record, scenario, staged=True)
    return f"{BYPASSED}{words}" if words else ""


def _why_unseen(record: Record, scenario: Scenario, staged: bool) -> str:
    """Return why events were not met, of those that were staged or of the others."""
    if not scenario.ends_on_failure or record.failures or record.ended not in ("goal", "stop"):
        return ""
    reasons = [
        why_unseen(event, outcome)
        for event, outcome in zip(scenario.events, record.events, strict=True)
        if outcome.staged is staged
    ]
    return "; ".join(filter(None, reasons))


def why_unseen(event: Event, outcome: TriggeredEvent) -> str:
    """Return why an event was not met, in words; "" if it began and was seen."""
    if outcome.triggered_at_s is None:
        return f"event {event.id} ({event.kind}) never triggered"
    return "" if outcome.seen else f"nobody of event {event.id} ({event.kind}) was seen"
