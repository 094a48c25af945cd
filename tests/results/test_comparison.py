"""Comparisons of runs: groups, changed outcomes, exports, and refusals."""

from __future__ import annotations

import io
import json
import os
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from cosim.cli.run_table import print_table
from cosim.report.compared import (
    as_latex,
    as_markdown,
    flips_in_words,
    summary_by_weather,
    table_by_weather,
    tables_of_comparison,
)
from cosim.results.compare import (
    RunComparison,
    compare_runs,
    groups_of,
)
from cosim.results.metrics import METRICS, WORST
from cosim.results.record import Record, ScanLook
from cosim.results.run_folder import RunFolder, read_records, read_spec
from cosim.results.table import table_of, table_row
from cosim.results.verified_run import read_verified_run
from cosim.spec.camera import CameraSpec
from cosim.spec.events import Event
from cosim.spec.scenario import Scenario, read_suite
from tests.conftest import Cosim
from tests.run_specs import changed
from tests.support.driven_runs import HIT, run_of, short_way

GOALS = "goal"


def scenarios_of(count: int) -> tuple[Scenario, ...]:
    """Scenarios, half straight, half curves; every fifth in test; every fourth with a `frontal`
    event."""

    def one(i: int) -> Scenario:
        event = Event(
            id="e0",
            kind="frontal",
            x_m=5.0,
            y_m=0.0,
            heading_rad=0.0,
            route_s_m=5.0,
            half_width_m=1.5,
        )
        return short_way(
            f"s-{i:03d}",
            structure="straight" if i % 2 else "curve",
            split="test" if i % 5 == 0 else "val",
            ends_at="goal",
            events=(event,) if i % 4 == 0 else (),
            ends_on_failure=i % 4 != 0,
        )

    return tuple(one(i) for i in range(count))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 scenarios by three policies: `a` solves half; `b` nearly all; `c` is as `a` with one crash
    and one invalid episode."""
    folder = tmp_path_factory.mktemp("runs")
    a = [GOALS if i % 2 else HIT for i in range(20)]
    b = [GOALS if i % 2 or i < 18 else HIT for i in range(20)]
    b[19] = HIT
    c = [*a[:10], "crashed", "invalid", *a[12:]]
    for name, hows in (("a", a), ("b", b), ("c", c)):
        run_of(folder / name, hows, name, scenarios_of(20))
    return folder


def row(
    comparison: RunComparison, metric: str, group: str = "s", after: str = "b"
) -> pd.Series[float]:
    table = comparison.differences
    (one,) = table.index[
        (table["metric"] == metric) & (table["group"] == group) & (table["after"] == after)
    ]
    found: pd.Series[float] = table.loc[one]
    return found


def test_groups_are_suite_event_structure_and_split() -> None:
    """Each scenario is in every group that it belongs to, and groups of the same scenarios appear
    once."""
    groups = groups_of("s", scenarios_of(20))
    assert [*groups] == [
        ("suite", "s"),
        ("event", "frontal"),
        ("structure", "curve"),
        ("structure", "straight"),
        ("split", "test"),
        ("split", "val"),
    ]
    assert groups["event", "frontal"] == {f"s-{i:03d}" for i in (0, 4, 8, 12, 16)}
    assert len(groups["split", "test"]) == 4 and len(groups["suite", "s"]) == 20
    assert [*groups_of("s", scenarios_of(1))] == [("suite", "s")]


def test_a_run_is_compared_scenario_by_scenario(runs: Path) -> None:
    """Nine won and one lost of twenty are listed by name, and in every group."""
    comparison = compare_runs([runs / "a", runs / "b"])
    success = row(comparison, "success")
    assert (success["value_before"], success["value_after"], success["n"], success["changed"]) == (
        0.5,
        0.9,
        20,
        10,
    )
    assert success["low"] > 0.0 and success["verdict"] == "better"
    assert row(comparison, "failures")["verdict"] == "better" and row(comparison, "failures")[
        "difference"
    ] == pytest.approx(-0.4)
    assert (
        row(comparison, "success", "curve")["difference"] == 0.9
        and row(comparison, "success", "straight")["changed"] == 1
    )
    rate = row(comparison, "failures_per_100m")
    metres = [
        compare_runs([runs / "a", runs / name]).others[0].table["path_length_m"].sum()
        for name in ("a", "b")
    ]
    assert (rate["value_before"], rate["value_after"]) == pytest.approx(
        (1000.0 / metres[0], 200.0 / metres[1])
    )
    won, lost = flips_in_words(comparison, comparison.others[0])
    assert won == "solved by b alone, 9: " + ", ".join(f"s-{i:03d}" for i in range(0, 18, 2))
    assert lost == "solved by a alone, 1: s-019"
    assert comparison.flipped.loc[
        comparison.flipped["flip"] == "lost", ["ended_before", "ended_after"]
    ].values.tolist() == [["goal", "failure"]]


def test_runs_under_other_conditions_get_no_verdict(
    runs: Path, tmp_path: Path, cosim: Cosim
) -> None:
    """Another goal protocol, odometry, sensor track or latency is named; differences remain,
    without a verdict."""
    run = rewritten(
        runs / "b",
        tmp_path / "b",
        goal_protocol="route_point",
        odometry="exact",
        privileged=True,
        latency_ms=200.0,
    )
    comparison = compare_runs([runs / "a", run])
    assert {*comparison.differences["verdict"]} <= {"within noise", "too few", "differs", ""}
    assert (
        row(comparison, "success")["verdict"] == "differs"
        and row(comparison, "success")["low"] > 0.0
    )
    (note,) = comparison.notes
    assert note == (
        "No verdict of b against a: they drove by other terms, goal none (a) and route_point (b); "
        "odometry none (a) and exact (b); sensor track blind (a) and privileged (b); "
        "latency 0 ms (a) and 200 ms (b). What differs is called neither better nor worse"
    )
    result = cosim("compare", str(runs / "a"), str(run))
    assert result.returncode == 0 and note in result.stdout
    assert re.search(r"success +0\.50 +0\.90 +\+0\.400 .* 20  differs", result.stdout)


def test_runs_by_other_robots_are_paired_without_a_verdict(runs: Path, tmp_path: Path) -> None:
    """Runs of two robots are paired by scenario and named by robot, and no difference is called
    better or worse."""
    courier = run_of(tmp_path / "c", [HIT] * 20, "p", scenarios_of(20))
    dog = run_of(tmp_path / "d", [GOALS] * 20, "p", scenarios_of(20), robot="dog")
    comparison = compare_runs([courier, dog])
    assert (comparison.before.label, comparison.others[0].label) == ("p, courier", "p, dog")
    assert {*comparison.differences["verdict"]} <= {"within noise", "too few", "differs", ""}
    success = row(comparison, "success", after="p, dog")
    assert (success["n"], success["difference"], success["verdict"]) == (20, 1.0, "differs")
    assert any(
        "No verdict of p, dog against p, courier" in note
        and "robot courier (p, courier) and dog (p, dog)" in note
        for note in comparison.notes
    )


def test_runs_in_other_weathers_get_a_table_and_a_plot_but_no_verdict(
    tmp_path: Path, cosim: Cosim
) -> None:
    """A run in rain is named, cannot resume one in clear weather, has no verdict, and is in a table
    by weather."""
    ways = scenarios_of(20)
    clear = run_of(tmp_path / "c", [GOALS] * 20, "p", ways)
    rain = run_of(tmp_path / "r", [HIT] * 20, "p", ways, weather="rain")
    difference = read_spec(clear).difference_from(read_spec(rain))
    assert difference is not None and difference[:3] == ("weather", "", "rain")
    comparison = compare_runs([clear, rain])
    assert (comparison.before.label, comparison.others[0].label) == ("p, own weather", "p, rain")
    assert {*comparison.differences["verdict"]} <= {"within noise", "too few", "differs", ""}
    assert any("weather clear (p, own weather) and rain (p, rain)" in n for n in comparison.notes)
    result = cosim("compare", str(clear), str(rain), "-o", str(tmp_path / "weather.png"))
    assert result.returncode == 0, result.stderr
    assert re.search(r"clear +p +1\.00 .*\n rain +p +0\.00 ", result.stdout)
    assert (tmp_path / "weather.png").read_bytes().startswith(b"\x89PNG")
    result = cosim(
        "compare", str(clear), str(rain), "-o", str(tmp_path / "p.png"), "--by", "policy"
    )
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG"), result.stderr
    printed = io.StringIO()
    table = table_of(read_verified_run(rain).records.values())
    print_table(Console(file=printed, width=200), table, 20, rain)
    assert printed.getvalue().count("weather rain") == 1


def test_runs_of_one_policy_in_one_weather_keep_their_names(tmp_path: Path) -> None:
    """Two runs in clear weather and a third in rain give three rows by weather."""
    ways = scenarios_of(20)
    runs = [
        run_of(tmp_path / "first", [GOALS] * 20, "p", ways),
        run_of(tmp_path / "second", [HIT] * 20, "p", ways),
        run_of(tmp_path / "rain", [HIT] * 20, "p", ways, weather="rain"),
    ]
    rows = table_by_weather(summary_by_weather(compare_runs(runs))).rows
    assert [row[:3] for row in rows] == [
        ("clear", "first", "1.00 (0.84 to 1.00)"),
        ("clear", "second", "0.00 (0.00 to 0.16)"),
        ("rain", "rain", "0.00 (0.00 to 0.16)"),
    ]


def test_below_five_scenarios_a_weather_has_counts(tmp_path: Path) -> None:
    """As in all tables, there is no decimal and no interval."""
    ways = scenarios_of(3)
    hows = {"clear": [GOALS, GOALS, HIT], "rain": [HIT] * 3}
    runs = [run_of(tmp_path / name, how, "p", ways, weather=name) for name, how in hows.items()]
    rows = table_by_weather(summary_by_weather(compare_runs(runs))).rows
    assert [row[2] for row in rows] == ["2/3", "0/3"]


def test_another_renderer_of_the_pictures_is_noted(runs: Path, tmp_path: Path) -> None:
    """Two runs with a camera, drawn by a processor and by a GPU, have a note; blind ones none."""
    seeing = rewritten(runs / "b", tmp_path / "seeing", camera={"width": 64, "height": 48})
    drawn = rewritten(seeing, tmp_path / "drawn")
    path = drawn / "run.json"
    path.write_text(re.sub(r'"renderer": ?"[^"]*"', '"renderer":"gl: a GPU"', path.read_text()))
    assert compare_runs([runs / "a", runs / "b"]).notes == ()
    assert any("by gl: a GPU: a small" in note for note in compare_runs([seeing, drawn]).notes)


@pytest.mark.parametrize("track", ["lidar", "people"])
def test_runs_of_other_sensor_tracks_get_no_verdict_but_blind_ones_do(
    runs: Path, tmp_path: Path, track: str
) -> None:
    """Lidar and tracked people are not compared with a camera, a blind baseline is; older records
    are read as before."""
    sensors: dict[str, object] = {"lidar": {}} if track == "lidar" else {"people": "seen"}
    sensing = rewritten(runs / "b", tmp_path / "sensing", **sensors)
    seeing = rewritten(runs / "b", tmp_path / "seeing", camera={"width": 64, "height": 48})
    (apart,) = compare_runs([seeing, sensing]).notes
    assert f"sensor track picture (seeing) and {track} (sensing)" in apart
    blind = compare_runs([runs / "a", sensing])
    assert blind.notes == () and row(blind, "success")["verdict"] == "better"
    assert {*blind.others[0].table["track"]} == {track}
    path = next((runs / "a").glob("episodes/*/record.json"))
    old = {
        key: value
        for key, value in json.loads(path.read_bytes()).items()
        if key not in ("lidar", "imu", "people")
    }
    assert table_row(Record.decoded(json.dumps(old).encode(), path))["track"] == "blind"


def test_another_camera_is_noted_and_the_verdict_stays(runs: Path, tmp_path: Path) -> None:
    """The camera is the policy's own choice; a run without one is a blind baseline without a note."""
    small, large = (
        rewritten(runs / name, tmp_path / name, camera=CameraSpec(width, 48))
        for name, width in (("a", 64), ("b", 96))
    )
    comparison = compare_runs([small, large])
    assert row(comparison, "success")["verdict"] == "better"
    a, b = (f"front, {width} x 48 px, 75 deg, at 4 Hz" for width in (64, 96))
    assert f"a sees by {a}; b by {b}: a difference may be the camera's" in comparison.notes
    assert not any("sees by" in note for note in compare_runs([runs / "a", large]).notes)


