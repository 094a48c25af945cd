"""Simulated streets on which the walkers of `cosim bench people` are measured."""

from __future__ import annotations

import math
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
import shapely
from shapely.geometry import Polygon

from cosim.core.geometry import Floats, Pose, heading_to_sumo
from cosim.core.state import RobotState, Street
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventReply
from cosim.spec.scenario import CrowdSpec
from scenarios.episodes.wiring import sumo_crowd
from scenarios.tools.bench.people_tracks import FRAMES_HZ
from sumo_nets.crowd.demand import VEHICLE_TYPES
from sumo_nets.crowd.demand_log import Entrances, PersonEntry, VehicleEntry
from sumo_nets.crowd.empty_street import TICK_MS, sumo_start
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M, GroupDraws
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert

SIDEWALK_WIDTH_M: Final = 3.2
"""Width of the sidewalks: five of SUMO's stripes, as most sidewalks of a city have."""
WINDOW_M: Final = 2.0
"""Length of a window in which density is measured, metres."""
_SIDE_M: Final = 30.0
"""Length of a side of the block, metres."""
_BUILT: Final = ("--walkingareas", "--offset.disable-normalization", "--junctions.corner-detail=8")
SETTLE_S: Final = 20.0
"""Time that people walk before they are measured, seconds."""
_EVERY_S: Final = 10.0
"""Mean time between people, and between vehicles, of each direction at the crossing."""
_ROW_M: Final = 0.48
"""Distance between rows of people at the start, metres: SUMO's jams are hardly denser."""
_ROUNDS: Final = 60
"""Rounds in a walk, more than a measurement lasts."""
_RADIUS_M: Final = 200.0
_ENTER_S: Final = 0.5
"""Interval at which people and vehicles enter, seconds."""
_WALK_UP_M: Final = 15.0
"""Distance from the crossing at which people and vehicles enter, metres."""
_LOOK_M: Final = 12.0
"""Distance from the crossing within which vehicles are recorded, in metres."""


class BlockRing:
    """Four straight sidewalks and four corners, on which people walk round and round.

    folder: for its net
    """

    sides: Final = ("ab", "bc", "cd", "da")
    """Edges in walking order."""

    middle: Final = (_SIDE_M / 2, _SIDE_M / 2)

    def __init__(self, folder: Path) -> None:
        corners = {
            "a": (0.0, 0.0),
            "b": (_SIDE_M, 0.0),
            "c": (_SIDE_M, _SIDE_M),
            "d": (0.0, _SIDE_M),
        }
        lane = f'<lane index="0" allow="pedestrian" width="{SIDEWALK_WIDTH_M}"/>'
        edges = [_edge(f"{tail}{head}", tail, head, [lane], "center") for tail, head in self.sides]
        self.net = _built(folder, corners, edges, [])

    @cached_property
    def street_map(self) -> StreetMap:
        return read_net(self.net)

    def line(self, side: str) -> Floats:
        """Return (2, 2) both ends of the middle line of a side, metres."""
        line = np.asarray(self.street_map.strips[side].line)
        return line[[0, -1]]

    @property
    def area_m2(self) -> float:
        """Return the area of sidewalks and corners."""
        place = self.street_map
        polygons = [strip.polygon for strip in place.strips.values()]
        return float(
            shapely.area([*polygons, *(corner.polygon for corner in place.corners.values())]).sum()
        )

    def windows(self) -> list[Polygon]:
        """Return a window in the middle of each side, WINDOW_M long and as wide as the sidewalk."""
        return [self._stretch(side, WINDOW_M) for side in self.sides]

    def straights(self) -> shapely.Geometry:
        """Return the four sides without their parts near corners."""
        return shapely.union_all([self._stretch(side, _SIDE_M / 2) for side in self.sides])

    def _stretch(self, side: str, length_m: float) -> Polygon:
        start, end = self.line(side)
        middle = (start + end) / 2
        ahead = (end - start) / np.linalg.norm(end - start)
        line = shapely.linestrings([middle - ahead * length_m / 2, middle + ahead * length_m / 2])
        return Polygon(
            shapely.get_coordinates(shapely.buffer(line, SIDEWALK_WIDTH_M / 2, cap_style="flat"))
        )


