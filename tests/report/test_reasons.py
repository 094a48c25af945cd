"""The reason of an episode's failure, in words."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from cosim.report.page.reasons import MetBody, Mishap, cause_of, mishaps_of, reason_of
from cosim.results.record import Record, TriggeredEvent
from cosim.results.referee import Failure
from cosim.spec.events import Event
from cosim.spec.scenario import Scenario
from tests.support.driven_runs import HIT, episode_of, failure_at, short_way

EVENT = Event(
    id="e0", kind="lateral", x_m=4.0, y_m=0.0, heading_rad=0.0, route_s_m=4.0, half_width_m=1.5
)
WAY = short_way("s-000", events=(EVENT,), structure="lateral")


def reason_of_failure(
    failure: Failure, other: MetBody | None = None, scenario: Scenario = WAY, **fields: object
) -> str:
    """Return the reason of an episode that ended with this failure."""
    record, log = episode_of(scenario, "h", HIT)
    record = msgspec.structs.replace(record, events=())
    record = msgspec.structs.replace(record, failures=(failure,), **fields)
    (mishap,) = mishaps_of(record)
    return reason_of(scenario, record, mishap, log, other)


def person(fault: str = "robot_at_fault", speed_mps: float = 1.2) -> Failure:
    return Failure("collision", 79, 4.0, 0.0, 4.0, speed_mps, "e0", "pedestrian", fault)  # type: ignore[arg-type]


def car(speed_mps: float = 1.2) -> Failure:
    return Failure("collision", 79, 4.0, 0.0, 4.0, speed_mps, "v0", "vehicle")


@pytest.mark.parametrize(
    ("failure", "other", "words"),
    [
        (
            person(),
            MetBody(0.6, 0.4, 0.0, -1.2),
            "drove into a person who came from the left at 1.2 m/s",
        ),
        (
            person(),
            MetBody(0.6, -0.4, 0.0, 0.8),
            "drove into a person who came from the right at 0.8 m/s",
        ),
        (
            person("shared"),
            MetBody(0.7, 0.0, -1.4, 0.1),
            "collided with a person who came from the front at 1.4 m/s",
        ),
        (
            person(),
            MetBody(0.7, 0.0, 0.6, 0.0),
            "drove into a person who went ahead of it at 0.6 m/s",
        ),
        (
            person(),
            MetBody(-0.7, 0.0, 1.6, 0.0),
            "collided with a person who came from behind at 1.6 m/s",
        ),
        (person(), MetBody(0.6, 0.1, 0.0, 0.0), "drove into a person who stood ahead, at 1.2 m/s"),
        (
            person(speed_mps=0.0),
            MetBody(0.0, 0.7, 0.0, -1.0),
            "was hit by a person who came from the left at 1.0 m/s",
        ),
        (
            person(speed_mps=0.0),
            MetBody(0.0, 0.7, 0.0, 0.1),
            "touched a person who stood to the left, both at rest",
        ),
        (
            person(speed_mps=0.0),
            MetBody(0.6, 0.0, 0.5, 0.0),
            "touched a person who went ahead of it at 0.5 m/s",
        ),
        (
            car(),
            MetBody(1.5, 0.0, 0.0, 5.0),
            "collided with a vehicle that came from the right at 5.0 m/s",
        ),
        (car(), MetBody(1.5, 0.0, 0.0, 0.0), "drove into a vehicle that stood ahead, at 1.2 m/s"),
        (
            car(0.0),
            MetBody(0.0, 2.0, 0.0, -5.0),
            "was hit by a vehicle that came from the left at 5.0 m/s",
        ),
        (car(), None, "ran into a vehicle at 1.2 m/s"),
        (car(0.0), None, "was touched by a vehicle where it stood"),
    ],
    ids=[
        "left",
        "right",
        "front",
        "ahead",
        "behind",
        "stood",
        "was hit",
        "both stood",
        "goes away",
        "vehicle",
        "parked vehicle",
        "hit by vehicle",
        "vehicle unseen",
        "vehicle unseen, stood",
    ],
)
def test_a_collision_describes_direction_and_speed_of_the_other(
    failure: Failure, other: MetBody | None, words: str
) -> None:
    """Sides are the robot's, with left at y > 0; a still person stood, and a slower one ahead
    walked ahead."""
    assert reason_of_failure(failure, other) == words


def test_a_collision_with_an_event_pedestrian_has_the_time_since_the_trigger() -> None:
    """With ticks of 0.05 s the end of tick 79 is 4.00 s, 3.1 s after a trigger at 0.90 s."""
    events = (
        TriggeredEvent(
            id="e0", kind="lateral", passed=False, triggered_at_s=0.9, trigger_distance_m=4.0
        ),
    )
    words = reason_of_failure(person(), MetBody(0.6, 0.4, 0.0, -1.2), events=events)
    assert words == "drove into a person who came from the left at 1.2 m/s, 3.1 s after the trigger"
    waiting = (TriggeredEvent(id="e0", kind="lateral", passed=False),)
    assert reason_of_failure(person(), MetBody(0.6, 0.4, 0.0, -1.2), events=waiting).endswith(
        ", before its event began"
    )


def test_the_tracks_of_an_event_give_the_direction_without_a_replay() -> None:
    """The robot heads east on x, and the event's person comes from the south at 1 m/s."""
    record, log = episode_of(WAY, "h", HIT)
    ticks = np.arange(60, 80)
    rows = np.column_stack(
        [ticks, 0 * ticks, 0 * ticks, 4.3 + 0.0 * ticks, 0.05 * (ticks - 79) - 0.5]
    )
    walked = msgspec.structs.replace(record, failures=(person(),), events=())
    log = type(log)(**{**vars(log), "event_tracks": rows})  # type: ignore[type-var]
    reason = reason_of(WAY, walked, mishaps_of(walked)[0], log)
    assert reason == "drove into a person who came from the right at 1.0 m/s"


