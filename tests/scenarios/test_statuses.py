"""Ends of episodes: failures before and after an event, a skipped loop, and a pace."""

from __future__ import annotations

import math
from functools import partial

import msgspec
import numpy as np
import pytest

from cosim.core.clock import Clock, Pacer
from cosim.core.errors import UsageError
from cosim.core.geometry import Polyline
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.policies import POLICIES
from cosim.policies.load import load_policy
from cosim.report.page.reasons import mishaps_of, reason_of
from cosim.results.event_monitor import OcclusionTest
from cosim.results.record import Record
from cosim.results.rejudge import contradictions
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, CrowdSpec, Scenario
from scenarios.episodes import episode
from scenarios.episodes.run_episode import run_episode
from scenarios.episodes.scorer import Scorer
from scenarios.places.nets import place
from scenarios.suites.catalog import load_suite
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim


class Blind:
    """Gives the same command at every query."""

    manifest = Manifest("blind", camera=None)

    def __init__(self, v_mps: float, w_radps: float = 0.0) -> None:
        self.command = Command(v_mps, w_radps)

    def reset(self, scenario_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        return self.command


def obstructing(limit_s: float) -> Scenario:
    """Return a shorter event without street life."""
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
def test_a_failure_before_the_event_is_scored() -> None:
    """Leaving the sidewalk at once and standing until the timeout are scored as failures, though
    the event has not triggered."""
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
def test_an_event_whose_person_was_never_seen_is_not_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A goal that is reached without a failure, while the camera never saw the person nearby, is
    valid and not solved."""
    begin = Scorer.__init__

    def veiled(*given: object) -> None:
        *before, _, clock = given
        hides: OcclusionTest = lambda eye, points: points[:, 0] > -1e9  # noqa: E731
        begin(*before, hides, clock)  # type: ignore[arg-type]

    monkeypatch.setattr(Scorer, "__init__", veiled)
    short = obstructing(20.0)
    near = msgspec.structs.replace(short, route=short.route[:6], goal=short.route[5], obstacles=())
    record = run_episode(near, Blind(1.5)).record
    assert outcome(record) == ("done", "goal", 0.0, True)
    assert record.reason == "bypassed: nobody of event e0 (obstructing) was seen"
    (mishap,) = mishaps_of(record)
    assert mishap.cause == "bypassed the event"
    assert reason_of(near, record, mishap, None) == record.reason


@pytest.mark.engine
def test_an_event_that_cannot_trigger_makes_the_episode_invalid() -> None:
    """An event whose trigger lies beyond the goal is a fault of the scenario."""
    short = obstructing(20.0)
    (event,) = short.events
    beyond = msgspec.structs.replace(event, trigger_m=0.0, route_s_m=event.route_s_m + 20.0)
    near = msgspec.structs.replace(
        short, route=short.route[:6], goal=short.route[5], obstacles=(), events=(beyond,)
    )
    record = run_episode(near, Blind(1.5)).record
    assert (record.status, record.ended) == ("invalid", "goal")
    assert record.reason == "event e0 (obstructing) never triggered"


SMALL = City(seed=1, size_m=500.0)
OUT_M = 25.0
APART_M = 1.7


def there_and_back() -> Scenario:
    """Return a route 25 m along a wide sidewalk of a small city and back, 1.7 m beside, without
    people."""
    _, street_map = place(SMALL)
    widest = max(
        (s for s in street_map.strips.values() if s.length_m > 60.0), key=lambda s: s.width_m
    )
    middle = Polyline(widest.line)
    points = [middle.at(20.0 + s_m) for s_m in np.arange(0.0, OUT_M)]
    left, right = (
        [
            (p.x_m - side * math.sin(p.heading_rad), p.y_m + side * math.cos(p.heading_rad))
            for p in points
        ]
        for side in (APART_M / 2, -APART_M / 2)
    )
    route = Polyline(np.round([*right, *left[::-1]], 3))
    return msgspec.structs.replace(
        small_scenario(),
        place=msgspec.structs.replace(SMALL, net_hash=street_map.net_hash),
        start=tuple(route.at(0.0)),
        goal=tuple(route.points[-1].tolist()),
        route=tuple((x, y) for x, y in route.points.tolist()),
        crossings=(),
        barriers=(),
        obstacles=(),
        events=(),
        crowd=CrowdSpec(persons=0, vehicles=0),
        time_limit_s=20.0,
    )


@pytest.mark.engine
def test_a_robot_that_skips_the_loop_of_a_route_is_at_its_goal() -> None:
    """The oracle takes the shortest path, the episode ends at the goal, and the record agrees with
    the trajectory."""
    scenario = there_and_back()
    result = run_episode(scenario, POLICIES["orca"]())
    assert result.record.ended == "goal" and result.record.measures["route_completion"] == 1.0
    assert result.log.route_s_m[-1] < OUT_M
    assert not list(contradictions(result.record, scenario, result.log))


@pytest.mark.engine
def test_a_pace_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """At half of real time a second of an episode takes two, and has the same state hash as without
    a pace."""
    slept_s: list[float] = []
    monkeypatch.setattr(
        episode, "Pacer", partial(Pacer, clock=lambda: 100.0 + sum(slept_s), sleep=slept_s.append)
    )
    short = msgspec.structs.replace(small_scenario(), time_limit_s=1.0)
    unpaced = run_episode(short, load_policy("schedule:stand")).record
    assert not slept_s
    paced = run_episode(short, load_policy("schedule:stand"), EpisodeOptions(pace=0.5)).record
    assert sum(slept_s) == pytest.approx(2.0 * Clock().time_s(paced.ticks)) and paced.ticks >= 20
    assert paced.state_hash == unpaced.state_hash != ""
    assert msgspec.structs.replace(paced, clock={}) == msgspec.structs.replace(unpaced, clock={})


@pytest.mark.parametrize("pace", ["-1", "nan", "inf", "0.01", "1000"])
def test_an_invalid_pace_is_refused(pace: str, cosim: Cosim) -> None:
    """The command line and Python refuse it with its value and the valid range."""
    words = "pace must be from 0.1 to 100 times real time, or 0 for as fast as possible, not"
    with pytest.raises(UsageError, match=words):
        EpisodeOptions(pace=float(pace))
    refused = cosim("run", "reactive", "--policy", "stop", f"--pace={pace}")
    assert refused.returncode == 2 and f"{words} {pace}" in refused.stderr
