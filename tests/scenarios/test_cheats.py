"""Policies that exploit the rules, on shipped scenarios."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import cosim
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import ROBOTS, Legs
from cosim.spec.scenario import Suite, write_suite
from scenarios.events import EVENT_KINDS
from scenarios.suites.catalog import load_suite
from tests.conftest import Cosim
from tests.support import cheats
from tests.support.event_ways import event_way

KINDS = tuple(EVENT_KINDS)
NAMES = tuple(name for name in cheats.CHEATS if name != "Quitter")

HARDEST = {"StopAndGo": ("lateral", "overtaking")}
"""People who cross or cut in adapt to the robot's speed, so periodic stops could work best there."""


def scenarios_of(kinds: tuple[str, ...], each: int) -> list[str]:
    """Return the first shipped scenarios of these events."""
    shipped = [s for s in load_suite("reactive").scenarios if s.events]
    return [s.id for kind in kinds for s in [s for s in shipped if s.events[0].kind == kind][:each]]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Take one crawling speed by default, all with --whole."""
    if "cheat" in metafunc.fixturenames:
        whole = metafunc.config.getoption("--whole")
        crawls = [name for name in NAMES if name.startswith("Crawl")]
        left_out = () if whole else crawls[1:]
        metafunc.parametrize("cheat", [name for name in NAMES if name not in left_out])


@pytest.mark.engine
def test_a_cheat_solves_no_event(cheat: str, request: pytest.FixtureRequest) -> None:
    """Each cheat fails on one kind of event, and each kind has one cheat (all pairs with --whole).
    No episode is left out of the table."""
    whole = request.config.getoption("--whole")
    number = NAMES.index(cheat)
    kinds = KINDS if whole else HARDEST.get(cheat, (KINDS[number % 8],))
    table = cosim.run(
        "reactive", getattr(cheats, cheat)(), scenarios=scenarios_of(kinds, 3 if whole else 1)
    )
    assert set(table["status"]) == {"done"} and table["success"].sum() == 0.0


@pytest.mark.engine
def test_a_policy_that_ends_its_process_has_failed(tmp_path: Path, cosim: Cosim) -> None:
    """The episode has failed without contacts and progress, and the run has no rates and exit code
    1. A resumed run does not repeat the episode, and says how to do so."""
    way = event_way("obstructing", "one", at_m=11.0)
    suite = Suite(name="one", version="1", scenarios=(way,))
    write_suite(suite, tmp_path / "one.json")
    words = ("run", "one.json", "--policy", "tests.support.cheats:Quitter", "--out", "r")
    ran = cosim(*words, cwd=tmp_path)
    table = pd.read_csv(tmp_path / "r" / "results.csv")
    assert ran.returncode == 1 and table["status"].tolist() == ["crashed"], ran.stderr
    assert not table[["success", "spl", "route_completion"]].iloc[0].any()
    assert table[["pedestrian_collision", "left_lane"]].isna().all(axis=None)
    assert "no rates: 1 crashed" in " ".join(ran.stdout.split())
    again = cosim(*words, "--resume", cwd=tmp_path)
    assert again.returncode == 1
    assert "1 of them crashed, which is a result: --resume does not repeat them" in again.stderr
    assert f"another run with --scenario {way.id} and another --out" in again.stderr


@pytest.mark.engine
@pytest.mark.parametrize("robot", [name for name in ROBOTS if isinstance(ROBOTS[name].drive, Legs)])
def test_cheats_solve_no_event_on_legs(robot: str, request: pytest.FixtureRequest) -> None:
    """Walking straight ahead and standing solve no event with a robot on legs."""
    if robot == "walker":
        request.getfixturevalue("walker_weights")
    options = EpisodeOptions(seed=0, robot=robot)
    for policy, places_m, time_s in (
        ("straight", {"obstructing": 11.0, "gesturing": 11.0}, 45.0),
        ("stop", {"frontal": 21.0}, 10.0),
    ):
        ways = [
            event_way(kind, kind, at_m=at_m, length_m=at_m + 9.0, time_s=time_s)
            for kind, at_m in places_m.items()
        ]
        suite = Suite(name="legs", version="1", scenarios=tuple(ways))
        table = cosim.run(suite, policy, options=options)
        assert set(table["status"]) == {"done"} and table["success"].sum() == 0.0
