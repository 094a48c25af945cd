"""Measures how our walkers walk, and compares them with measurements of people: `cosim bench
people`.

Tracks are pandas frames with the columns id, frame, x, y (metres), as pedpy has them: it gives
densities and speeds.
"""

from __future__ import annotations

import math
import multiprocessing
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from cosim.core.errors import MachineError
from cosim.core.geometry import Floats, Pose, heading_to_sumo
from cosim.core.progress import Progress
from cosim.core.state import PERSON_RADIUS_M, RobotState, Street
from cosim.place.street_map import StreetMap
from cosim.spec.events import EventReply
from cosim.spec.scenario import CrowdSpec
from scenarios.episodes.wiring import sumo_crowd
from sumo_nets.crowd.demand import VEHICLE_TYPES
from sumo_nets.crowd.demand_log import Entrances, PersonEntry, VehicleEntry
from sumo_nets.crowd.empty_street import TICK_MS, sumo_start
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M, GroupDraws
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert

DENSITY_EDGES: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Persons per square metre in a window 2 m long, between which speeds are put together."""
NEAREST_PERCENT: Final = (1.0, 5.0, 50.0)
NEAREST_M: Final = {
    "ETH": (0.48, 0.60, 1.08),
    "Hotel": (0.39, 0.50, 1.19),
    "zara01": (0.49, 0.61, 0.97),
    "zara02": (0.37, 0.46, 0.80),
    "students03": (0.35, 0.44, 0.69),
}
"""Percentiles NEAREST_PERCENT of the distance from a person to the nearest other, in metres;
same films."""
PERSON_FIRST_PERCENT: Final = (5.0, 10.0, 25.0, 50.0)
PERSON_FIRST_S: Final = (3.2, 3.7, 4.7, 6.8)
VEHICLE_FIRST_PERCENT: Final = (5.0, 25.0, 50.0)
VEHICLE_FIRST_S: Final = (2.4, 3.2, 4.3)
"""Post-encroachment times of the DUT films (Yang et al. 2019), where people and cars meet
without signals."""
FRAMES_HZ: Final = 10.0
"""Frames of a track in a second."""
_SPEED_FRAMES: Final = 2
"""Frames before and after a moment between which its speed is taken."""
SIDEWALK_WIDTH_M: Final = 3.2
"""The sidewalks' width: five stripes of SUMO's, as most of a city's sidewalks have."""
WINDOW_M: Final = 2.0
_WALKS_MPS: Final = 0.3
"""Speed from which a person walks, m/s."""
_SAME_WAY: Final = 0.9
"""Cosine of the angle between two people below which they walk in different directions."""
FOLLOWING_M: Final = 2.0
"""Largest distance of a person that follows another, metres."""
FOLLOWING_BIN_M: Final = 0.02
"""Width of the intervals in which following distances are counted, metres."""
_SIDE_M: Final = 30.0
_BUILT: Final = ("--walkingareas", "--offset.disable-normalization", "--junctions.corner-detail=8")
_SETTLE_S: Final = 20.0
"""Time that people walk before they are measured, in seconds."""
_EVERY_S: Final = 10.0
"""Mean time between people, and between vehicles, of each direction at the crossing."""
_ROW_M: Final = 0.48
"""People are put there in rows, one behind the other: SUMO's jams are hardly denser."""
_ROUNDS: Final = 60
_RADIUS_M: Final = 200.0
_ROLL_S: Final = 0.5
"""People and vehicles come in every half second."""
_WALK_UP_M: Final = 15.0
_LOOK_M: Final = 12.0
"""Distance from the crossing within which vehicles are recorded, in metres."""
DENSITIES: Final = (0.25, 0.75, 1.25, 1.75, 2.25, 2.75)
"""Densities of the rings, persons per m2; speeds are sorted by the density in the window at each
moment."""
LOOSE: Final = (0.05, 0.1, 0.15, 0.2, 0.3)
"""Densities of the rings on which nearest neighbours are measured, persons per m2."""
GROUPS: Final = (0.0, 0.7)
"""Shares of those who walk in groups: as the suites have it, and as streets have it (see
`group_sampling`)."""
_WALK_S: Final = 40.0
_CROSS_S: Final = 1200.0
_FREE_M: Final = 3.0
_FREE_S: Final = 3.0
_FREE_SEEDS: Final = 4