def test_another_look_of_a_scan_is_reported(runs: Path, tmp_path: Path) -> None:
    """Splats against mesh, other splats and another sun are named; equal looks are not."""
    looks = {
        "a": ScanLook(
            appearance="splats",
            splats="0123456789abcdef",
            sun_azimuth_deg=215.0,
            sun_elevation_deg=38.0,
        ),
        "b": ScanLook(appearance="mesh"),
    }
    a, b = (rewritten(runs / name, tmp_path / name, scan=look) for name, look in looks.items())
    assert (
        "a and b saw scanned places differently, a difference may be the look's (--appearance, or "
        "another import): in s-000, splats 0123456789abcdef with the sun at 215, 38 and the mesh "
        "without sun"
    ) in compare_runs([a, b]).notes
    same = rewritten(runs / "b", tmp_path / "same", scan=looks["a"])
    assert not any("saw scanned" in note for note in compare_runs([a, same]).notes)
    assert not any("saw scanned" in note for note in compare_runs([a, runs / "b"]).notes)


def test_a_run_with_injected_pedestrians_is_marked(
    runs: Path, tmp_path: Path, cosim: Cosim
) -> None:
    """results.csv, table and comparison mark it, and a run without them has no such column."""
    injected = rewritten(
        runs / "a", tmp_path / "a", "s-001", injections=[{"tick": 3, "injection": EVE}]
    )
    table = pd.read_csv(injected / "results.csv")
    assert dict(zip(table["scenario"], table["injected"], strict=True)) == {
        f"s-{i:03d}": int(i == 1) for i in range(20)
    }
    assert "injected" not in pd.read_csv(runs / "a" / "results.csv")
    words = "pedestrians were injected into 1 episode (s-001)"
    shown = cosim("show", str(injected)).stdout
    assert "s-001+" in shown and words in " ".join(shown.split())
    assert any(words in note for note in compare_runs([runs / "b", injected]).notes)
    assert not any("injected" in note for note in compare_runs([runs / "a", runs / "b"]).notes)


