"""EmptyStreet: without crowd and vehicles a street needs no SUMO and equals the one of SUMO."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from cosim.core.geometry import Pose
from cosim.core.state import PersonKind, RobotState, Street
from cosim.place.street_map import StreetMap
from cosim.spec.events import Actor, EventReply
from cosim.spec.scenario import City, CrowdSpec
from sumo_nets.city.store import city_net
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.demand_log import Entrances
from sumo_nets.crowd.empty_street import TICK_MS, EmptyStreet, needs_no_sumo
from sumo_nets.crowd.lights import Lights, PlannedLights, SumoLights
from sumo_nets.crowd.proxy import junction_of
from sumo_nets.engine import close, start, sumo
from sumo_nets.net.net_file import read_net

NOBODY = CrowdSpec(persons=0, vehicles=0)
BEGIN_S = 1234


@pytest.fixture(scope="module")
def net() -> Path:
    return city_net(City(seed=2, size_m=500.0))


@pytest.fixture(scope="module")
def street_map(net: Path) -> StreetMap:
    return read_net(net)


@contextmanager
def simulated(net: Path, begin_s: int = BEGIN_S) -> Iterator[None]:
    start(
        [
            "--net-file",
            str(net),
            "--begin",
            str(begin_s),
            "--step-length",
            "0.05",
            "--no-warnings",
            "true",
        ]
    )
    try:
        yield
    finally:
        close()


def count_differences(net: Path, street_map: StreetMap, ticks: int) -> int:
    """Return how often a crossing's signal differs from SUMO's, over a number of ticks."""
    differ = 0
    with simulated(net):
        simulating, planned = SumoLights(sumo, street_map), PlannedLights(street_map, BEGIN_S)
        assert sorted(planned.crossings) == sorted(simulating.crossings) and planned.crossings
        for _ in range(ticks):
            sumo.simulationStep()
            planned.now_ms += TICK_MS
            assert planned.now_s() == simulating.now_s()
            differ += sum(
                signal_state(planned, one) != signal_state(simulating, one)
                for one in planned.crossings
            )
    return differ


def signal_state(lights: Lights, crossing: str) -> tuple[bool, float | None, float]:
    walk, change_s, until_s = lights.showing(crossing)
    return walk, None if change_s is None else round(change_s - lights.now_s(), 3), until_s


def with_programs(net: Path, to: Path, program: Callable[[int, str], str]) -> Path:
    """Write a net with other signal programs. program: returns the new text for a number and the
    old text."""
    numbers = iter(range(10**6))
    to.write_text(
        re.sub(
            "<tlLogic.*?</tlLogic>",
            lambda m: program(next(numbers), m[0]),
            net.read_text(),
            flags=re.DOTALL,
        )
    )
    return to


@pytest.mark.engine
def test_fixed_time_signals_equal_those_of_sumo(
    net: Path, street_map: StreetMap, tmp_path: Path
) -> None:
    """At every tick of the longest cycle, every crossing of a city has the same state, end and
    change."""
    assert street_map.signals_fixed_time
    cycle_ms = max(
        sum(strip.plan.durations_ms) for strip in street_map.strips.values() if strip.plan
    )
    assert count_differences(net, street_map, cycle_ms // TICK_MS + 40) == 0

    # Phases that end between two seconds, cycles that begin before SUMO or long after, and one
    # phase that goes on.
    offsets = ("-7", "3.3", "100000", "-0.05", "0.35", "12.5")

    def odd(k: int, was: str) -> str:
        again = re.sub('offset="[^"]*"', f'offset="{offsets[k % len(offsets)]}"', was)
        again = re.sub(
            r'duration="(\d+)"',
            lambda m: f'duration="{int(m[1]) % 7 + 1}.{k % 7}{k % 2 * 5}"',
            again,
        )
        return (
            again
            if k % 6
            else re.sub(r"(<phase [^>]*>).*(?=</tlLogic>)", r"\1", again, flags=re.DOTALL)
        )

    other = with_programs(net, tmp_path / "odd.net.xml", odd)
    assert count_differences(other, read_net(other), 600) == 0


@pytest.mark.engine
def test_an_empty_street_equals_that_of_sumo(net: Path, street_map: StreetMap) -> None:
    """People, signals and times are equal to the bit at any place of the robot and with any
    actors."""
    crossings = [
        strip.line.mean(axis=0) for strip in street_map.strips.values() if strip.plan is not None
    ]
    places = [(x_m + 3.0, y_m) for x_m, y_m in crossings[:6]]

    def actors(tick: int) -> tuple[Actor, ...]:
        x_m, y_m = places[tick // 20]
        return tuple(
            Actor(
                id=f"e{i}",
                x_m=x_m + 0.06 * (tick % 20) + i,
                y_m=y_m,
                heading_rad=0.3 * i,
                speed_mps=1.2,
                doing="gesture" if i == 2 else "walk",
                kind=PersonKind.EVENT,
            )
            for i in range(tick % 50 // 10, -1, -1)
        )

    def streets(crowd: SumoCrowd | EmptyStreet) -> list[tuple[object, ...]]:
        with crowd:
            seen = [values(crowd.street)]
            for tick in range(20 * len(places)):
                robot = RobotState(Pose(*places[tick // 20], 0.1 * tick), 1.0)
                reply = EventReply(episode="", tick=tick, states=(), actors=actors(tick))
                seen.append(values(crowd.step(robot, reply)))
        return seen

    start_xy = (float(places[0][0]), float(places[0][1]))
    for seed in (3, 4):
        simulating = streets(SumoCrowd(net, street_map, NOBODY, seed, frozenset(), start_xy))
        assert streets(EmptyStreet(street_map, seed, start_xy)) == simulating
        assert len({signals for *_, signals in simulating}) > 20


def values(street: Street) -> tuple[object, ...]:
    """Return all values of a street in a form that can be compared to the bit."""
    columns = [
        np.asarray(getattr(group, name))
        for group in (street.people, street.vehicles)
        for name in group.__dataclass_fields__
    ]
    return (
        street.tick,
        *((str(column.dtype), column.shape, column.tobytes()) for column in columns),
        tuple(street.signals.items()),
    )


def test_people_vehicles_and_actuated_signals_need_sumo(
    net: Path, street_map: StreetMap, tmp_path: Path
) -> None:
    """Any crowd, recorded entrances, or a light without a plain fixed program need SUMO."""
    assert needs_no_sumo(street_map, NOBODY)
    assert needs_no_sumo(street_map, CrowdSpec(density=0.0, vehicles=0, residents=3))
    for spec in (
        CrowdSpec(persons=1, vehicles=0),
        CrowdSpec(persons=0, vehicles=1),
        CrowdSpec(density=1, vehicles=0),
    ):
        assert not needs_no_sumo(street_map, spec)
    entrances = Entrances()
    assert needs_no_sumo(street_map, NOBODY, entrances)
    entrances.vehicles[1.0].append("v0")
    assert not needs_no_sumo(street_map, NOBODY, entrances)

    unplain: tuple[Callable[[str], str], ...] = (
        lambda was: was.replace('type="static"', 'type="actuated"'),
        lambda was: was.replace("<phase ", '<phase next="0" ', 1),
        lambda was: was + was.replace('programID="0"', 'programID="1"'),
        lambda was: was.replace("<phase", '<param key="coordinated" value="true"/><phase', 1),
        lambda was: re.sub('offset="[^"]*"', 'offset="begin"', was),
        lambda was: re.sub('duration="[^"]*"', 'duration="9.33"', was, count=1),
        lambda was: re.sub('duration="[^"]*"', 'duration="0"', was, count=1),
        lambda was: re.sub('state="[^"]*"', 'state=""', was, count=1),
        lambda was: "",
    )
    changed: set[str] = set()

    def worse(k: int, was: str) -> str:
        if k >= len(unplain):
            return was
        changed.update(re.findall('tlLogic id="([^"]*)"', was))
        return unplain[k](was)

    other = read_net(with_programs(net, tmp_path / "other.net.xml", worse))
    assert not needs_no_sumo(other, NOBODY) and len(changed) == len(unplain)
    lit = [strip for strip in other.strips.values() if strip.signalised]
    assert {junction_of(strip.id) for strip in lit if strip.plan is None} == changed
    assert not {junction_of(strip.id) for strip in lit if strip.plan is not None} & changed

    timed = with_programs(
        net,
        tmp_path / "timed.net.xml",
        lambda k, was: was if k else f'{was}<WAUT id="w" startProg="0"/>',
    )
    assert not any(strip.plan for strip in read_net(timed).strips.values())
