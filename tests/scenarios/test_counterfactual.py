"""An episode beside the same street without its robot, with the real engines."""

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
    """A way over a crossing."""
    _, street_map = place(SMALL)
    return build_all(SMALL, street_map, WalkGraph(street_map), 3, 1)[0]


def streets(scenario: Scenario, robot: RobotState, absent: bool) -> tuple[list[Street], Entrances]:
    """Twenty seconds around a robot that stands, or does not, where it is put."""
    with crowd_of(scenario) as crowd:
        return [
            crowd.step(robot, nobody(tick), absent=absent) for tick in range(TICKS)
        ], crowd.entrances


def once_more(scenario: Scenario, robot: RobotState, entrances: Entrances) -> list[Street]:
    with crowd_of(scenario, entrances) as crowd:
        return [crowd.step(robot, nobody(tick), absent=True) for tick in range(TICKS)]


def nobody(tick: int) -> EventReply:
    return EventReply(episode="t", tick=tick, states=(), actors=())


def test_a_street_without_a_robot_is_itself_when_it_is_simulated_again(scenario: Scenario) -> None:
    """Nobody is there either time: the same people, groups too, and vehicles at the same places, to
    the last bit."""
    robot = RobotState(Pose(*scenario.start))
    grouped = msgspec.structs.replace(scenario, crowd=CrowdSpec(groups=0.5))
    before, entrances = streets(grouped, robot, absent=True)
    for a, b in zip(before, once_more(grouped, robot, entrances), strict=True):
        assert (a.people.ids, a.vehicles.ids) == (b.people.ids, b.vehicles.ids)
        assert (
            a.people.xy.tobytes() == b.people.xy.tobytes()
            and a.people.age.tobytes() == b.people.age.tobytes()
        )
        assert a.vehicles.xy.tobytes() == b.vehicles.xy.tobytes()


def test_everybody_who_came_to_the_robot_comes_without_it_too(scenario: Scenario) -> None:
    """Around a robot that stands in the middle of a crossing vehicles are held up, and all can be
    compared."""
    crossing = scenario.crossings[0]
    middle = scenario.route_line.at(0.5 * (crossing.enter_s_m + crossing.leave_s_m))
    busy = Scenario(
        **{f: getattr(scenario, f) for f in scenario.__struct_fields__}
        | {"crowd": CrowdSpec(vehicles=40)}
    )
    robot = RobotState(middle)
    with_it, entrances = streets(busy, robot, absent=False)
    without = once_more(busy, robot, entrances)
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


def test_a_run_says_whom_its_robot_delayed_only_when_asked(
    scenario: Scenario, tmp_path: Path, cosim: Cosim
) -> None:
    """The delays are in row and record of the run that asked; nothing else differs from the run
    that did not."""
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


def test_a_run_gives_signs_of_life_while_it_compares(scenario: Scenario, tmp_path: Path) -> None:
    """A counterfactual comparison sends five progress messages."""
    short = Suite(
        name="s", version="1", scenarios=(msgspec.structs.replace(scenario, time_limit_s=5.0),)
    )
    driver = load_policy("orca")
    manifest = driver.manifest
    spec = msgspec.structs.replace(spec_of(short, "orca"), counterfactual=True)
    told: list[Message] = []
    with RunFolder.create(tmp_path / "run", spec, short) as folder:
        options = EpisodeOptions(camera="bullet", counterfactual=True)
        hello = Hello("orca", manifest, driver.source_hash)
        transport = LocalProcesses(folder.path / "logs")
        run_all(folder, short.scenarios, hello, transport, handle=told.append, options=options)
    assert [type(message) for message in told] == [EpisodeProgress] * 10 + [Done]
    assert [getattr(message, "compared", None) for message in told[5:-1]] == [
        0.0,
        0.2,
        0.4,
        0.6,
        0.8,
    ]


def test_an_episode_outlives_its_comparison(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever goes wrong in the street without the robot: the episode is done, and the record says
    what it was."""

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