EVE = {"id": "eve", "path": [[4.0, 1.0], [4.0, -1.0]]}


def rewritten(run: Path, target: Path, of: str = "", **fields: object) -> Path:
    """A copy of a run with changed fields in the record of scenario `of`, or in all for ""."""
    with RunFolder.create(target, read_spec(run), read_suite(run / "scenarios.json")) as folder:
        for record in read_records(run):
            other = fields if of in ("", record.scenario.id) else {}
            folder.write_episode(
                changed(record, **other),
                (run / f"episodes/{record.scenario.id}/trajectory.npz").read_bytes(),
            )
        folder.finish()
    return target


def test_a_run_is_within_noise_of_itself(runs: Path, cosim: Cosim) -> None:
    """No metric or group differs, below five scenarios there is no verdict, and a repeated name
    gets a number."""
    comparison = compare_runs([runs / "a", runs / "a"])
    enough, few = (
        comparison.differences[comparison.differences["n"].between(*of)] for of in ((5, 99), (1, 4))
    )
    assert {*enough["verdict"]} == {"within noise"} and {*few["verdict"]} == {""}
    assert (enough[["difference", "low", "high"]] == 0.0).all(axis=None)
    assert few[["low", "high"]].isna().all(axis=None) and {*few["group"]} == {"test"}
    assert (
        not len(comparison.flipped)
        and comparison.notes == ()
        and comparison.others[0].label == "a (2)"
    )
    result = cosim("compare", str(runs / "a"), str(runs / "a"))
    assert result.returncode == 0 and "better" not in result.stdout and "worse" not in result.stdout
    assert "solved by a (2) alone, 0: none" in result.stdout


