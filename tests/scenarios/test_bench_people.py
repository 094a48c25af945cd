"""Crowd statistics: the measures on hand-made tracks, and the simulated walkers of the
benchmark."""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
import pytest
import shapely

from cosim.core.errors import MachineError
from scenarios.tools.bench.people_data import MeanSd
from scenarios.tools.bench.people_streets import Flow, walk_round
from scenarios.tools.bench.people_tracks import (
    encroachments_s,
    free_speeds,
    in_bins,
    nearest_m,
    need_pedpy,
    normal_distance,
    percentile_distance,
    speeds_by_density,
)


def _walking(rows: list[tuple[float, float, float]], frames: int = 41) -> pd.DataFrame:
    """Return tracks of people who walk along x from (x, y) at a speed, ten frames a second."""
    tracks = [
        (k, frame, x_m + mps * frame / 10, y_m)
        for k, (x_m, y_m, mps) in enumerate(rows)
        for frame in range(frames)
    ]
    return pd.DataFrame(tracks, columns=["id", "frame", "x", "y"])


def test_each_person_counts_at_the_density_around_it() -> None:
    """Three people abreast in a window of 2 m x 2 m have 0.75 persons/m2, and a lone follower has
    0.25."""
    tracks = _walking([(-2.0, -0.6, 1.0), (-2.0, 0.0, 1.0), (-2.0, 0.6, 1.0), (-4.5, 0.0, 1.5)])
    found = speeds_by_density(tracks, [shapely.box(-1.0, -1.0, 1.0, 1.0)])
    assert set(np.unique(found[:, 0])) == {0.25, 0.75, 1.0}
    assert found[found[:, 0] == 0.75, 1] == pytest.approx(1.0)
    assert found[found[:, 0] == 0.25, 1] == pytest.approx(1.5)
    (low, few), (_, many), (empty, empty_count) = in_bins(found, (0.0, 0.5, 1.5, 2.0))
    assert low.mean == pytest.approx(1.5)
    assert few + many == len(found) and empty_count == 0 and np.isnan(empty.mean)


def test_the_nearest_person_is_searched_in_the_same_frame() -> None:
    """A person who passes a place that another one left earlier is not its nearest neighbour."""
    tracks = _walking([(0.0, 0.0, 1.0), (-3.0, 0.0, 1.0), (0.0, 4.0, 1.0)], frames=11)
    assert nearest_m(tracks).reshape(3, 11) == pytest.approx(
        np.repeat([[3.0], [3.0], [4.0]], 11, axis=1)
    )
    assert nearest_m(tracks[tracks["id"] == 0]).tolist() == [np.inf] * 11
    assert free_speeds(tracks, apart_m=3.5, least_s=0.5) == pytest.approx([1.0])


def test_a_gap_lasts_from_leaving_to_the_next_arrival() -> None:
    """A person at 1 m/s leaves a lane 1.4 m wide (2 m with the shoulders) after 2 s. A vehicle 4 m
    long at 10 m/s arrives 0.23 s before its middle and leaves 0.23 s after it."""
    times_s = np.arange(0.0, 20.0, 0.01)
    person = np.column_stack([times_s, np.zeros_like(times_s), times_s - 10.0])

    def vehicle(at_s: float, y_m: float) -> np.ndarray:
        ones = np.ones_like(times_s)
        return np.column_stack(
            [times_s, 10.0 * (times_s - at_s), y_m * ones, 4.0 * ones, 1.4 * ones]
        )

    # It is on the far lane, at y = 2, from 11 s to 13 s.
    vehicles = [
        vehicle(5.0, 2.0),
        vehicle(8.0, 2.0),
        vehicle(16.0, 2.0),
        vehicle(18.0, 2.0),
        vehicle(10.0, -2.0),
    ]
    person_first_s, vehicle_first_s = encroachments_s([person], vehicles, 0.3)
    assert sorted(person_first_s) == pytest.approx(
        [10.0 - 0.23 - 9.0, 16.0 - 0.23 - 13.0], abs=0.03
    )
    assert vehicle_first_s == pytest.approx([11.0 - 8.0 - 0.23], abs=0.03)


def test_distances_between_distributions_match_hand_computed_values() -> None:
    """Equal figures have distance 0; others differ by mean and deviation, or by the mean difference
    of percentiles."""
    assert normal_distance(MeanSd(1.0, 0.3), MeanSd(1.0, 0.3)) == 0.0
    assert normal_distance(MeanSd(1.0, 0.3), MeanSd(1.3, 0.7)) == pytest.approx(0.5)
    assert percentile_distance(np.arange(101.0), (10, 50), (11, 47)) == pytest.approx(2.0)


def test_a_missing_pedpy_is_named_with_its_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pedpy, one line says how to install it."""
    monkeypatch.setitem(sys.modules, "pedpy", None)
    with pytest.raises(MachineError, match=r"pip install -e '\.\[people\]' in the checkout"):
        need_pedpy()


@pytest.mark.engine
def test_the_ring_holds_the_requested_density() -> None:
    """On a ring of 0.5 persons/m2 all people stay to the end, walk in both directions, and make
    progress."""
    ring, tracks = walk_round(
        Flow(0.5, both_ways=True, groups=0.5), seconds=2.0, seed=0, settle_s=1.0
    )
    counts = tracks.groupby("frame").size()
    assert len(counts) == 20 and counts.min() == counts.max() == pytest.approx(
        0.5 * ring.area_m2, abs=3.0
    )
    pieces = [*ring.street_map.strips.values(), *ring.street_map.corners.values()]
    ground = shapely.union_all([piece.polygon for piece in pieces]).buffer(0.3)
    assert shapely.intersects_xy(ground, tracks["x"], tracks["y"]).all()
    x_m, y_m = (tracks.pivot(index="id", columns="frame", values=axis).to_numpy() for axis in "xy")
    assert np.median(np.hypot(x_m[:, -1] - x_m[:, 0], y_m[:, -1] - y_m[:, 0])) > 1.5
    along = (np.abs(y_m[:, 0]) < 1.6) & (np.abs(x_m[:, 0] - 15.0) < 10.0)
    assert {-1.0, 1.0} <= set(np.sign(x_m[along, -1] - x_m[along, 0]))
    windows = ring.windows()
    assert len(windows) == 4 and all(window.area == pytest.approx(2.0 * 3.2) for window in windows)