class OpenCrosswalk:
    """A residential street of two lanes along x, with a marked crossing without signals at x = 0.

    folder: for its net

    Vehicles come as "wm", "me" and "em", "mw"; people walk along the first of each pair and cross.
    """

    lanes: Final = (("wm", "me"), ("em", "mw"))
    over: Final = (("wm", ":m_c0", "mw"), ("em", ":m_c0", "me"))
    """Walks over the crossing, from either side of the street."""

    half_m: Final = 150.0

    def __init__(self, folder: Path) -> None:
        ends = {"w": (-self.half_m, 0.0), "m": (0.0, 0.0), "e": (self.half_m, 0.0)}
        lanes = [
            f'<lane index="0" allow="pedestrian" width="{SIDEWALK_WIDTH_M}"/>',
            '<lane index="1" disallow="pedestrian" width="3.2"/>',
        ]
        names = [name for pair in self.lanes for name in pair]
        edges = [_edge(name, name[0], name[1], lanes, "right") for name in names]
        crossing = f'<crossing node="m" edges="wm mw" width="{SIDEWALK_WIDTH_M}" priority="true"/>'
        self.net = _built(folder, ends, edges, [crossing])

    @cached_property
    def street_map(self) -> StreetMap:
        return read_net(self.net)


def _edge(name: str, tail: str, head: str, lanes: list[str], spread: str) -> str:
    speed_mps = 8.33
    return (
        f'<edge id="{name}" from="{tail}" to="{head}" numLanes="{len(lanes)}" speed="{speed_mps}" '
        f'spreadType="{spread}">{"".join(lanes)}</edge>'
    )


def _built(
    folder: Path, nodes: dict[str, tuple[float, float]], edges: list[str], crossings: list[str]
) -> Path:
    rows = [
        f'<node id="{name}" x="{x}" y="{y}" type="priority"/>' for name, (x, y) in nodes.items()
    ]
    files = {"nodes": rows, "edges": edges, "connections": crossings}
    options = []
    for (kind, elements), option in zip(files.items(), "nex", strict=True):
        path = folder / f"{kind}.xml"
        path.write_text(f"<{kind}>\n" + "\n".join(elements) + f"\n</{kind}>\n")
        options += [f"-{option}", str(path)]
    return netconvert([*options, *_BUILT], folder / "street.net.xml")


class Flow(NamedTuple):
    """People on the ring.

    density: persons per m2
    both_ways: true if they walk both ways round
    groups: share of people in groups, 0 to 1
    """

    density: float
    both_ways: bool
    groups: float = 0.0


def walk_round(
    flow: Flow, seconds: float, seed: int, settle_s: float = SETTLE_S
) -> tuple[BlockRing, pd.DataFrame]:
    """Simulate people who walk round the block. Returns it and their tracks.

    Tracks have FRAMES_HZ frames a second, and the columns id, frame, x, y (metres).
    """
    with tempfile.TemporaryDirectory() as folder:
        ring = BlockRing(Path(folder))
        entrances = _draw_ring(ring, flow, seed)
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