def test_a_crashing_run_is_compared_at_its_worst_without_rates(runs: Path) -> None:
    """A crash counts as failed and removes its groups' other metrics; an invalid episode is in no
    pair; both are noted."""
    comparison = compare_runs([runs / "a", runs / "c"])
    assert (
        row(comparison, "success", after="c")["n"] == 19
        and row(comparison, "success", after="c")["value_after"] == 9 / 19
    )
    assert (
        row(comparison, "failures_per_100m", after="c")["n"] == 0
        and row(comparison, "failures_per_100m", after="c")["counts_before"] == ""
        and row(comparison, "failures_per_100m", "straight", "c")["n"] == 9
    )
    assert not len(comparison.flipped)
    suite_rows = comparison.differences[comparison.differences["group"] == "s"].set_index("metric")
    ranked = [name for name, metric in METRICS.items() if metric.higher_is_better is not None]
    assert {*suite_rows.index[suite_rows["n"] > 0].intersection(ranked)} == {*WORST}
    assert "better" not in {*comparison.differences["verdict"]}
    assert (
        "c: 1 crashed, counted as failed, with SR, RC, SPL and V of 0; groups with them have "
        "neither rates nor other means" in comparison.notes
    )
    assert (
        "c is not to be quoted: 1 of 20 scheduled episodes are invalid, more than 2 %"
        in comparison.notes
    )


