"""Replayed failures: one replay for each episode, checked against its record, each picture drawn
once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import RunError, UsageError
from cosim.report.page.reasons import mishaps_of
from physics.cameras.camera_base import WorldCamera
from scenarios.episodes.replay import load_recorded, replay_episode
from scenarios.tools.viewing.scenes import show_again, ticks_to_show
from tests.conftest import Cosim

pytestmark = pytest.mark.engine
NAME = "obstructing-001"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, cosim: Cosim) -> Path:
    """A run of a scenario that a blind policy fails."""
    folder = tmp_path_factory.mktemp("scenes")
    words = ("--policy", "tests.support.blind_policy:Blind", "--scenario", NAME, "--out", "run")
    done = cosim("run", "reactive", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "run"


def test_consecutive_failures_share_their_pictures(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two moments 1 s apart have 5 s at 4 Hz each, shared pictures are drawn once, and progress
    rises to its total."""
    drawn = []
    done = []
    render = WorldCamera.render
    monkeypatch.setattr(
        WorldCamera, "render", lambda *arguments: drawn.append(0) or render(*arguments)
    )
    (last,) = mishaps_of(load_recorded(run, NAME).record)
    before = last._replace(tick=last.tick - 20, failure=None)
    shown = show_again(run, NAME, [last, before], "auto", done.append)
    late, early = (one.scene.pictures for one in shown)
    seen = {*late.follow, *early.follow}
    assert (
        len(late.follow) in (20, 21)
        and len(early.follow) in (20, 21)
        and len(seen) == len(drawn) <= 27
    )
    assert (
        len({*late.follow} & {*early.follow}) >= 15
        and late.at[-1] == len(shown[0].scene.robot) // 6 - 1
    )
    assert done == sorted(done) and done[-1] == ticks_to_show([last, before])


@pytest.mark.parametrize("column", ["pose", "person_m"])
def test_an_episode_that_replays_differently_is_not_shown(run: Path, column: str) -> None:
    """One changed bit of a tick before the failure is an error with the time."""
    path = run / "episodes" / NAME / "trajectory.npz"
    original = path.read_bytes()
    with np.load(path) as arrays:
        changed = dict(arrays)
    changed[column] = changed[column].copy()
    changed[column][5] = np.nextafter(changed[column][5], 9e9)
    np.savez(path, **changed)
    try:
        with pytest.raises(RunError, match=r"not the same when it was replayed \(from 0.25 s on\)"):
            show_again(run, NAME, mishaps_of(load_recorded(run, NAME).record), "auto")
    finally:
        path.write_bytes(original)


def test_a_replay_without_measures_has_no_result(run: Path) -> None:
    """It ends when the recorded one did, and its result raises UsageError."""
    recorded = load_recorded(run, NAME)
    episode, policy = replay_episode(recorded, without_measures=True)
    with episode:
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(policy.act(observation))
        assert episode.moment.tick == recorded.record.ticks
    with pytest.raises(UsageError, match="no measures"):
        episode.result()
