"""`cosim look` and `cosim film` as a user runs them."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import av
import cv2
import msgspec
import numpy as np
import pytest

from cosim.core.errors import RunError
from cosim.episode.interfaces import Observation
from cosim.place.walk_graph import WalkGraph
from cosim.policies.baselines import Replay
from cosim.report.encoding import Video
from cosim.report.hud import Layout
from cosim.report.minimap import PLANNED
from cosim.results.record import Recorder
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec, Suite, write_suite
from physics.cameras.camera_base import WorldCamera
from scenarios.tools.viewing.film import failure_to_film
from tests.conftest import Cosim
from tests.support.driven_runs import HIT, run_of, short_way

pytestmark = pytest.mark.engine


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, cosim: Cosim) -> Path:
    """A folder with a suite of one short scenario, and a run of it."""
    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    folder = tmp_path_factory.mktemp("workspace")
    city = City(seed=1, size_m=500.0)
    _, street_map = place(city)
    scenario = build_long_horizon(city, street_map, WalkGraph(street_map), 0, "t-0")
    short = msgspec.structs.replace(
        scenario,
        crowd=CrowdSpec(persons=8, radius_m=50.0, vehicles=2),
        time_limit_s=2.0,
        robot="courier",
    )
    write_suite(Suite(name="tiny", version="1", scenarios=(short,)), folder / "tiny.json")
    done = cosim(
        "run",
        "tiny.json",
        "--policy",
        "tests.support.blind_policy:Blind",
        "--out",
        "run",
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_a_film_shows_the_requested_seconds(
    workspace: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has 20 pictures a second of the requested size, all different, playable, with waypoints on
    map and picture from 1 s on."""
    drawn = []
    add = Video.add
    monkeypatch.setattr(
        Video, "add", lambda self, image: drawn.append(image.copy()) or add(self, image)
    )
    words = (
        "film",
        "run",
        "t-0",
        "--from",
        "1",
        "--to",
        "2",
        "--size",
        "320x180",
        "-o",
        "film.mp4",
    )
    done = cosim(*words, cwd=workspace)
    assert done.returncode == 0, done.stderr
    with av.open(str(workspace / "film.mp4")) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == 20 and pictures[0].shape == (180, 320, 3)
    assert all(np.abs(a.astype(int) - b).max() > 10 for a, b in itertools.pairwise(pictures))
    assert not list(workspace.glob("*.part"))
    assert len(drawn) == 20
    for area in (Layout.of(320, 180).second, Layout.of(320, 180).map):
        part = slice(area.y, area.y + area.height), slice(area.x, area.x + area.width)
        assert all((image[part] == PLANNED).all(axis=2).sum() > 5 for image in drawn)


def test_a_film_is_from_above_or_from_the_robot(workspace: Path, cosim: Cosim) -> None:
    """--view selects another picture beside the same map, over the same bar."""
    seen = []
    for view in ("above", "robot"):
        words = (
            "film",
            "run",
            "t-0",
            "--to",
            "0.1",
            "--size",
            "320x180",
            "--view",
            view,
            "-o",
            f"{view}.mp4",
        )
        done = cosim(*words, cwd=workspace)
        assert done.returncode == 0, done.stderr
        with av.open(str(workspace / f"{view}.mp4")) as film:
            seen.append(next(film.decode(video=0)).to_ndarray(format="rgb24").astype(float))
    layout = Layout.of(320, 180)
    apart = np.abs(seen[0] - seen[1]).mean(axis=2)
    assert apart[: layout.view.height, : layout.view.width].mean() > 15
    assert apart[layout.map.y + 4 : layout.bar.y - 4, layout.map.x + 4 :].mean() < 3