def test_a_run_that_always_crashes_is_better_in_nothing(runs: Path, tmp_path: Path) -> None:
    """Against a run that always fails it has no rates, nothing better, equal SR, and lower
    completion and speed."""
    bad, crashing = (
        run_of(tmp_path / how, [how] * 20, how, scenarios_of(20)) for how in (HIT, "crashed")
    )
    comparison = compare_runs([bad, crashing])
    assert {*comparison.differences["verdict"]} <= {
        "worse",
        "within noise",
        "too few",
        "differs",
        "",
    }
    suite_rows = comparison.differences[comparison.differences["group"] == "s"].set_index("metric")
    assert suite_rows.loc[["route_completion", "velocity_mean_mps"], "verdict"].eq("worse").all()
    assert suite_rows.loc["success", ["value_after", "verdict"]].tolist() == [0.0, "within noise"]
    assert not len(comparison.flipped)


def test_a_comparison_is_printed_and_written(runs: Path, tmp_path: Path, cosim: Cosim) -> None:
    """CSV has every metric in full, Markdown and LaTeX have the printed tables, reproducibly."""
    files = [tmp_path / f"comparison{end}" for end in (".csv", ".md", ".tex")]
    words = [
        "compare",
        *(str(runs / name) for name in "abc"),
        *(w for file in files for w in ("-o", str(file))),
    ]
    result = cosim(*words)
    assert result.returncode == 0, result.stderr
    assert (
        "b (B) against a (A), suite s" in result.stdout
        and "c (B) against a (A), suite s, by" in result.stdout
    )
    assert re.search(
        r"success +0\.50 +0\.90 +\+0\.400 +\+\d\.\d{3} to \+\d\.\d{3} +20 +better", result.stdout
    )
    read = pd.read_csv(files[0], keep_default_na=False, na_values=[""])
    comparison = compare_runs([runs / name for name in "abc"])
    assert read["low"].dropna().tolist() == comparison.differences["low"].dropna().tolist() and len(
        read
    ) == len(comparison.differences)
    assert (
        pd.read_csv(tmp_path / "comparison.flipped.csv")["scenario"].tolist()
        == comparison.flipped["scenario"].tolist()
    )
    assert files[1].read_text() == as_markdown(comparison) and files[2].read_text() == as_latex(
        comparison
    )
    assert not [*tmp_path.glob("*.part")]


