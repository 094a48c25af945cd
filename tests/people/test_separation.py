"""Separation: pedestrians do not walk through each other."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_nets.crowd.separation import SHOULDERS_M, separated_positions

REACH_M = 2.2 * 0.05


def tracks_of(start: np.ndarray, goal: np.ndarray, firm: np.ndarray) -> list[np.ndarray]:
    """Return the tracks, tick by tick, of people who walk from (N, 2) to (N, 2) at 1.4 m/s; firm
    ones do not yield."""
    at = start.astype(float)
    track = []
    for _ in range(200):
        away = goal - at
        far = np.maximum(np.hypot(*away.T), 1e-9)[:, None]
        at = separated_positions(at, at + away / far * np.minimum(far, 0.07), firm, REACH_M)
        track.append(at)
    return track


@pytest.mark.parametrize("aside_m", [0.0, 0.1, -0.3])
@pytest.mark.parametrize("firm", [False, True])
def test_two_people_pass_head_on_without_touching(aside_m: float, firm: bool) -> None:
    """Head-on or nearly so both arrive, never nearer than their shoulders, and never faster than a
    step allows."""
    start = np.array([[-4.0, 0.0], [4.0, aside_m]])
    goal = np.array([[4.0, 0.0], [-4.0, aside_m]])
    track = tracks_of(start, goal, np.array([firm, False]))
    assert min(float(np.hypot(*(at[0] - at[1]))) for at in track) > 0.9 * SHOULDERS_M
    assert np.hypot(*(track[-1] - goal).T).max() < 0.05
    steps = np.diff(np.array([start, *track]), axis=0)
    assert np.hypot(steps[..., 0], steps[..., 1]).max() <= REACH_M + 1e-9


def test_a_firm_person_does_not_give_way() -> None:
    """An event pedestrian walks its line to the millimetre, and the other walks round it."""
    start = np.array([[-4.0, 0.0], [4.0, 0.0]])
    goal = np.array([[4.0, 0.0], [-4.0, 0.0]])
    track = tracks_of(start, goal, np.array([True, False]))
    assert all(at[0, 1] == 0.0 for at in track)
    assert max(abs(float(at[1, 1])) for at in track) > 0.8 * SHOULDERS_M


def test_a_crowd_at_one_place_spreads_out() -> None:
    """Eight people with one destination end up side by side without overlap."""
    rng = np.random.default_rng(1)
    track = tracks_of(rng.uniform(-2.0, 2.0, (8, 2)), np.zeros((8, 2)), np.zeros(8, dtype=bool))
    gaps = np.hypot(*(track[-1][:, None] - track[-1][None]).transpose(2, 0, 1)) + 9.0 * np.eye(8)
    assert gaps.min() > 0.3


def test_a_person_alone_walks_as_wanted() -> None:
    """Without anybody near, the same values come back."""
    before = np.array([[0.0, 0.0], [2.0, 0.0]])
    wanted = before + 0.07
    assert separated_positions(before, wanted, np.zeros(2, dtype=bool), REACH_M) is wanted


def test_a_person_who_wants_to_stand_in_a_group_stops_before_it() -> None:
    """A person whom SUMO stopped among three talkers comes as near as shoulders allow, and then
    stays still."""
    angles = np.pi / 2 + 2.0 * np.pi * np.arange(3) / 3
    talkers = 0.62 * np.column_stack([np.cos(angles), np.sin(angles)])
    start = np.vstack([talkers, [[0.2, 0.38]]])
    goal = np.vstack([talkers, [[0.33, 0.36]]])
    firm = np.array([True, True, True, False])
    stand = np.array([False, False, False, True])
    at = start
    steps = []
    for _ in range(100):
        to = separated_positions(at, goal, firm, REACH_M, stand)
        steps.append(float(np.hypot(*(to[3] - at[3]))))
        at = to
    assert np.hypot(*(at[:3] - at[3]).T).min() > 0.9 * SHOULDERS_M
    assert max(steps[40:]) == 0.0


def test_a_standing_person_gives_way_to_a_walker() -> None:
    """A walker is not held up by a standing person who can step aside."""
    at = np.array([[-2.0, 0.0], [0.0, 0.0]])
    for _ in range(100):
        wanted = np.array([at[0] + (0.07, 0.0), [0.0, 0.0]])
        at = separated_positions(
            at, wanted, np.array([False, False]), REACH_M, np.array([False, True])
        )
        assert np.hypot(*(at[1] - at[0])) > 0.9 * SHOULDERS_M
    assert at[0, 0] > 2.0
    assert np.hypot(*at[1]) < 0.05
