"""An episode compared with the same street without its robot, with the real engines."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import msgspec
import pandas as pd
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import RobotState, Street
from cosim.place.street_map import Port
from cosim.place.walk_graph import WalkGraph
from cosim.policies.load import load_policy
from cosim.results.delay import Tracks, delay_of
from cosim.results.record import Record
from cosim.results.run_folder import RunFolder
from cosim.spec.events import EventReply
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, CrowdSpec, Scenario, Suite, write_suite
from scenarios.episodes.run_episode import run_episode
from scenarios.episodes.wiring import crowd_of
from scenarios.ipc.messages import Done, EpisodeProgress, Hello, Message
from scenarios.places.nets import place
from scenarios.runs.local import LocalProcesses
from scenarios.runs.pool import run_all
from scenarios.suites.crossings import build_all
from sumo_nets.crowd.demand_log import Entrances
from tests.conftest import Cosim
from tests.run_specs import spec_of

pytestmark = pytest.mark.engine

SMALL = City(seed=5, size_m=500.0)
OPEN: frozenset[Port] = frozenset()
TICKS = 400


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Return a way over a crossing."""
    _, street_map = place(SMALL)
    return build_all(SMALL, street_map, WalkGraph(street_map), 3, 1)[0]


def streets(scenario: Scenario, robot: RobotState, absent: bool) -> tuple[list[Street], Entrances]:
    """Return twenty seconds around a robot at a fixed place, or without it."""
    with crowd_of(scenario) as crowd:
        return [
            crowd.step(robot, no_robot(tick), absent=absent) for tick in range(TICKS)
        ], crowd.entrances


def repeated_streets(scenario: Scenario, robot: RobotState, entrances: Entrances) -> list[Street]:
    """Return the same twenty seconds again without a robot, from recorded entrances."""
    with crowd_of(scenario, entrances) as crowd:
        return [crowd.step(robot, no_robot(tick), absent=True) for tick in range(TICKS)]


def no_robot(tick: int) -> EventReply:
    return EventReply(episode="t", tick=tick, states=(), actors=())


def test_a_street_without_a_robot_is_repeated_to_the_bit(scenario: Scenario) -> None:
    """Without a robot, the same people, groups and vehicles are at the same places in a second
    simulation."""
    robot = RobotState(Pose(*scenario.start))
    grouped = msgspec.structs.replace(scenario, crowd=CrowdSpec(groups=0.5))
    before, entrances = streets(grouped, robot, absent=True)
    for a, b in zip(before, repeated_streets(grouped, robot, entrances), strict=True):
        assert (a.people.ids, a.vehicles.ids) == (b.people.ids, b.vehicles.ids)
        assert (
            a.people.xy.tobytes() == b.people.xy.tobytes()
            and a.people.age.tobytes() == b.people.age.tobytes()
        )
        assert a.vehicles.xy.tobytes() == b.vehicles.xy.tobytes()


def test_everybody_near_the_robot_also_comes_without_it(scenario: Scenario) -> None:
    """A robot in the middle of a crossing delays vehicles, and all of them can be compared."""
    crossing = scenario.crossings[0]
    middle = scenario.route_line.at(0.5 * (crossing.enter_s_m + crossing.leave_s_m))
    busy = Scenario(
        **{f: getattr(scenario, f) for f in scenario.__struct_fields__}
        | {"crowd": CrowdSpec(vehicles=40)}
    )
    robot = RobotState(middle)
    with_it, entrances = streets(busy, robot, absent=False)
    without = repeated_streets(busy, robot, entrances)
    present, absent = Tracks(), Tracks()
    people, same_people = Tracks(), Tracks()
    for a, b in zip(with_it, without, strict=True):
        present.add(a.vehicles)
        absent.add(b.vehicles)
        people.add(a.people)
        same_people.add(b.people)
    at = [middle[:2]] * TICKS
    cars, walkers = delay_of(at, present, absent, 0.05), delay_of(at, people, same_people, 0.05)
    assert (cars.unmatched, walkers.unmatched) == (0, 0)
    assert cars.compared > 10 and walkers.compared > 30
    assert cars.delay_s > 5.0


def test_a_run_records_delays_only_on_request(
    scenario: Scenario, tmp_path: Path, cosim: Cosim
) -> None:
    """Rows and records of the requesting run have the delays, and nothing else differs from a run
    without them."""
    short = msgspec.structs.replace(scenario, time_limit_s=10.0)
    write_suite(Suite(name="one", version="1", scenarios=(short,)), tmp_path / "one.json")
    done = cosim(
        "run", "one.json", "--policy", "orca", "--out", "asked", "--counterfactual", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "against the same street without the robot" in done.stdout
    scored = cosim("score", "asked", cwd=tmp_path)
    assert (
        scored.returncode == 0
        and "not computed from trajectories: people_delay_s, people_compared," in scored.stdout
    )
    row = pd.read_csv(tmp_path / "asked" / "results.csv").iloc[0]
    plain = run_episode(short, load_policy("orca"), EpisodeOptions()).record
    asked = Record.load(tmp_path / "asked" / "episodes" / scenario.id / "record.json")
    names = ["people_delay_s", "people_compared", "vehicles_delay_s", "vehicles_compared"]
    assert asked.state_hash == plain.state_hash
    assert {n: v for n, v in asked.measures.items() if n not in names} == plain.measures
    assert (
        row["people_compared"] == asked.measures["people_compared"] and row["people_compared"] > 0
    )
    assert not set(names) & set(plain.measures)


def test_a_run_sends_progress_messages_while_it_compares(
    scenario: Scenario, tmp_path: Path
) -> None:
    """A counterfactual comparison sends five progress messages."""
    short = Suite(
        name="s", version="1", scenarios=(msgspec.structs.replace(scenario, time_limit_s=5.0),)
    )
    driver = load_policy("orca")
    manifest = driver.manifest
    spec = msgspec.structs.replace(spec_of(short, "orca"), counterfactual=True)
    messages: list[Message] = []
    with RunFolder.create(tmp_path / "run", spec, short) as folder:
        options = EpisodeOptions(camera="bullet", counterfactual=True)
        hello = Hello("orca", manifest, driver.source_hash)
        transport = LocalProcesses(folder.path / "logs")
        run_all(folder, short.scenarios, hello, transport, handle=messages.append, options=options)
    assert [type(message) for message in messages] == [EpisodeProgress] * 10 + [Done]
    assert [getattr(message, "compared", None) for message in messages[5:-1]] == [
        0.0,
        0.2,
        0.4,
        0.6,
        0.8,
    ]


def test_a_failed_comparison_does_not_fail_its_episode(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors in the street without the robot leave the episode done, and the record states the
    error."""

    def fails(*_: object) -> NoReturn:
        raise KeyError("v7")

    monkeypatch.setattr("scenarios.episodes.run_episode.CounterfactualTracker.compared", fails)
    short = msgspec.structs.replace(scenario, time_limit_s=1.0)
    outcome = run_episode(short, load_policy("orca"), EpisodeOptions(counterfactual=True))
    assert (
        outcome.record.status == "done" and outcome.log is not None and "fails" in outcome.traceback
    )
    assert outcome.record.reason == "the street without the robot: KeyError: 'v7'"
    assert "people_delay_s" not in outcome.record.measures
