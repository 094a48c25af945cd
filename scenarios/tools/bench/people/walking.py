"""People on the streets of `streets`: as a `SumoCrowd` moves and shows them everywhere, only put
there by a list."""

from __future__ import annotations

import math
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from cosim.core.geometry import Floats, Pose, heading_to_sumo
from cosim.core.state import RobotState, Street
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventReply
from cosim.spec.scenario import CrowdSpec
from scenarios.episodes.wiring import sumo_crowd
from scenarios.tools.bench.people.measures import FRAMES_HZ
from scenarios.tools.bench.people.streets import SIDEWALK_WIDTH_M, BlockRing, OpenCrosswalk
from sumo_nets.crowd.demand import VEHICLE_TYPES
from sumo_nets.crowd.demand_log import Entrances, PersonEntry, VehicleEntry
from sumo_nets.crowd.empty_street import TICK_MS, start_of
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M, GroupDraws

_SETTLE_S: Final = 20.0
"""So long people walk before they are looked at."""

_VEHICLE_EVERY_S = 10.0
_PERSON_EVERY_S = 10.0
"""Of each direction, on the mean, at the crossing."""

_ROW_M: Final = 0.48
"""People are put there in rows, one behind the other: SUMO's jams are hardly denser."""

_ROUNDS: Final = 60
_RADIUS_M: Final = 200.0
_ROLL_S: Final = 0.5
"""People and vehicles come in every half second."""

_WALK_UP_M: Final = 15.0
_LOOK_M: Final = 12.0
"""Vehicles are looked at so near to the crossing."""


class Flow(NamedTuple):
    """People on the ring: persons per m2, whether they walk both ways round, the share who walk in
    groups."""

    density: float
    both_ways: bool
    groups: float = 0.0


