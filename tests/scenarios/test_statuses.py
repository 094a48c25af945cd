"""Whose failure it is when an episode about an event does not come to its event."""

from __future__ import annotations

import msgspec
import pytest

from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.results.event_monitor import Hidden
from cosim.results.record import Record
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import CrowdSpec, Scenario
from scenarios.episodes.run_episode import run_episode
from scenarios.episodes.scorer import Scorer
from scenarios.suites.catalog import load_suite


class Blind:
    """Always the same command."""

    manifest = Manifest("blind", camera=None)

    def __init__(self, v_mps: float, w_radps: float = 0.0) -> None:
        self.command = Command(v_mps, w_radps)

    def reset(self, scenario_id: str, seed: int) -> None:
        """It takes no notice."""

    def act(self, observation: Observation) -> Command:
        return self.command


def obstructing(limit_s: float) -> Scenario:
    """Without street life, and shorter."""
    (one,) = (s for s in load_suite("reactive").scenarios if s.id == "obstructing-001")
    return msgspec.structs.replace(
        one, crowd=CrowdSpec(persons=0, vehicles=0), time_limit_s=limit_s
    )


def outcome(record: Record) -> tuple[str, str | None, float | None, bool]:
    return (
        record.status,
        record.ended,
        record.measures["success"],
        record.events[0].triggered_at_s is not None,
    )


@pytest.mark.engine
def test_who_fails_before_the_event_has_failed() -> None:
    """Off the sidewalk at once, and standing until the time is up: both before the trigger, both
    scored."""
    far = obstructing(20.0)
    (event,) = far.events
    far = msgspec.structs.replace(
        far, events=(msgspec.structs.replace(event, route_s_m=event.route_s_m + 5.0),)
    )
    assert outcome(run_episode(far, Blind(1.5, 0.65)).record) == ("done", "failure", 0.0, False)
    assert outcome(run_episode(obstructing(2.0), Blind(0.0)).record) == (
        "done",
        "timeout",
        0.0,
        False,
    )


@pytest.mark.engine
def test_who_comes_by_an_event_that_nobody_could_see_has_done_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A goal reached without a failure, and something before the camera all the way: the simulator
    owes the event."""
    begin = Scorer.__init__

    def veiled(*given: object) -> None:
        *before, _, clock = given
        hides: Hidden = lambda eye, points: points[:, 0] > -1e9  # noqa: E731
        begin(*before, hides, clock)  # type: ignore[arg-type]

    monkeypatch.setattr(Scorer, "__init__", veiled)
    short = obstructing(20.0)
    near = msgspec.structs.replace(short, route=short.route[:6], goal=short.route[5])
    record = run_episode(near, Blind(1.5)).record
    assert outcome(record) == ("invalid", "goal", 1.0, True)
    assert record.reason == "nobody of event e0 (obstructing) could be seen"