def test_a_film_of_a_failure_ends_with_it(workspace: Path, cosim: Cosim) -> None:
    """Without an episode the first failed one is filmed, from any view, and time and reason are
    printed."""
    words = (
        "film",
        "run",
        "--failure",
        "--from",
        "1.8",
        "--view",
        "above",
        "--size",
        "320x180",
        "-o",
        "failure.mp4",
    )
    done = cosim(*words, cwd=workspace)
    assert done.returncode == 0, done.stderr
    assert "t-0, 2.0 s: ran out of time after 2 s, with " in done.stdout
    with av.open(str(workspace / "failure.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 4


def test_a_film_of_the_beginning_is_not_simulated_to_the_end(
    workspace: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulation ends with the last picture, nothing is drawn before the first, and progress is
    reported."""
    simulated = []
    drawn = []
    add, render = Recorder.add, WorldCamera.render
    monkeypatch.setattr(
        Recorder, "add", lambda self, *arguments: simulated.append(add(self, *arguments))
    )
    monkeypatch.setattr(
        WorldCamera, "render", lambda self, *arguments: drawn.append(0) or render(self, *arguments)
    )
    done = cosim(
        "film",
        "run",
        "t-0",
        "--from",
        "0.5",
        "--to",
        "0.7",
        "--size",
        "320x180",
        "-o",
        "cut.mp4",
        cwd=workspace,
    )
    assert done.returncode == 0, done.stderr
    assert (len(simulated), len(drawn)) == (14, 4)
    assert done.stderr.splitlines()[-2:] == ["simulating to 0.5 s ...", "filming t-0 ..."]
    assert "of its first 0.7 s every tick is as recorded" in done.stdout


@pytest.mark.parametrize("column", ["pose", "person_m", "reset_s_m"])
def test_a_cut_that_differs_from_its_record_is_not_filmed(
    workspace: Path, cosim: Cosim, column: str
) -> None:
    """One changed bit of a tick is an error with the time and no file; beyond the cut it does not
    matter."""
    path = workspace / "run" / "episodes" / "t-0" / "trajectory.npz"
    original = path.read_bytes()
    with np.load(path) as arrays:
        changed = dict(arrays)
    changed[column] = changed[column].copy()
    changed[column][5] = np.nextafter(changed[column][5], 9e9) if column != "reset_s_m" else 1.0
    np.savez(path, **changed)
    words = ("film", "run", "t-0", "--size", "320x180", "--speed", "4")
    try:
        until, beyond = (
            cosim(*words, "--to", "0.2", "-o", "until.mp4", cwd=workspace),
            cosim(*words, "--to", "0.5", "-o", "beyond.mp4", cwd=workspace),
        )
    finally:
        path.write_bytes(original)
    assert until.returncode == 0 and (workspace / "until.mp4").exists(), until.stderr
    assert (
        beyond.returncode == 2
        and "not the same when it was replayed (from 0.25 s on)" in beyond.stderr
    )
    assert not list(workspace.glob("beyond*"))
    assert "of the same versions: of other code" in beyond.stderr


def test_a_record_that_does_not_replay_is_not_filmed(workspace: Path, cosim: Cosim) -> None:
    """A record of another episode is an error, without a file."""
    path = workspace / "run" / "episodes" / "t-0" / "record.json"
    original = path.read_bytes()
    record = json.loads(original)
    path.write_text(json.dumps(record | {"state_hash": "0" * len(record["state_hash"])}))
    try:
        done = cosim(
            "film",
            "run",
            "t-0",
            "--from",
            "1.9",
            "--size",
            "320x180",
            "-o",
            "wrong.mp4",
            cwd=workspace,
        )
    finally:
        path.write_bytes(original)
    assert done.returncode == 2 and "not the same when it was replayed" in done.stderr
    assert "of the same versions: of other code" in done.stderr
    assert not list(workspace.glob("wrong*"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("film", "run", "t-9"), "unknown finished episode"),
        (("film", "run"), "name one of its episodes, or give --failure: t-0"),
        (("film", "run", "t-9", "--failure"), "unknown finished episode"),
        (("film", "run", "t-0", "--from", "99"), "nothing to film"),
        (("film", "run", "t-0", "--from", "1", "--to", "nan"), "give a later --to"),
        (("film", "run", "t-0", "--size", "wide"), "--size wide"),
        (("film", "run", "t-0", "--size", "321x181"), "both sides must be even"),
        (("film", "run", "t-0", "--size", "64x64"), "nothing can be read"),
        (("film", "run", "t-0", "-o", "film.gif"), "ends in .mp4"),
        (("film", "run", "t-0", "-o", "nowhere/film.mp4"), "cannot be written"),
        (("film", "run", "t-0", "--view", "inside"), "unknown view"),
        (("look", "t-0", "--suite", "tiny.json", "--view", "inside"), "unknown view"),
        (("look", "t-9", "--suite", "tiny.json"), "unknown scenario"),
        (("look", "t-9"), "unknown scenario 't-9'. Valid choices: 2250, among them"),
        (
            ("look", "t-0", "--suite", "tiny.json", "--scenario", "2"),
            "--scenario chooses from a suite or a file",
        ),
        (("look", "tiny.json", "--suite", "tiny.json"), "or a file: leave --suite out"),
        (("look", "unit", "--scenario", "999"), "unknown scenario '999'. Valid choices: 330"),
        (("look", "tiny.json", "--scenario", "t-9"), "unknown scenario 't-9'. Valid choices: t-0"),
        (
            ("look", "tiny.json", "--scenario", "2"),
            "unknown scenario '2'. Valid choices: t-0. Or its number",
        ),
        (("look", "nowhere.toml"), "nowhere.toml: cannot be read: No such file"),
        (
            ("look", "t-0", "--suite", "tiny.json", "-o", "look.gif"),
            "use a name that ends in .png or .jpg",
        ),
        (("look", "t-0", "--suite", "tiny.json", "-o", "nowhere/look.png"), "written"),
    ],
)
def test_invalid_film_and_look_requests_are_refused(
    workspace: Path, cosim: Cosim, words: tuple[str, ...], expected: str
) -> None:
    """The exit code is 2, or 3 for the machine's faults, with one message and no traceback."""
    done = cosim(*words, cwd=workspace)
    assert (
        done.returncode == (3 if "written" in expected else 2)
        and expected in done.stderr
        and "Traceback" not in done.stderr
    )
    assert "starting" not in done.stderr or words[0] == "film"


def test_a_look_is_a_picture_of_its_moment(workspace: Path, cosim: Cosim) -> None:
    """From the robot or from above the picture has the requested size and content, and progress is
    printed."""
    seen = {}
    for name, words in {
        "start": ("--at", "0"),
        "above": ("--at", "1", "--view", "above"),
    }.items():
        done = cosim(
            "look",
            "t-0",
            "--suite",
            "tiny.json",
            *words,
            "--size",
            "160x90",
            "-o",
            f"{name}.png",
            cwd=workspace,
        )
        assert done.returncode == 0, done.stderr
        driven = ["simulating to 1 s"] if name == "above" else []
        stages = [
            "choosing the camera",
            "reading the street map",
            "starting SUMO",
            *driven,
            "drawing",
        ]
        lines = done.stderr.splitlines()
        assert len(lines) == len(stages) and all(map(str.startswith, lines, stages))
        seen[name] = cv2.imread(str(workspace / f"{name}.png"))
        assert seen[name].shape == (90, 160, 3) and seen[name].std() > 10
    assert (seen["start"] != seen["above"]).mean() > 0.5


def test_a_look_at_a_scenario_file_needs_no_suite(workspace: Path, cosim: Cosim) -> None:
    """Of a sweep only the first, named or numbered scenario is built, and its faults are listed."""
    text = (
        'name = "mine"\nseeds = 2\n[place]\ncity = 1\nsize_m = 500\n[way]\nkind = '
        '"straight"\nlength_m = 30\n'
    )
    text += '[[events]]\nkind = "frontal"\nat_m = [25, 2]\n'
    (workspace / "mine.toml").write_text(text)
    for words, expected in {
        (): "mine-at_m25-s0 at 0.00 s, robot; 1 of 4 scenarios: --scenario chooses another)",
        ("--scenario", "2"): "mine-at_m25-s1 at",
        ("--scenario", "mine-at_m25-s1"): "mine-at_m25-s1 at",
    }.items():
        done = cosim(
            "look", "mine.toml", *words, "--size", "160x90", "-o", "mine.png", cwd=workspace
        )
        assert done.returncode == 0 and expected in done.stdout, done.stderr
        assert cv2.imread(str(workspace / "mine.png")).std() > 10
    done = cosim("look", "mine.toml", "--scenario", "3", "-o", "none.png", cwd=workspace)
    assert done.returncode == 2 and "mine.toml: events[0]: at_m 2 does not do" in done.stderr
    done = cosim("look", "mine.toml", "--scenario", "mine", "-o", "none.png", cwd=workspace)
    assert (
        done.returncode == 2
        and "unknown scenario 'mine'. Valid choices: mine-at_m2-s0, mine-" in done.stderr
    )


def test_the_failure_of_an_episode_is_chosen_and_cut_out(tmp_path: Path) -> None:
    """The run's first failed or the named episode is cut from 10 s before its failure to 2 s after;
    others are refused with their outcome."""
    ways = [short_way(f"s-{k}", ends_on_failure=False) for k in range(3)]
    run = run_of(tmp_path / "run", ["goal", HIT, HIT], scenarios=ways)
    first = failure_to_film(run, None)
    named = failure_to_film(run, "s-2")
    assert (first.scenario, named.scenario) == ("s-1", "s-2")
    assert first.at_s == 4.0 and (first.from_s, first.to_s) == (0.0, 6.0)
    assert first.reason == "drove into a wall at 1.0 m/s"
    with pytest.raises(
        RunError, match=r"'s-0' did not fail: it ended at the goal. Episodes that failed: s-1, s-2$"
    ):
        failure_to_film(run, "s-0")
    sound = run_of(tmp_path / "sound", ["goal", "goal", "crashed", "invalid"])
    with pytest.raises(
        RunError, match=r"sound: no episode failed: 2 succeeded, 1 crashed, 1 invalid"
    ):
        failure_to_film(sound, None)


def test_a_video_that_failed_leaves_nothing(tmp_path: Path) -> None:
    """An exception during the encoding leaves no complete or partial file."""
    with pytest.raises(KeyError), Video(tmp_path / "film.mp4", (64, 48), 20) as video:
        video.add(np.zeros((48, 64, 3), dtype=np.uint8))
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_a_replay_ends_with_its_record() -> None:
    """A replay has no figures beyond the last recorded tick."""
    replay = Replay(np.array([[1.0, 0.2]]))
    assert replay.act(Observation(0, 0.0, None, 0.0, 0.0, COURIER)).w_radps == 0.2
    with pytest.raises(RunError, match="ends after 1 ticks"):
        replay.act(Observation(1, 0.05, None, 0.0, 0.0, COURIER))
