"""Runs of users' scenarios: the shipped examples, and sweeps with their table and picture."""

from __future__ import annotations

import itertools
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from cosim.core.errors import MachineError
from cosim.report.curves import draw_curves, top_of
from cosim.results.metrics import METRICS
from cosim.results.table import summary_of
from scenarios.suites.user_scenarios.read import OwnFile, read_own
from scenarios.suites.user_scenarios.sweep import summary_of_sweep, write_sweep
from tests.conftest import ROOT, Cosim
from tests.support.drawn_text import clipped_texts

EXAMPLES = ROOT / "scenarios" / "examples"
SHORTER = {
    "seeds = 3 ": "seeds = 1 ",
    "[0, 5, 10, 20]": "[0, 20]",
    "time_s = 120": "time_s = 2",
    "time_s = 180": "time_s = 2",
}


@pytest.fixture
def swept() -> tuple[OwnFile, pd.DataFrame]:
    """Return a sweep over density and goal, and a result table in which half of the episodes at
    density 20 fail."""
    own = read_own(EXAMPLES / "density-sweep.toml")
    table = pd.DataFrame(
        index=range(len(own.variants)), columns=["scenario", "status", *METRICS], dtype=object
    )
    table["scenario"], table["status"] = [variant.id for variant in own.variants], "done"
    dense = np.array([variant.at["crowd.density"] == 20 for variant in own.variants])
    failed = dense & (np.arange(len(dense)) % 2 == 0)
    table["success"], table["failures"], table["rated_m"] = 1.0 - failed, 1.0 * failed, 40.0
    return own, table


def test_a_sweep_equals_the_summary_of_a_run_for_each_value(
    swept: tuple[OwnFile, pd.DataFrame],
) -> None:
    """Means, pooled rates and intervals of one value are those of a run of its episodes alone."""
    own, table = swept
    summary = summary_of_sweep(own, table).set_index(["crowd.density", "metric"])
    assert list(dict.fromkeys(summary.index.get_level_values(0))) == [0, 5, 10, 20]
    for density in (0, 20):
        ids = [variant.id for variant in own.variants if variant.at["crowd.density"] == density]
        alone = summary_of(table[table["scenario"].isin(ids)])
        pd.testing.assert_frame_equal(
            summary.loc[density][list(alone.columns)], alone, check_dtype=False
        )
    assert (
        summary.loc[(0, "success"), "mean"] == 1.0
        and 0.0 < summary.loc[(20, "success"), "mean"] < 1.0
    )
    rate = summary.loc[(20, "failures_per_100m")]
    assert rate["mean"] == pytest.approx(100.0 * table["failures"].sum() / 120.0) and rate["n"] == 3