class MeanSd(NamedTuple):
    """A mean and a standard deviation."""

    mean: float
    sd: float


SPEED_BY_DENSITY_MPS: Final = (
    MeanSd(1.45, 0.29),
    MeanSd(1.40, 0.22),
    MeanSd(1.17, 0.24),
    MeanSd(0.92, 0.23),
    MeanSd(0.62, 0.17),
    MeanSd(0.47, 0.10),
)
"""The corridor of the HERMES project, for each interval of DENSITY_EDGES."""

FREE_SPEED_MPS: Final = {
    "ETH": MeanSd(1.47, 0.35),
    "Hotel": MeanSd(1.40, 0.40),
    "zara01": MeanSd(1.16, 0.30),
    "zara02": MeanSd(1.21, 0.31),
    "students03": MeanSd(0.84, 0.35),
}
"""Of the walkers in the films of ETH (Pellegrini et al. 2009) and UCY (Lerner et al. 2007)."""


def need_pedpy() -> None:
    """Raises MachineError where pedpy is not installed."""
    try:
        import pedpy  # noqa: F401
    except ImportError as error:
        raise MachineError(
            "`cosim bench people` measures density and speed with pedpy, which is not installed: "
            "pip install -e '.[people]' in the checkout"
        ) from error


def speeds(tracks: pd.DataFrame) -> pd.DataFrame:
    """Return everyone's speed in every frame: id, frame, speed (m/s), by pedpy; not within 0.2 s
    of a track's ends."""
    import pedpy

    data = pedpy.TrajectoryData(tracks[["id", "frame", "x", "y"]], frame_rate=FRAMES_HZ)
    found: pd.DataFrame = pedpy.compute_individual_speed(
        traj_data=data,
        frame_step=_SPEED_FRAMES,
        speed_calculation=pedpy.SpeedCalculation.BORDER_EXCLUDE,
    )
    return found


def speeds_by_density(tracks: pd.DataFrame, windows: Sequence[Polygon]) -> Floats:
    """Return (K, 2) density (persons per m2, by pedpy) and speed (m/s) of each person in a
    window in each frame."""
    import pedpy

    data = pedpy.TrajectoryData(tracks[["id", "frame", "x", "y"]], frame_rate=FRAMES_HZ)
    moving = tracks.merge(speeds(tracks), on=["id", "frame"])
    found = []
    for window in windows:
        density = pedpy.compute_classic_density(
            traj_data=data,
            measurement_area=pedpy.MeasurementArea(shapely.get_coordinates(window.exterior)[:-1]),
        )
        inside = moving[on_ground(moving, window)]
        found.append(
            inside.merge(density.reset_index(), on="frame")[["density", "speed"]].to_numpy(
                dtype=float
            )
        )
    return np.concatenate(found)


def in_bins(density_speed: Floats, edges: Sequence[float]) -> list[tuple[MeanSd, int]]:
    """Return mean, deviation and number of the speeds between each two densities; NaN where
    there are none."""
    where = np.digitize(density_speed[:, 0], edges)
    groups = [density_speed[where == k, 1] for k in range(1, len(edges))]
    return [(mean_sd(group), len(group)) for group in groups]


def mean_sd(values: Floats) -> MeanSd:
    """Return mean and deviation; NaN of no values."""
    return (
        MeanSd(float(values.mean()), float(values.std()))
        if len(values)
        else MeanSd(math.nan, math.nan)
    )


def nearest_m(tracks: pd.DataFrame) -> Floats:
    """Return (K,) the distance to the nearest other of the same frame, metres, for each row; inf
    for a person alone."""
    from scipy.spatial import KDTree

    frame = tracks["frame"].to_numpy()
    xy = tracks[["x", "y"]].to_numpy(dtype=float)
    found = np.full(len(xy), np.inf)
    for rows in np.split(
        order := np.argsort(frame, kind="stable"), np.flatnonzero(np.diff(frame[order])) + 1
    ):
        if len(rows) > 1:
            found[rows] = np.asarray(KDTree(xy[rows]).query(xy[rows], k=2)[0])[:, 1]
    return found


