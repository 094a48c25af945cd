"""Pure functions of tracks: who walks how fast at which density, how near people come, gaps between
them and vehicles.

Tracks are pandas frames with the columns id, frame, x, y (metres), as pedpy has them: it gives
densities and speeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from cosim.core.errors import MachineError
from cosim.core.geometry import Floats
from scenarios.tools.bench.people.observed import MeanSd

if TYPE_CHECKING:
    import pandas as pd

FRAMES_HZ: Final = 10.0
"""Frames of a track in a second."""

_SPEED_FRAMES: Final = 2
"""A speed is taken from so many frames before to so many after."""


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
    """How fast everybody is in every frame: id, frame, speed (m/s), by pedpy; not within 0.2 s of a
    track's ends."""
    import pedpy

    data = pedpy.TrajectoryData(tracks[["id", "frame", "x", "y"]], frame_rate=FRAMES_HZ)
    found: pd.DataFrame = pedpy.compute_individual_speed(
        traj_data=data,
        frame_step=_SPEED_FRAMES,
        speed_calculation=pedpy.SpeedCalculation.BORDER_EXCLUDE,
    )
    return found


def speeds_by_density(tracks: pd.DataFrame, windows: Sequence[Polygon]) -> Floats:
    """(K, 2) density (persons per m2, by pedpy) and speed (m/s) of everybody in a window, frame by
    frame."""
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
    """Mean and deviation of the speeds between each two densities, and of how many; NaN where there
    are none."""
    where = np.digitize(density_speed[:, 0], edges)
    groups = [density_speed[where == k, 1] for k in range(1, len(edges))]
    return [(mean_sd(group), len(group)) for group in groups]


def mean_sd(values: Floats) -> MeanSd:
    """Of no values: NaN."""
    return (
        MeanSd(float(values.mean()), float(values.std()))
        if len(values)
        else MeanSd(math.nan, math.nan)
    )


def nearest_m(tracks: pd.DataFrame) -> Floats:
    """(K,) how far the nearest other of the same frame is, metres, for each row of the tracks; inf
    for who is alone."""
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


def free_speeds(tracks: pd.DataFrame, apart_m: float, least_s: float) -> Floats:
    """The mean speed of each person while nobody was nearer than `apart_m`, m/s; of those who
    walked so for `least_s` or longer."""
    alone = tracks[nearest_m(tracks) > apart_m].merge(speeds(tracks), on=["id", "frame"])
    each = alone.groupby("id")["speed"].agg(["mean", "size"])
    return each["mean"][each["size"] >= least_s * FRAMES_HZ].to_numpy(dtype=float)


def on_ground(tracks: pd.DataFrame, ground: shapely.Geometry) -> NDArray[np.bool_]:
    """(K,) whether each row of the tracks lies there, not on its edge, as pedpy has it."""
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
    """From when to when somebody or something was in a band, and where beside it on the mean,
    metres."""

    began_s: float
    ended_s: float
    at_m: float


def _stay(track: Floats, axis: int, middle_m: float, half_m: float) -> _Stay | None:
    """axis: the column across which the band lies. None for who never was in it."""
    inside = track[np.abs(track[:, axis] - middle_m) <= half_m]
    return (
        _Stay(inside[0, 0], inside[-1, 0], float(inside[:, 3 - axis].mean()))
        if len(inside)
        else None
    )


def normal_distance(one: MeanSd, other: MeanSd) -> float:
    """The 2-Wasserstein distance of normal distributions: all that means and deviations alone
    allow."""
    return math.hypot(one.mean - other.mean, one.sd - other.sd)


def percentile_distance(values: Floats, percent: Sequence[float], wanted: Sequence[float]) -> float:
    """The mean difference of percentiles: the 1-Wasserstein distance, as far as it can be taken
    from these."""
    return float(np.abs(np.percentile(values, percent) - np.asarray(wanted)).mean())