def test_below_five_scenarios_a_comparison_shows_counts(runs: Path) -> None:
    """Four scenarios of `test` have counts without interval or verdict in every format; the CSV
    counts larger groups, too."""
    comparison = compare_runs([runs / "a", runs / "b"])
    of_test = row(comparison, "success", "test")
    assert (of_test["counts_before"], of_test["counts_after"]) == ("2/4", "4/4")
    assert np.isnan(of_test["low"]) and of_test["verdict"] == ""
    (_, grouped) = tables_of_comparison(comparison, comparison.others[0])
    by_metric = {cells[1]: cells[2:] for cells in grouped.rows if cells[0] == "test"}
    assert by_metric["SR"] == ("2/4", "4/4", "-", "-", "4", "")
    assert by_metric["FC"] == ("2 in 24 m", "0 in 32 m", "-", "-", "4", "")
    assert by_metric["RC"][0] == "0.72" and by_metric["RC"][-3:] == ("-", "4", "")
    assert "| test     | SR | 2/4 | 4/4 |" in re.sub(" +", " ", as_markdown(comparison)).replace(
        "| test |", "| test     |"
    )
    assert "test & SR & 2/4 & 4/4 & - & - & 4 &" in as_latex(comparison)
    assert row(comparison, "success")["counts_after"] == "18/20"
    assert row(comparison, "route_completion")["counts_after"] == ""


def test_names_are_escaped(runs: Path) -> None:
    """A name of all special characters of LaTeX, Markdown and HTML ends no cell, starts no command,
    and is no tag."""
    odd = r"<script>_a&b|c$1%#{2}~^\input{x}*`d`[e](f)"
    comparison = compare_runs([runs / "a", runs / "b"])
    other = comparison.others[0]._replace(label=odd)
    frames = [
        frame.replace({"b": odd, "frontal": odd})
        for frame in (comparison.differences, comparison.flipped)
    ]
    comparison = comparison._replace(
        others=(other,), differences=frames[0], flipped=frames[1], notes=(odd,)
    )
    tables = tables_of_comparison(comparison, other)
    latex = as_latex(comparison)
    assert r"\input" not in latex.replace(r"\textbackslash{}input", "") and "<" not in latex
    assert "$+0.400$ & $+" in latex
    plain = re.sub(r"\\[&%$#_{}]|\\text\w+\{\}|\$[-+][\d.]+\$", "", latex)
    assert not re.search(r"[%$#_~^]", plain)
    rows = [line for line in plain.splitlines() if line.endswith(r"\\")]
    assert len(rows) == sum(len(table.rows) + 1 for table in tables)
    assert {line.count("&") for line in rows} == {len(table.heads) - 1 for table in tables}
    assert plain.count("{") == plain.count("}")
    markdown = as_markdown(comparison)
    assert "<script" not in markdown and "&lt;script&gt;" in markdown
    bars = [
        len(re.findall(r"(?<!\\)\|", line))
        for line in markdown.splitlines()
        if line.startswith("|")
    ]
    assert {*bars} == {len(table.heads) + 1 for table in tables}


def hold(run: Path) -> RunFolder:
    return RunFolder.resume(run, read_spec(run))