def following_m(tracks: pd.DataFrame) -> Floats:
    """Return (K,) the distance to the nearest person ahead, metres, for each row; inf without one.

    Both walk in the same direction, one behind the other.
    """
    ends = tracks.groupby("id")[["x", "y"]]
    step = (ends.shift(-_SPEED_FRAMES) - ends.shift(_SPEED_FRAMES)).to_numpy(dtype=float)
    way = np.hypot(step[:, 0], step[:, 1])
    walks = way > _WALKS_MPS * 2 * _SPEED_FRAMES / FRAMES_HZ
    heading = step / np.where(walks, way, 1.0)[:, None]
    xy = tracks[["x", "y"]].to_numpy(dtype=float)
    found = np.full(len(xy), np.inf)
    for rows in tracks[walks].groupby("frame").indices.values():
        mine = np.flatnonzero(walks)[rows]
        to = xy[mine][None] - xy[mine][:, None]
        dx, dy = heading[mine, 0][:, None], heading[mine, 1][:, None]
        ahead = dx * to[..., 0] + dy * to[..., 1]
        aside = dx * to[..., 1] - dy * to[..., 0]
        same = (heading[mine] @ heading[mine].T > _SAME_WAY) & (np.abs(aside) < GROUP_STRIPE_M / 2)
        found[mine] = np.where(same & (ahead > 0.0), ahead, np.inf).min(axis=1)
    return found


def free_speeds(tracks: pd.DataFrame, apart_m: float, least_s: float) -> Floats:
    """Return the mean speed, m/s, of each person without others within `apart_m`, of those who
    had `least_s` of it."""
    alone = tracks[nearest_m(tracks) > apart_m].merge(speeds(tracks), on=["id", "frame"])
    each = alone.groupby("id")["speed"].agg(["mean", "size"])
    return each["mean"][each["size"] >= least_s * FRAMES_HZ].to_numpy(dtype=float)


def on_ground(tracks: pd.DataFrame, ground: shapely.Geometry) -> NDArray[np.bool_]:
    """Return (K,) whether each row of the tracks lies inside, not on the edge, as pedpy defines
    it."""
    inside: NDArray[np.bool_] = shapely.contains_xy(
        ground, tracks["x"].to_numpy(), tracks["y"].to_numpy()
    )
    return inside


def encroachments_s(
    people: Sequence[Floats], vehicles: Sequence[Floats], radius_m: float
) -> tuple[Floats, Floats]:
    """Post-encroachment times where vehicles drive along x and people cross along y, seconds, in
    two arrays: from somebody's leaving of a vehicle's path to the coming of the next vehicle on
    that lane, and from the last vehicle's leaving of somebody's path to its coming.

    people: tracks (T, 3) of time s, x, y m. vehicles: tracks (T, 5) of time s, x, y, length, width
    m. A lane is what lies on one side of y = 0. radius_m: of a person.
    """
    person_first: list[float] = []
    vehicle_first: list[float] = []
    for person in people:
        for side in (-1.0, 1.0):
            stays = [
                (walks, drives)
                for vehicle in vehicles
                if side * vehicle[0, 2] > 0.0
                and (walks := _stay(person, 2, vehicle[0, 2], vehicle[0, 4] / 2 + radius_m))
                and (drives := _stay(vehicle, 1, walks.at_m, vehicle[0, 3] / 2 + radius_m))
            ]
            after_s = [
                drives.began_s - walks.ended_s
                for walks, drives in stays
                if drives.began_s >= walks.ended_s
            ]
            before_s = [
                walks.began_s - drives.ended_s
                for walks, drives in stays
                if drives.ended_s <= walks.began_s
            ]
            person_first += sorted(after_s)[:1]
            vehicle_first += sorted(before_s)[:1]
    return np.array(person_first), np.array(vehicle_first)


class _Stay(NamedTuple):
    """Time span in a band, and the mean position along it in metres."""

    began_s: float
    ended_s: float
    at_m: float


def _stay(track: Floats, axis: int, middle_m: float, half_m: float) -> _Stay | None:
    """Return the stay of a track in a band. axis: the column across it. None for a track that
    never was in it."""
    inside = track[np.abs(track[:, axis] - middle_m) <= half_m]
    return (
        _Stay(inside[0, 0], inside[-1, 0], float(inside[:, 3 - axis].mean()))
        if len(inside)
        else None
    )


