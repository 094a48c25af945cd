"""Measures speeds, densities, distances and gaps in tracks of people.

Tracks are pandas frames with the columns id, frame, x, y (metres), as pedpy has them: it gives
densities and speeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from cosim.core.errors import MachineError
from cosim.core.geometry import Floats
from scenarios.tools.bench.people_data import MeanSd
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M

FRAMES_HZ: Final = 10.0
"""Frames of a track in a second."""
_SPEED_FRAMES: Final = 2
"""Frames before and after a moment between which its speed is taken."""
_WALKS_MPS: Final = 0.3
"""Speed from which a person walks, m/s."""
_SAME_WAY: Final = 0.9
"""Cosine of the angle between two people below which they walk in different directions."""


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
    """Return each person's speed in each frame (pedpy): columns id, frame, speed (m/s).

    Frames within 0.2 s of a track's ends are left out.
    """
    import pedpy

    data = pedpy.TrajectoryData(tracks[["id", "frame", "x", "y"]], frame_rate=FRAMES_HZ)
    found: pd.DataFrame = pedpy.compute_individual_speed(
        traj_data=data,
        frame_step=_SPEED_FRAMES,
        speed_calculation=pedpy.SpeedCalculation.BORDER_EXCLUDE,
    )
    return found


def speeds_by_density(tracks: pd.DataFrame, windows: Sequence[Polygon]) -> Floats:
    """Return (K, 2): density (persons per m2, pedpy) and speed (m/s) in the windows.

    A row is one person in one window in one frame.
    """
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
    """Return mean, deviation and number of the speeds in each interval of densities.

    An interval without speeds has NaN.
    """
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
    """Return (K,): for each row, the distance in metres to the nearest person of that frame.

    A person alone has inf.
    """
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
    """Return (K,): for each row, the distance in metres to the nearest person ahead, else inf.

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
    """Return the mean speed, m/s, of each person while no other is within `apart_m`.

    least_s: people with a shorter time alone are left out.
    """
    alone = tracks[nearest_m(tracks) > apart_m].merge(speeds(tracks), on=["id", "frame"])
    each = alone.groupby("id")["speed"].agg(["mean", "size"])
    return each["mean"][each["size"] >= least_s * FRAMES_HZ].to_numpy(dtype=float)


def on_ground(tracks: pd.DataFrame, ground: shapely.Geometry) -> NDArray[np.bool_]:
    """Return (K,): true where a row of the tracks lies inside; edges are outside, as in pedpy."""
    inside: NDArray[np.bool_] = shapely.contains_xy(
        ground, tracks["x"].to_numpy(), tracks["y"].to_numpy()
    )
    return inside


def encroachments_s(
    people: Sequence[Floats], vehicles: Sequence[Floats], radius_m: float
) -> tuple[Floats, Floats]:
    """Return post-encroachment times in seconds: person first, then vehicle first.

    Person first: from a person's exit of a vehicle's path to the next vehicle's entry there.
    Vehicle first: from a vehicle's exit of a person's path to the person's entry there.
    Vehicles drive along x, people cross along y. A lane is one side of y = 0.
    people: tracks (T, 3): time s, x m, y m
    vehicles: tracks (T, 5): time s, x m, y m, length m, width m
    radius_m: of a person
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
    """Return the stay of a track in a band, or None.

    axis: the column across the band
    """
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