def test_obstacles_lanes_and_freezing_have_reasons() -> None:
    """An obstacle has its name, a left lane its side of the route, and freezing its duration."""
    _, log = episode_of(WAY, "h", HIT)
    assert log is not None
    thing = Failure("collision", 79, 4.0, 0.0, 4.0, 1.0, "obstacle:0:bike", "object")
    assert reason_of_failure(thing) == "drove into a parked bike at 1.0 m/s"
    named = {
        "barrier::n13x9_c1:0": "a barrier",
        "prop:s612:3": "a piece of street furniture",
        "building:s380:1": "a wall",
    }
    for name, words in (named | {"obstacle:2:bin": "a bin"}).items():
        assert (
            reason_of_failure(Failure("collision", 79, 4.0, 0.0, 4.0, 1.0, name, "object"))
            == f"drove into {words} at 1.0 m/s"
        )
    off = Failure("out_of_lane", 79, 4.0, 1.5, 4.0, 1.0)
    assert (
        reason_of_failure(off)
        == "left the sidewalk on its left side at 1.0 m/s, 1.5 m off the route"
    )
    assert (
        reason_of_failure(failure_at(log, 79, "freezing"))
        == "stayed within 0.5 m for 10 s, the nearest person 1.5 m away"
    )


def test_episodes_that_failed_without_a_referee_failure_have_a_reason() -> None:
    """Reasons are the time limit, a passed stopping hand, a crossed group, and a crashed policy."""
    record, log = episode_of(WAY, "h", "goal")
    lost = msgspec.structs.replace(
        record, measures=record.measures | {"success": 0.0, "route_completion": 0.4}
    )
    ended = {
        "timeout": ("out of time", "ran out of time after 12 s, with 40 % of the route done"),
        "failure": ("broke the rule", "passed the person who held out a stopping hand"),
        "goal": (
            "broke the rule",
            "came to the goal, but went between people that it should have passed round",
        ),
    }
    for how, (cause, words) in ended.items():
        ended_record = msgspec.structs.replace(lost, ended=how)
        (mishap,) = mishaps_of(ended_record)
        assert (mishap.cause, reason_of(WAY, ended_record, mishap, log)) == (cause, words)
    crashed, _ = episode_of(WAY, "h", "crashed")
    assert reason_of(WAY, crashed, mishaps_of(crashed)[0], None) == "the policy crashed: it said so"


def test_successful_and_invalid_episodes_have_no_failure_reason() -> None:
    """Successful and invalid episodes have no moment of failure to explain."""
    found: list[list[Mishap]] = [
        mishaps_of(episode_of(WAY, "h", how)[0]) for how in ("goal", "invalid")
    ]
    assert found == [[], []]


def test_every_failure_has_a_cause() -> None:
    """The cause follows from its kind and from what was touched."""
    record: Record = episode_of(WAY, "h", HIT)[0]
    assert [cause_of(one) for one in (*record.failures, person())] == ["obstacle", "person"]