def normal_distance(one: MeanSd, other: MeanSd) -> float:
    """Return the 2-Wasserstein distance of normal distributions with these means and deviations."""
    return math.hypot(one.mean - other.mean, one.sd - other.sd)


def percentile_distance(values: Floats, percent: Sequence[float], wanted: Sequence[float]) -> float:
    """Return the mean difference of percentiles, which approximates the 1-Wasserstein distance."""
    return float(np.abs(np.percentile(values, percent) - np.asarray(wanted)).mean())


class BlockRing:
    """Four straight sidewalks and four corners, so that whoever walks on comes round again.
    folder: for its net."""

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
    folder: for its net.

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
    """People on the ring: persons per m2, whether they walk both ways round, the share who walk
    in groups."""

    density: float
    both_ways: bool
    groups: float = 0.0


def walk_round(
    flow: Flow, seconds: float, seed: int, settle_s: float = _SETTLE_S
) -> tuple[BlockRing, pd.DataFrame]:
    """Let people walk round the block. Returns it and their tracks, FRAMES_HZ frames a second:
    id, frame, x, y."""
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
    """Start everyone at once at random places; groups, ages and speeds are those of every crowd."""
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
    """Draw people and vehicles that arrive at random from either side."""
    rng = np.random.default_rng(seed)
    rng_groups, rng_gaps = rng.spawn(2)
    draws = GroupDraws(CrowdSpec(), rng_groups)
    entrances = Entrances()
    begin_s = sumo_start(seed)[1] + TICK_MS / 1000
    kinds = list(VEHICLE_TYPES)
    shares = [share for _, _, share in VEHICLE_TYPES.values()]

    def moments_s(mean_s: float) -> list[float]:
        """Draw arrival times, rounded up to the half second at which arrivals are inserted."""
        gaps_s = rng.exponential(mean_s, round(seconds / mean_s))
        return [
            round(begin_s + _ROLL_S * math.ceil(at_s / _ROLL_S), 2)
            for at_s in np.cumsum(gaps_s).tolist()
        ]

    for roads, walk in zip(street.lanes, street.over, strict=True):
        for k, at_s in enumerate(moments_s(_EVERY_S)):
            entry = VehicleEntry(
                f"v{roads[0]}{k}", str(rng.choice(kinds, p=shares)), roads, _WALK_UP_M
            )
            entrances.vehicles[at_s].append(entry)
        start, end = np.asarray(street.street_map.strips[walk[0]].line)[[0, -1]]
        ahead = (end - start) / np.linalg.norm(end - start)
        at_m = float(np.linalg.norm(end - start)) - _WALK_UP_M
        angle_deg = heading_to_sumo(math.atan2(ahead[1], ahead[0]))
        for at_s in moments_s(_EVERY_S):
            group = draws.coming
            draws.entered()
            name = f"c{len(entrances.ages)}"
            entrances.ages[name] = group.ages[0]
            aside_m = float(rng.uniform(-1.2, 1.2))
            x_m, y_m = (start + at_m * ahead + aside_m * np.array([-ahead[1], ahead[0]])).tolist()
            mps = group.speed_at(float(rng.uniform(*group.pace_mps)))
            (gap_m,) = group.gaps_m(rng_gaps)
            entry2 = PersonEntry(
                name, walk[0], at_m, walk, _WALK_UP_M, mps, (x_m, y_m), angle_deg, gap_m
            )
            entrances.people[at_s].append(entry2)
    return entrances


_FREE: Final = Flow(0.05, both_ways=False)
FOLLOWED: Final = Flow(0.2, both_ways=False)
"""Ring on which the distances of people that follow each other are measured."""


class Nearest(NamedTuple):
    """Nearest neighbours (K,) in metres on the ring with this flow."""

    flow: Flow
    apart_m: Floats