def walk_round(
    flow: Flow, seconds: float, seed: int, settle_s: float = _SETTLE_S
) -> tuple[BlockRing, pd.DataFrame]:
    """Let people walk round the block. Returns it and their tracks, FRAMES_HZ frames a second: id,
    frame, x, y."""
    with tempfile.TemporaryDirectory() as folder:
        ring = BlockRing(Path(folder))
        entrances = _round_the_block(ring, flow, seed)
        every = round(1000 / TICK_MS / FRAMES_HZ)
        first = round(settle_s * 1000 / TICK_MS)
        frames = []
        for k, now in enumerate(
            _streets(ring.net, ring.street_map, ring.middle, entrances, seed, settle_s + seconds)
        ):
            if k >= first and k % every == 0:
                names = [int(name[1:]) for name in now.people.ids]
                frames.append(
                    np.column_stack([names, np.full(len(names), k // every), now.people.xy])
                )
    tracks = pd.DataFrame(np.concatenate(frames), columns=["id", "frame", "x", "y"])
    return ring, tracks.astype({"id": int, "frame": int})


def _round_the_block(ring: BlockRing, flow: Flow, seed: int) -> Entrances:
    """Everybody sets out at once, at places drawn at random; groups, ages and speeds as in every
    crowd."""
    rng = np.random.default_rng(seed)
    draws = GroupDraws(CrowdSpec(groups=flow.groups), rng.spawn(1)[0])
    lines = [ring.line(side) for side in ring.sides]
    stripes = round(SIDEWALK_WIDTH_M / GROUP_STRIPE_M)
    wanted = round(flow.density * ring.area_m2)
    cells = [
        (side, float(at_m), stripe)
        for side, (start, end) in enumerate(lines)
        for at_m in np.arange(_ROW_M, float(np.linalg.norm(end - start)), _ROW_M)
        for stripe in range(stripes)
    ]
    entrances = Entrances()
    begin_s = float(start_of(seed)[1])
    taken: set[tuple[int, float, int]] = set()
    for cell in rng.permutation(len(cells)).tolist():
        side, at_m, stripe = cells[cell]
        group = draws.coming
        here = [(side, at_m, stripe + k) for k in range(group.size)]
        if (
            len(entrances.ages) + group.size > wanted
            or stripe + group.size > stripes
            or taken.intersection(here)
        ):
            continue
        taken.update(here)
        draws.entered()
        start, end = lines[side]
        ahead = (end - start) / np.linalg.norm(end - start)
        left = np.array([-ahead[1], ahead[0]])
        step = 1 if not flow.both_ways or rng.random() < 0.5 else -1
        walk = tuple(ring.sides[(side + step * k) % len(ring.sides)] for k in range(4 * _ROUNDS))
        angle_deg = heading_to_sumo(math.atan2(*(step * ahead[::-1]).tolist()))
        mps = group.walks_at(float(rng.uniform(*group.pace_mps)))
        for (_, _, k), age in zip(here, group.ages, strict=True):
            x_m, y_m = (
                start + at_m * ahead + (k - (stripes - 1) / 2) * GROUP_STRIPE_M * left
            ).tolist()
            name = f"c{len(entrances.ages)}"
            entrances.ages[name] = age
            entry = PersonEntry(name, walk[0], at_m, walk, 1.0, mps, (x_m, y_m), angle_deg)
            entrances.people[begin_s].append(entry)
    return entrances


def _streets(
    net: Path,
    street_map: StreetMap,
    at: tuple[float, float],
    entrances: Entrances,
    seed: int,
    seconds: float,
) -> Iterator[Street]:
    """A street, tick after tick, without a robot; who comes and goes stands in `entrances`."""
    robot = RobotState(Pose(*at, 0.0))
    spec = CrowdSpec(persons=1, vehicles=0, radius_m=_RADIUS_M)
    with sumo_crowd(net, street_map, spec, seed, frozenset(), at, before=entrances) as crowd:
        for _ in range(round(seconds * 1000 / TICK_MS)):
            nobody = EventReply(episode="people", tick=crowd.street.tick, states=(), actors=())
            yield crowd.step(robot, nobody, absent=True)


def walk_across(seconds: float, seed: int) -> tuple[list[Floats], list[Floats]]:
    """Let people and vehicles meet at a crossing without signals.

    Returns the tracks of people, each (T, 3) with time s, x and y m, and of vehicles, each (T, 5)
    with length and width besides; vehicles drive along x, people cross along y.
    """
    people: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    vehicles: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        street = OpenCrosswalk(Path(folder))
        entrances = _over_the_street(street, seconds, seed)
        for k, now in enumerate(
            _streets(street.net, street.street_map, (0.0, 0.0), entrances, seed, seconds)
        ):
            time_s = k * TICK_MS / 1000
            for name, xy in zip(now.people.ids, now.people.xy.tolist(), strict=True):
                if abs(xy[0]) < SIDEWALK_WIDTH_M:
                    people[name].append((time_s, *xy))
            for name, xy, size in zip(
                now.vehicles.ids, now.vehicles.xy.tolist(), now.vehicles.size.tolist(), strict=True
            ):
                if abs(xy[0]) < _LOOK_M:
                    vehicles[name].append((time_s, *xy, *size))
    return [np.array(track) for track in people.values()], [
        np.array(track) for track in vehicles.values()
    ]


def _over_the_street(street: OpenCrosswalk, seconds: float, seed: int) -> Entrances:
    """People and vehicles who come at random from either side."""
    rng = np.random.default_rng(seed)
    draws = GroupDraws(CrowdSpec(), rng.spawn(1)[0])
    entrances = Entrances()
    begin_s = start_of(seed)[1] + TICK_MS / 1000
    kinds = list(VEHICLE_TYPES)
    shares = [share for _, _, share in VEHICLE_TYPES.values()]

    def moments_s(mean_s: float) -> list[float]:
        """When they come in, of those at which people and vehicles are let in."""
        gaps_s = rng.exponential(mean_s, round(seconds / mean_s))
        return [
            round(begin_s + _ROLL_S * math.ceil(at_s / _ROLL_S), 2)
            for at_s in np.cumsum(gaps_s).tolist()
        ]

    for roads, walk in zip(street.lanes, street.over, strict=True):
        for k, at_s in enumerate(moments_s(_VEHICLE_EVERY_S)):
            entry = VehicleEntry(
                f"v{roads[0]}{k}", str(rng.choice(kinds, p=shares)), roads, _WALK_UP_M
            )
            entrances.vehicles[at_s].append(entry)
        start, end = np.asarray(street.street_map.strips[walk[0]].line)[[0, -1]]
        ahead = (end - start) / np.linalg.norm(end - start)
        at_m = float(np.linalg.norm(end - start)) - _WALK_UP_M
        angle_deg = heading_to_sumo(math.atan2(ahead[1], ahead[0]))
        for at_s in moments_s(_PERSON_EVERY_S):
            group = draws.coming
            draws.entered()
            name = f"c{len(entrances.ages)}"
            entrances.ages[name] = group.ages[0]
            aside_m = float(rng.uniform(-1.2, 1.2))
            x_m, y_m = (start + at_m * ahead + aside_m * np.array([-ahead[1], ahead[0]])).tolist()
            mps = group.walks_at(float(rng.uniform(*group.pace_mps)))
            entry2 = PersonEntry(name, walk[0], at_m, walk, _WALK_UP_M, mps, (x_m, y_m), angle_deg)
            entrances.people[at_s].append(entry2)
    return entrances
