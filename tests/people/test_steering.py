"""Steering of a walking person round others."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest

from cosim.people.orca import HalfPlane
from cosim.people.steering import Neighbour, Vector, steered

TICK_S = 0.05
TALKERS = [(0.71 * math.cos(k * math.pi / 2), 0.71 * math.sin(k * math.pi / 2)) for k in range(4)]
QUEUE = [(0.0, 1.7 - 0.65 * k) for k in range(4)]


def walk(
    starts: Sequence[Vector],
    goals: Sequence[Vector],
    *,
    others: Sequence[Neighbour] = (),
    speed_mps: float = 1.3,
    walls: bool = False,
) -> tuple[list[list[Vector]], float]:
    """Return (paths, least distance in metres) of people who walk to goals for 15 s among others
    who ignore them."""
    at = list(starts)
    moving = [(0.0, 0.0)] * len(starts)
    paths = [[xy] for xy in starts]
    least_m = math.inf
    for tick in range(300):
        here = [
            Neighbour(
                o.x_m + o.vx_mps * tick * TICK_S,
                o.y_m + o.vy_mps * tick * TICK_S,
                o.vx_mps,
                o.vy_mps,
            )
            for o in others
        ]
        after = []
        for i, (xy, goal) in enumerate(zip(at, goals, strict=True)):
            far_m = math.dist(xy, goal)
            pace = min(speed_mps, far_m / TICK_S)
            wanted = (
                (pace * (goal[0] - xy[0]) / far_m, pace * (goal[1] - xy[1]) / far_m)
                if far_m > 1e-9
                else (0.0, 0.0)
            )
            fellows = [Neighbour(*at[j], *moving[j], 0.5) for j in range(len(at)) if j != i]
            edges = (
                [HalfPlane(0.0, -1.0, xy[1] - 2.0), HalfPlane(0.0, 1.0, -2.0 - xy[1])]
                if walls
                else []
            )
            until_s = min(2.0, far_m / max(pace, 1e-9))
            after.append(
                steered(xy, moving[i], wanted, here + fellows, horizon_s=until_s, walls=edges)
            )
            if far_m > 1e-9:
                everybody = [*((o.x_m, o.y_m) for o in here), *((f.x_m, f.y_m) for f in fellows)]
                least_m = min(least_m, *(math.dist(xy, other) for other in everybody))
        moving = after
        at = [
            (x + vx * TICK_S, y + vy * TICK_S) for (x, y), (vx, vy) in zip(at, moving, strict=True)
        ]
        for path, xy in zip(paths, at, strict=True):
            path.append(xy)
    return paths, least_m


def test_a_person_alone_walks_exactly_as_wanted() -> None:
    """A person who meets no one walks as wanted, to the bit."""
    wanted = (1.1 / 3.0, -0.7 / 3.0)
    assert steered((3.3, 4.7), (0.0, 0.0), wanted, []) == wanted
    beside = [
        Neighbour(3.3 + 1.4, 4.7 + 2.2),
        Neighbour(3.3 - 0.6, 4.7 + 0.2),
        Neighbour(12.0, 0.0),
    ]
    leaving = [Neighbour(3.3 + 1.5, 4.7 - 1.0, 1.2, -0.8)]
    assert steered((3.3, 4.7), wanted, wanted, beside + leaving) == wanted


def test_a_person_who_wants_to_stand_stays() -> None:
    """A person who wants to stand stays in place when others approach."""
    assert steered((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), [Neighbour(0.4, 0.0, -1.0, 0.0)]) == (
        0.0,
        0.0,
    )


@pytest.mark.parametrize(
    "standing", [[(0.0, 0.0)], TALKERS, QUEUE], ids=["one", "talkers", "queue"]
)
@pytest.mark.parametrize("start_m", [-6.0, -1.5])
def test_a_group_in_the_way_is_passed_as_a_whole(standing: list[Vector], start_m: float) -> None:
    """From far and near the person never walks between them, and arrives only a few seconds later."""
    (path,), least_m = walk(
        [(start_m, 0.2)], [(6.0, 0.2)], others=[Neighbour(*xy) for xy in standing]
    )
    assert least_m > 0.55
    assert path[-1] == pytest.approx((6.0, 0.2))
    abreast = min(path, key=lambda xy: abs(xy[0]))
    assert (
        abreast[1] > max(y for _, y in standing) + 0.4
        or abreast[1] < min(y for _, y in standing) - 0.4
    )
    late_s = TICK_S * sum(math.dist(xy, (6.0, 0.2)) > 1e-3 for xy in path) - (6.0 - start_m) / 1.3
    assert late_s < 2.5


@pytest.mark.parametrize("angle_deg", [180.0, 90.0, -90.0, 130.0, 40.0])
def test_two_people_pass_each_other_and_arrive(angle_deg: float) -> None:
    """They arrive after meeting head-on, at right angles in perfect symmetry, and obliquely."""
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    paths, least_m = walk(
        [(-6.0, 0.0), (-6.0 * cos, -6.0 * sin)], [(6.0, 0.0), (6.0 * cos, 6.0 * sin)]
    )
    assert least_m > 0.55
    assert paths[0][-1] == pytest.approx((6.0, 0.0)) and paths[1][-1] == pytest.approx(
        (6.0 * cos, 6.0 * sin)
    )


def test_a_person_passes_streams_that_ignore_it() -> None:
    """A person arrives through oncoming people and across people from the side, who all ignore it."""
    oncoming = [Neighbour(6.0 + 2.0 * k, 0.7 * (k % 3 - 1), -1.2, 0.0) for k in range(5)]
    for others in (oncoming, [Neighbour(0.0, -6.0, 0.0, 1.3), Neighbour(1.0, 5.0, 0.0, -1.2)]):
        (path,), least_m = walk([(-6.0, 0.0)], [(30.0, 0.0)], others=others)
        assert least_m > 0.5
        assert path[-1][0] > 9.0


def test_people_stay_on_the_ground_and_below_their_speed() -> None:
    """Between walls they pass standing people on the open side."""
    (path,), least_m = walk(
        [(-6.0, 0.2)], [(6.0, 0.2)], others=[Neighbour(*xy) for xy in QUEUE], walls=True
    )
    assert max(abs(y) for _, y in path) < 2.0 + 1e-9 and least_m > 0.55
    assert max(math.dist(a, b) for a, b in itertools.pairwise(path)) < 1.3 * TICK_S + 1e-9
    assert path[-1] == pytest.approx((6.0, 0.2))