class Comparison(NamedTuple):
    """Measurements of our walkers.

    by_density: for each interval of DENSITY_EDGES the speed, m/s, and the person-seconds of it, one
    way and both ways. free_mps: the speed of each person walking alone. nearest: of each loose
    ring. following_m: distances (K,) to the nearest person ahead, below FOLLOWING_M, on FOLLOWED.
    person_first_s, vehicle_first_s: post-encroachment times. vehicles, people: how many came
    to the crossing.
    """

    by_density: tuple[list[tuple[MeanSd, float]], list[tuple[MeanSd, float]]]
    free_mps: Floats
    nearest: list[Nearest]
    following_m: Floats
    person_first_s: Floats
    vehicle_first_s: Floats
    people: int
    vehicles: int


def watch_people(jobs: int, progress: Progress) -> Comparison:
    """Let people walk on every street, in `jobs` processes. progress: receives the stage."""
    need_pedpy()
    dense = [
        Flow(density, both_ways) for both_ways in (False, True) for density in reversed(DENSITIES)
    ]
    loose = [Flow(density, both_ways=True, groups=groups) for groups in GROUPS for density in LOOSE]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=1) as pool:
        crossing = pool.apply_async(_crossing, (_CROSS_S, 0))
        walking = [pool.apply_async(_density_speed, (flow, _WALK_S, 0)) for flow in dense]
        near = [pool.apply_async(_nearest, (flow, _WALK_S, 0)) for flow in loose]
        free = [pool.apply_async(_free_mps, (_FREE, _WALK_S, seed)) for seed in range(_FREE_SEEDS)]
        following = pool.apply_async(follow, (FOLLOWED, _WALK_S, 0))
        found = []
        for k, one in enumerate(tasks := [*walking, *near, *free]):
            progress(f"watching people: street {k + 1} of {len(tasks)}")
            found.append(one.get())
        person_first_s, vehicle_first_s, people, vehicles = crossing.get()
        behind_m = following.get()
    one_way = found[: len(DENSITIES)]
    both_ways = found[len(DENSITIES) : len(dense)]
    nearest = found[len(dense) :]
    return Comparison(
        (_binned(one_way), _binned(both_ways)),
        np.concatenate(nearest[len(loose) :]),
        [Nearest(flow, apart_m) for flow, apart_m in zip(loose, nearest, strict=False)],
        behind_m,
        person_first_s,
        vehicle_first_s,
        people,
        vehicles,
    )


def alike(nearest: list[Nearest], median_m: float) -> Nearest:
    """Return the ring whose median is nearest to `median_m`."""
    return min(nearest, key=lambda one: abs(float(np.median(one.apart_m)) - median_m))


def _binned(found: list[Floats]) -> list[tuple[MeanSd, float]]:
    return [
        (speed, count / FRAMES_HZ) for speed, count in in_bins(np.concatenate(found), DENSITY_EDGES)
    ]


def _density_speed(flow: Flow, seconds: float, seed: int) -> Floats:
    ring, tracks = walk_round(flow, seconds, seed)
    return speeds_by_density(tracks, ring.windows())


def _nearest(flow: Flow, seconds: float, seed: int) -> Floats:
    ring, tracks = walk_round(flow, seconds, seed)
    return nearest_m(tracks)[on_ground(tracks, ring.straights())]


def follow(flow: Flow, seconds: float, seed: int, settle_s: float = _SETTLE_S) -> Floats:
    """Return (K,) the distances below FOLLOWING_M to people ahead on straight sidewalks, metres."""
    ring, tracks = walk_round(flow, seconds, seed, settle_s)
    apart_m = following_m(tracks)[on_ground(tracks, ring.straights())]
    return apart_m[apart_m < FOLLOWING_M]


def largest_share(near_m: Floats) -> float:
    """Return the share of distances in their most frequent interval of FOLLOWING_BIN_M."""
    counts, _ = np.histogram(near_m, np.arange(0.0, FOLLOWING_M, FOLLOWING_BIN_M))
    return float(counts.max() / len(near_m))


def _free_mps(flow: Flow, seconds: float, seed: int) -> Floats:
    return free_speeds(walk_round(flow, seconds, seed)[1], _FREE_M, _FREE_S)


def _crossing(seconds: float, seed: int) -> tuple[Floats, Floats, int, int]:
    people, vehicles = walk_across(seconds, seed)
    return *encroachments_s(people, vehicles, PERSON_RADIUS_M), len(people), len(vehicles)