def _draw_ring(ring: BlockRing, flow: Flow, seed: int) -> Entrances:
    """Place all people at random; groups, ages and speeds are drawn as in every crowd."""
    rng = np.random.default_rng(seed)
    rng_groups, rng_gaps = rng.spawn(2)
    draws = GroupDraws(CrowdSpec(groups=flow.groups), rng_groups)
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
    begin_s = float(sumo_start(seed)[1])
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
        mps = group.speed_at(float(rng.uniform(*group.pace_mps)))
        gaps_m = group.gaps_m(rng_gaps)
        for (_, _, k), age, gap_m in zip(here, group.ages, gaps_m, strict=True):
            x_m, y_m = (
                start + at_m * ahead + (k - (stripes - 1) / 2) * GROUP_STRIPE_M * left
            ).tolist()
            name = f"c{len(entrances.ages)}"
            entrances.ages[name] = age
            entry = PersonEntry(name, walk[0], at_m, walk, 1.0, mps, (x_m, y_m), angle_deg, gap_m)
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
    """Yield a street without a robot tick by tick; people and vehicles are those of `entrances`."""
    robot = RobotState(Pose(*at, 0.0))
    spec = CrowdSpec(persons=1, vehicles=0, radius_m=_RADIUS_M)
    with sumo_crowd(net, street_map, spec, seed, frozenset(), at, recorded=entrances) as crowd:
        for _ in range(round(seconds * 1000 / TICK_MS)):
            no_event = EventReply(episode="people", tick=crowd.street.tick, states=(), actors=())
            yield crowd.step(robot, no_event, absent=True)


def walk_across(seconds: float, seed: int) -> tuple[list[Floats], list[Floats]]:
    """Simulate people and vehicles at a crossing without signals.

    Returns the tracks of people, each (T, 3): time s, x m, y m; and of vehicles, each (T, 5): also
    length m and width m. Vehicles drive along x, people cross along y.
    """
    people: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    vehicles: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        street = OpenCrosswalk(Path(folder))
        entrances = _draw_crossing(street, seconds, seed)
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


def _draw_crossing(street: OpenCrosswalk, seconds: float, seed: int) -> Entrances:
    """Draw people and vehicles that arrive at random from either side."""
    rng = np.random.default_rng(seed)
    rng_groups, rng_gaps = rng.spawn(2)
    draws = GroupDraws(CrowdSpec(), rng_groups)
    entrances = Entrances()
    begin_s = sumo_start(seed)[1] + TICK_MS / 1000
    kinds = list(VEHICLE_TYPES)
    shares = [share for _, _, share in VEHICLE_TYPES.values()]

    def moments_s() -> list[float]:
        """Draw arrival times, rounded up to the half second at which arrivals are inserted."""
        gaps_s = rng.exponential(_EVERY_S, round(seconds / _EVERY_S))
        return [
            round(begin_s + _ENTER_S * math.ceil(at_s / _ENTER_S), 2)
            for at_s in np.cumsum(gaps_s).tolist()
        ]

    for roads, walk in zip(street.lanes, street.over, strict=True):
        for k, at_s in enumerate(moments_s()):
            entry = VehicleEntry(
                f"v{roads[0]}{k}", str(rng.choice(kinds, p=shares)), roads, _WALK_UP_M
            )
            entrances.vehicles[at_s].append(entry)
        start, end = np.asarray(street.street_map.strips[walk[0]].line)[[0, -1]]
        ahead = (end - start) / np.linalg.norm(end - start)
        at_m = float(np.linalg.norm(end - start)) - _WALK_UP_M
        angle_deg = heading_to_sumo(math.atan2(ahead[1], ahead[0]))
        for at_s in moments_s():
            group = draws.coming
            draws.entered()
            name = f"c{len(entrances.ages)}"
            entrances.ages[name] = group.ages[0]
            aside_m = float(rng.uniform(-1.2, 1.2))
            x_m, y_m = (start + at_m * ahead + aside_m * np.array([-ahead[1], ahead[0]])).tolist()
            mps = group.speed_at(float(rng.uniform(*group.pace_mps)))
            (gap_m,) = group.gaps_m(rng_gaps)
            person = PersonEntry(
                name, walk[0], at_m, walk, _WALK_UP_M, mps, (x_m, y_m), angle_deg, gap_m
            )
            entrances.people[at_s].append(person)
    return entrances