def test_a_sweep_is_written_as_table_and_picture(
    swept: tuple[OwnFile, pd.DataFrame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without matplotlib only the table is written, and a missing folder is named."""
    own, table = swept
    summary = summary_of_sweep(own, table)
    assert [path.name for path in write_sweep(summary, own, tmp_path)] == ["sweep.csv", "sweep.png"]
    read = pd.read_csv(tmp_path / "sweep.csv")
    assert set(read["metric"]) == set(METRICS) and list(read.columns)[:4] == [
        "crowd.density",
        "episodes",
        "crashed",
        "invalid",
    ]
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(MachineError, match=r"nowhere.sweep.csv: cannot be written"):
        write_sweep(summary, own, tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MachineError, match="matplotlib is missing: `pip install matplotlib`"):
        write_sweep(summary, own, tmp_path / "bare")
    assert [path.name for path in (tmp_path / "bare").iterdir()] == ["sweep.csv"]


LONG = [f"a-map-with-quite-a-long-name-{k}" for k in range(12)]


@pytest.mark.parametrize(
    "fields",
    [
        {"crowd.density": [0, 10]},
        {"place.map": LONG},
        {"light.hour": [f"hour {k}" for k in range(60)]},
        {"crowd.density": [0, 10], "place.map": LONG, "robot": ["courier"]},
    ],
    ids=["numbers", "long names", "many names", "long lines"],
)
def test_no_text_of_a_sweeps_picture_is_cut_off(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, list[Any]]
) -> None:
    """Names of values, fields, lines and the file lie within the picture and do not overlap."""
    metrics = ("success", "failures_per_100m", "time_to_goal_s")
    rows = [
        dict(zip(fields, at, strict=True))
        | {"metric": metric, "mean": 0.5, "low": 0.2, "high": 0.7, "n": 3}
        for at in itertools.product(*fields.values())
        for metric in metrics
    ]
    assert (
        clipped_texts(
            monkeypatch, lambda: draw_curves(pd.DataFrame(rows), [*fields], metrics * 2, "x" * 150)
        )
        == []
    )


def test_metrics_without_a_value_have_no_panel(monkeypatch: pytest.MonkeyPatch) -> None:
    """On suites without people no empty panel shows distances to people."""
    titles: list[str] = []
    monkeypatch.setattr(Axes, "set_title", lambda self, title, **_: titles.append(title))
    rows = [
        {"weather": name, "metric": metric, "mean": mean, "low": mean, "high": mean, "n": 9}
        for name in ("clear", "snow")
        for metric, mean in (("success", 0.5), ("pedestrian_distance_min_m", math.nan))
    ]
    draw_curves(pd.DataFrame(rows), ["weather"], ["success", "pedestrian_distance_min_m"], "unit")
    assert titles == ["success (SR)"]


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the examples in a separate folder, shortened for the tests."""
    folder = tmp_path_factory.mktemp("own") / "examples"
    shutil.copytree(EXAMPLES, folder)
    for path in folder.glob("*.toml"):
        text = path.read_text()
        for long, short in SHORTER.items():
            text = text.replace(long, short)
        path.write_text(text)
    return folder


@pytest.mark.engine
@pytest.mark.parametrize("name", ["morning-crossing", "own-map"])
def test_an_example_is_valid_and_runs(examples: Path, name: str, cosim: Cosim) -> None:
    """Two examples run, and their rows have the hashes that `check` prints."""
    done = cosim("scenario", "check", f"{name}.toml", cwd=examples)
    assert done.returncode == 0, done.stderr
    ran = cosim(
        "scenario", "run", f"{name}.toml", "--policy", "schedule:stand", "--out", name, cwd=examples
    )
    assert ran.returncode == 0 and f"Run folder: {name}" in ran.stdout, ran.stderr
    row = pd.read_csv(examples / name / "results.csv").iloc[0]
    assert row["suite"] == row["scenario"] == name and row["scenario_hash"] in done.stdout
    assert row["status"] == "done"
    assert cosim("show", name, cwd=examples).returncode == 0


@pytest.mark.engine
def test_a_sweep_is_one_command(examples: Path, cosim: Cosim) -> None:
    """One command leads from a file to a table by density and a picture; it can be resumed until
    the file is edited."""
    words = (
        "scenario",
        "run",
        "density-sweep.toml",
        "--policy",
        "schedule:stand",
        "--out",
        "swept",
    )
    ran = cosim(*words, cwd=examples)
    assert ran.returncode == 0, ran.stderr
    head, *_ = (line for line in ran.stdout.splitlines() if "SR" in line)
    assert head.split() == ["density", "n", "crashed", "SR", "SPL", "RC", "FC", "/100m"]
    assert {"run.json", "results.csv", "sweep.csv", "sweep.png"} <= {
        path.name for path in (examples / "swept").iterdir()
    }
    assert pd.read_csv(examples / "swept" / "sweep.csv")["crowd.density"].unique().tolist() == [
        0,
        20,
    ]
    scored = cosim("score", "swept", cwd=examples)
    assert scored.returncode == 0 and "equal to the bit" in scored.stdout, scored.stderr
    (examples / "swept" / "sweep.png").unlink()
    again = cosim(*words, "--resume", cwd=examples)
    assert again.returncode == 0 and (examples / "swept" / "sweep.png").exists(), again.stderr
    path = examples / "density-sweep.toml"
    path.write_text(path.read_text().replace("[0, 20]", "[0, 25]"))
    other = cosim(*words, "--resume", cwd=examples)
    assert other.returncode == 2 and "is of another run" in other.stderr


@pytest.mark.engine
def test_a_sweep_over_goal_protocols_is_one_run_each(tmp_path: Path, cosim: Cosim) -> None:
    """Each goal protocol has a run folder, all with one seed and in real time, and one table. A
    recording of several is refused before anything runs."""
    (tmp_path / "told.toml").write_text(
        'name = "told"\ngoal_protocol = ["route_point", "final_point"]\n'
        '[place]\ncity = 1\nsize_m = 500\n[way]\nkind = "straight"\n[limits]\ntime_s = 0.5\n'
    )
    words = ("scenario", "run", "told.toml", "--policy", "schedule:stand", "--out", "runs")
    done = cosim(*words, "--real-time", cwd=tmp_path)
    assert done.returncode == 0 and "goal_protocol" in done.stdout, done.stderr
    rows = pd.concat(
        pd.read_csv(tmp_path / "runs" / goal / "results.csv")
        for goal in ("route_point", "final_point")
    )
    assert (
        rows["goal_protocol"].tolist() == ["route_point", "final_point"]
        and rows["run_seed"].nunique() == 1
    )
    assert rows["real_time"].all() and rows["answer_ms"].notna().all()
    assert len(pd.read_csv(tmp_path / "runs" / "sweep.csv")) == 2 * len(METRICS)
    several = cosim(*words[:-1], "others", "--rerun", "both.rrd", cwd=tmp_path)
    assert (
        several.returncode == 2
        and "and 2 are chosen" in several.stderr
        and not (tmp_path / "others").exists()
    )
    refused = cosim("run", "told.toml", cwd=tmp_path)
    assert refused.returncode == 2 and "goal_protocol 'route_point' is of a run" in refused.stderr


def test_an_axis_has_room_above_means_without_intervals() -> None:
    """The axis ends above the means, also where some or all values are unknown."""
    rows = pd.DataFrame({"mean": [10.3, 10.7, np.nan], "high": [np.nan, np.nan, np.nan]})
    assert top_of(rows) > 11.0
    assert top_of(rows.assign(high=14.0)) > 15.0
    assert top_of(rows[2:]) == top_of(rows[:0]) == 1.0