def rewrite_record(run: Path, **fields: object) -> None:
    with closing(sqlite3.connect(run / "results.sqlite")) as database, database:
        for name, text in database.execute("select scenario, record from episodes").fetchall():
            text = json.dumps(json.loads(text) | fields)
            database.execute("update episodes set record = ? where scenario = ?", (text, name))
    for file in run.glob("episodes/*/record.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:300])


def empty(run: Path) -> None:
    with closing(sqlite3.connect(run / "results.sqlite")) as database, database:
        database.execute("delete from episodes")


def edit_suite(run: Path) -> None:
    file = run / "scenarios.json"
    file.write_text(file.read_text().replace('"goal_radius_m":1.0', '"goal_radius_m":2.0'))


def other_suite(run: Path, name: str, **fields: object) -> None:
    spec = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(spec | {"suite": name, "suite_hash": "beef"} | fields))


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated record": (
        lambda run: truncate(run / "episodes/s-001/record.json"),
        "{run}/episodes/s-001/record.json: not an episode record: Input data was truncated: "
        "give the command",
    ),
    "another schema": (
        lambda run: rewrite_record(run, metric_schema=2),
        "{run}: the measures of 's-000' are of metric schema 2; this version has",
    ),
    "no episode": (
        empty,
        "{run}: no episode of it has ended: give the command of the run again with --resume",
    ),
    "an edited scenario": (
        edit_suite,
        "{run}/scenarios.json: scenario 's-000' is not the one that was run, it was edited",
    ),
    "another suite": (
        lambda run: other_suite(run, "t"),
        "{run} is of suite 't' 1 (beef), {first} of 's' 1 (",
    ),
    "an edited suite": (
        lambda run: other_suite(run, "s"),
        "run both on the same version of it (former suite, edited, --crowd?)",
    ),
    "no run": (
        lambda run: (run / "run.json").unlink(),
        "{run} is no run folder: it holds no run.json. Runs in it and next to it: {first}",
    ),
    "a damaged database": (
        lambda run: (run / "results.sqlite").write_bytes(b"nothing" * 500),
        "{run}/results.sqlite is",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_unreadable_runs_are_refused_in_one_line(tmp_path: Path, cosim: Cosim, name: str) -> None:
    """File or folder and the remedy are named, no other output is printed or written, and the exit
    code is 2."""
    first, run = (run_of(tmp_path / which, [GOALS, HIT], which) for which in ("first", "second"))
    spoil, words = BAD[name]
    spoil(run)
    result = cosim("compare", str(first), str(run), "-o", str(tmp_path / "out.csv"))
    assert result.returncode == 2 and not result.stdout and not (tmp_path / "out.csv").exists()
    comparing, error = result.stderr.splitlines()
    assert comparing == "comparing 2 runs ..." and error.startswith("error: ")
    assert words.format(run=run, first=first) in error


def test_a_run_in_progress_is_not_compared(tmp_path: Path, cosim: Cosim) -> None:
    """Its process is named; a stopped run is compared in its finished episodes, with a note."""
    first, run = (
        run_of(tmp_path / which, [GOALS, HIT, GOALS], which) for which in ("first", "second")
    )
    with hold(run):
        result = cosim("compare", str(first), str(run))
    assert result.returncode == 2 and f"{run} is in use by process {os.getpid()}" in result.stderr
    with closing(sqlite3.connect(run / "results.sqlite")) as database, database:
        database.execute("delete from episodes where scenario = 's-002'")
    result = cosim("compare", str(first), str(run))
    assert (
        result.returncode == 0
        and "second is not to be quoted: 1 of 3 scheduled episodes have not ended" in result.stdout
    )
    assert (
        "scenarios that only one of both runs has are left out: 1 of first, 0 of second"
        in result.stdout
    )


def test_invalid_arguments_are_refused(runs: Path, tmp_path: Path, cosim: Cosim) -> None:
    """A single run, an unknown format, and an unwritable folder are refused."""
    one, other = str(runs / "a"), str(runs / "b")
    result = cosim("compare", one)
    assert (
        result.returncode == 2
        and "a comparison needs two runs or more: cosim compare RUN OTHER ..." in result.stderr
    )
    result = cosim("compare", one, other, "-o", "table.pdf")
    assert (
        result.returncode == 2
        and "table.pdf: its name must end in .csv, .png, .md, .tex" in result.stderr
    )
    result = cosim("compare", one, other, "--by", "city")
    assert result.returncode == 2 and "unknown axis of --by 'city'" in result.stderr
    result = cosim("compare", one, other, "-o", str(tmp_path / "gone/table.md"))
    assert (
        result.returncode == 3
        and "gone/table.md: cannot be written: No such file or directory" in result.stderr
    )
