"""People in groups, elderly people and children."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats, Pose
from cosim.core.state import Age, RobotState, Street
from cosim.place.street_map import Strip
from cosim.spec.events import EventReply
from cosim.spec.scenario import City, CrowdSpec
from scenarios.suites.catalog import load_suite, with_crowd
from scenarios.tools.bench.crowd import widest_gaps
from sumo_nets.city.store import build_city
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.group_cohesion import GroupCohesion
from sumo_nets.crowd.group_sampling import PERSON_MPS, SLOWEST_GROUP_MPS, GroupDraws, PersonGroup
from sumo_nets.net.net_file import read_net

LINE = np.array([[0.0, 0.0], [50.0, 0.0]])
STRIPS = {
    "s": Strip("s", "sidewalk", LINE, 3.2, None, (None, None)),  # type: ignore[arg-type]
    "t": Strip("t", "sidewalk", LINE, 3.2, None, (None, None)),  # type: ignore[arg-type]
    ":c": Strip(":c", "crossing", LINE, 3.2, None, (None, None)),  # type: ignore[arg-type]
}


class Spot(NamedTuple):
    x_m: float
    y_m: float


class FakeSumo:
    """A SUMO stand-in with people who walk east: their places, and the speeds that they were
    given."""

    def __init__(self, **at: tuple[str, float, float]) -> None:
        self.at = dict(at)
        self.told: dict[str, float] = {}
        self.person = SimpleNamespace(
            getRoadID=lambda name: self.at[name][0],
            getLanePosition=lambda name: self.at[name][1],
            getSpeed=lambda name: 1.3,
            setSpeed=self.told.__setitem__,
            moveToXY=lambda name, edge, x, y, *_: self.at.update({name: (self.at[name][0], x, y)}),
        )
        self.lane = SimpleNamespace(
            getShape=lambda lane: LINE.tolist(), getLength=lambda lane: 50.0
        )

    def positions(self) -> dict[str, Any]:
        return {name: Spot(x, y) for name, (_, x, y) in self.at.items()}

    def advance(self, distance_m: float) -> None:
        self.at = {name: (edge, x + distance_m, y) for name, (edge, x, y) in self.at.items()}


def given_speeds(walkers: FakeSumo, updates: int = 2) -> dict[str, float]:
    """Return the speeds that a group at 1.3 m/s is given in some updates, half a second apart."""
    cohesion = GroupCohesion(walkers, STRIPS, 0.05)
    cohesion.form(tuple(walkers.at), 1.3, ("s",))
    for _ in range(updates):
        cohesion.update(walkers.positions())
        walkers.advance(0.65)
    return walkers.told


def test_shares_of_groups_elderly_and_children_are_as_requested() -> None:
    """Of many persons 40 % walk in groups, 10 % are elderly and 15 % children; each child has an
    adult, and is slow."""
    companies = GroupDraws(
        CrowdSpec(groups=0.4, elderly=0.1, children=0.15), np.random.default_rng(1)
    )
    drawn = []
    for _ in range(8000):
        drawn.append(companies.coming)
        companies.entered()
    persons = sum(group.size for group in drawn)
    ages = Counter(age for group in drawn for age in group.ages)
    assert sum(c.size for c in drawn if c.size > 1) / persons == pytest.approx(0.4, abs=0.02)
    assert ages[Age.ELDERLY] / persons == pytest.approx(0.1, abs=0.015)
    assert ages[Age.CHILD] / persons == pytest.approx(0.15, abs=0.015)
    assert {group.size for group in drawn} == {1, 2, 3}
    families = [group for group in drawn if Age.CHILD in group.ages]
    assert all(
        Age.ADULT in family.ages and family.pace_mps == SLOWEST_GROUP_MPS for family in families
    )
    assert all(c.pace_mps == PERSON_MPS for c in drawn if set(c.ages) == {Age.ADULT})


def test_a_plain_crowd_draws_no_groups() -> None:
    """It takes no numbers from the generator, everybody walks alone, and some look young or old."""
    rng = np.random.default_rng(1)
    companies = GroupDraws(CrowdSpec(), rng)
    ages: Counter[Age] = Counter()
    for _ in range(2000):
        (age,) = companies.coming.ages
        assert companies.coming.pace_mps == PERSON_MPS
        ages[age] += 1
        companies.entered()
    assert [ages[age] / 2000 for age in Age] == pytest.approx([0.78, 0.10, 0.12], abs=0.03)
    assert rng.random() == np.random.default_rng(1).random()


def test_a_group_walks_abreast_where_there_is_room() -> None:
    """Three walk side by side on 1.92 m, two and one on 1.3 m, and in file on 0.64 m, more slowly
    than one."""
    three = PersonGroup((Age.ADULT,) * 3)
    assert np.array(three.places(1.92)) == pytest.approx(
        np.array([(-0.64, 0.0), (0.0, 0.0), (0.64, 0.0)])
    )
    assert np.array(three.places(1.3)) == pytest.approx(
        np.array([(-0.32, 0.0), (0.32, 0.0), (0.0, 0.8)])
    )
    assert np.array(three.places(0.64)) == pytest.approx(
        np.array([(0.0, 0.0), (0.0, 0.8), (0.0, 1.6)])
    )
    assert three.speed_at(1.5) == pytest.approx(1.42) and three.speed_at(1.12) == 1.1


def test_group_members_adjust_their_speed() -> None:
    """The member ahead slows down and the one behind hurries, except on a crossing."""
    speeds = given_speeds(FakeSumo(c0=("s", 11.0, 0.0), c1=("s", 10.0, 0.64)))
    assert speeds["c0"] < 1.2 and 1.3 < speeds["c1"] < 1.44
    assert given_speeds(FakeSumo(c0=("s", 10.1, 0.0), c1=("s", 10.0, 0.64))) == {}
    assert "c0" not in given_speeds(FakeSumo(c0=(":c", 11.0, 0.0), c1=(":c", 10.0, 0.64)))


def test_a_member_far_ahead_waits() -> None:
    """Three metres ahead a member waits until the other is near, also if a light has separated
    them."""
    walkers = FakeSumo(c0=("s", 13.0, 0.0), c1=("s", 10.0, 0.64))
    cohesion = GroupCohesion(walkers, STRIPS, 0.05)
    cohesion.form(("c0", "c1"), 1.3, ("s", ":c", "t"))
    for _ in range(2):
        cohesion.update(walkers.positions())
        walkers.advance(0.65)
    assert walkers.told["c0"] == 0.0 and walkers.told["c1"] > 1.3
    walkers.at["c1"] = ("s", walkers.at["c0"][1] - 1.0, 0.64)
    cohesion.update(walkers.positions())
    assert walkers.told["c0"] > 1.0

    parted = FakeSumo(c0=("t", 11.0, 0.0), c1=("s", 10.0, 0.64))
    cohesion = GroupCohesion(parted, STRIPS, 0.05)
    cohesion.form(("c0", "c1"), 1.3, ("s", ":c", "t"))
    for _ in range(6):
        parted.at["c0"] = ("t", parted.at["c0"][1] + 0.65, 0.0)
        cohesion.update(parted.positions())
    assert parted.told["c0"] == 0.0 and parted.told["c1"] > 1.3


def test_a_member_walking_aside_steps_nearer_unless_blocked() -> None:
    """1.9 m beside the other it steps 0.34 m nearer, but not where another person approaches that
    place."""
    walkers = FakeSumo(c0=("s", 20.0, 0.0), c1=("s", 20.0, 1.92))
    given_speeds(walkers, updates=3)
    assert sorted(y for _, _, y in walkers.at.values()) in ([0.0, 1.58], [0.34, 1.92])
    walkers = FakeSumo(c0=("s", 20.0, 0.0), c1=("s", 20.0, 1.92))
    cohesion = GroupCohesion(walkers, STRIPS, 0.05)
    cohesion.form(("c0", "c1"), 1.3, ("s", ":c", "t"))
    for _ in range(3):
        cohesion.update({**walkers.positions(), "c9": Spot(walkers.at["c0"][1] + 3.0, 0.96)})
        walkers.advance(0.65)
    assert [y for _, _, y in walkers.at.values()] == [0.0, 1.92]


def test_members_who_leave_are_removed() -> None:
    """Of three one leaves, and two remain a group; the last one walks at its own speed. Two may
    leave at once."""
    walkers = FakeSumo(c0=("s", 11.0, 0.0), c1=("s", 10.0, 0.64), c2=("s", 10.0, 1.28))
    cohesion = GroupCohesion(walkers, STRIPS, 0.05)
    cohesion.form(("c0", "c1", "c2"), 1.3, ("s",))
    cohesion.form(("c3", "c4"), 1.2, ("s",))
    for _ in range(2):
        cohesion.update(walkers.positions())
        walkers.advance(0.65)
    assert walkers.told["c0"] < 1.3
    cohesion.remove_absent(["c0", "c1"])
    assert cohesion.groups == (("c0", "c1"),) and cohesion.group_of("c2") == ("c2",)
    cohesion.remove_absent(["c0"])
    assert cohesion.groups == () and walkers.told["c0"] == 1.3


def test_options_add_groups_to_a_suite() -> None:
    """`--groups 0.4` gives another version and hash, no option leaves the suite, and children need
    groups."""
    shipped = load_suite("reactive")
    grouped = with_crowd(shipped, groups=0.4, children=None)
    assert {scenario.crowd.groups for scenario in grouped.scenarios} == {0.4}
    assert (
        grouped.version == f"{shipped.version}-groups0.4"
        and grouped.content_hash != shipped.content_hash
    )
    assert with_crowd(shipped, groups=None) is shipped
    first = msgspec.structs.replace(shipped.scenarios[0], crowd=CrowdSpec(density=20.0))
    dense = with_crowd(msgspec.structs.replace(shipped, scenarios=(first,)), persons=12)
    assert (dense.scenarios[0].crowd.persons, dense.scenarios[0].crowd.density) == (12, None)
    with pytest.raises(SpecError, match=r"give groups of 0\.2 or more"):
        with_crowd(shipped, children=0.1)


@pytest.mark.engine
def test_groups_stay_together_on_the_street(tmp_path: Path) -> None:
    """For over a minute groups stay near and have the requested number, ages and paces, bit for bit
    again."""
    net = tmp_path / "city.net.xml"
    build_city(City(seed=2, size_m=600.0), net)
    street_map = read_net(net)
    x0, y0, x1, y1 = street_map.bounds
    start = Pose((x0 + x1) / 2, (y0 + y1) / 2, 0.0)
    spec = CrowdSpec(persons=50, vehicles=4, groups=0.5, elderly=0.1, children=0.15)

    def run(ticks: int) -> tuple[list[Street], list[tuple[tuple[str, ...], ...]]]:
        with SumoCrowd(net, street_map, spec, 3, frozenset(), start[:2]) as crowd:
            streets = [crowd.street]
            groups = [crowd.groups]
            for tick in range(ticks):
                reply = EventReply(episode="test", tick=tick, states=(), actors=())
                streets.append(crowd.step(RobotState(start), reply))
                groups.append(crowd.groups)
        return streets, groups

    def inside(street: Street) -> Floats:
        return np.asarray(np.hypot(*(street.people.xy - start[:2]).T) < spec.radius_m)

    streets, groups = run(1500)
    gaps_m = [gap for k in range(0, 1500, 10) for gap in widest_gaps(groups[k], streets[k].people)]
    assert len(gaps_m) > 1500
    assert np.median(gaps_m) < 1.0 and np.percentile(gaps_m, 95) < 2.0
    assert np.mean(np.array(gaps_m) > 2.0) < 0.05
    assert np.mean([inside(street).sum() for street in streets]) == pytest.approx(50, rel=0.05)

    ids = [name for street in streets[::100] for name in street.people.ids]
    ages = {
        name: age
        for street in streets
        for name, age in zip(street.people.ids, street.people.age, strict=True)
    }
    together = {name for now in groups for names in now for name in names}
    assert np.mean([name in together for name in ids]) == pytest.approx(0.5, abs=0.15)
    assert {ages[name] for name in ids} == {*Age}
    families = [{ages[name] for name in names if name in ages} for names in groups[0]]
    assert all(Age.ADULT in family for family in families if Age.CHILD in family)
    assert {name for name in ids if ages[name] == Age.CHILD} <= together
    walking = [(street.people.speed, street.people.age) for street in streets[::20]]
    speed, age = (np.concatenate(column) for column in zip(*walking, strict=True))
    pace = {one: np.median(speed[(age == one) & (speed > 0.5)]) for one in Age}
    assert (
        0.75 < pace[Age.CHILD] < 1.12 and 0.75 < pace[Age.ELDERLY] < 1.12 and pace[Age.ADULT] > 1.12
    )

    again, _ = run(200)
    for a, b in zip(streets, again, strict=False):
        assert a.people.ids == b.people.ids and a.people.xy.tobytes() == b.people.xy.tobytes()


@pytest.mark.engine
def test_a_group_is_removed_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Members of a stuck group leave the street in the same tick."""
    monkeypatch.setattr("sumo_nets.crowd.demand.STUCK_S", -1.0)
    net = tmp_path / "city.net.xml"
    build_city(City(seed=2, size_m=600.0), net)
    street_map = read_net(net)
    x0, y0, x1, y1 = street_map.bounds
    start = Pose((x0 + x1) / 2, (y0 + y1) / 2, 0.0)
    spec = CrowdSpec(persons=80, vehicles=10, groups=0.9)
    left = 0
    with SumoCrowd(net, street_map, spec, 3, frozenset(), start[:2]) as crowd:
        for tick in range(60):
            groups = crowd.groups
            before = set(crowd.street.people.ids)
            reply = EventReply(episode="test", tick=tick, states=(), actors=())
            after = set(crowd.step(RobotState(start), reply).people.ids)
            complete = [set(names) for names in groups if set(names) <= before]
            left += sum(not names & after for names in complete)
            assert tick % 10 or all(names <= after or not names & after for names in complete)
    assert left > 10
