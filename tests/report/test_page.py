"""The page of `cosim report`: figures, gallery, escaping and bad input; no engine, no browser."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rich.console import Console

from cosim.cli.run_table import print_table
from cosim.report.page.choice import choose_failures, showable_failures
from cosim.report.page.page import Maps, colours_of, episode_counts, render_page
from cosim.report.page.paper import LONG_OF_PAPER, REACTIVE_OF_PAPER, UNIT_OF_PAPER
from cosim.report.page.plots import exposure_of, people_nearby, plots_of
from cosim.report.page.runs import ReportedRun, read_runs
from cosim.report.page.scene import Entry, PlacePicture, Spot
from cosim.report.page.three_tables import summary_table, tables_of, warnings_of
from cosim.results.compare import compare_runs
from cosim.results.intervals import Estimate
from cosim.results.run_folder import RunFolder, read_records, read_spec
from cosim.results.table import summary_of, table_of
from cosim.spec.scenario import read_suite
from cosim.spec.schedule import BEST_BLIND
from tests.conftest import ROOT, Cosim
from tests.support.driven_runs import HIT, episode_of, failure_at, run_of, short_way

PAPER = Path(os.environ.get("COSIM_SHARED", ROOT.parent / "shared")) / "paper/sidewalkbench.tex"
HOSTILE = (
    '</script><script>document.title="taken"</script><img src=x onerror=document.title="taken">'
)


def page(*folders: Path, entries: tuple[Entry, ...] = (), maps: Maps | None = None) -> str:
    """The page of runs, without replays."""
    runs = read_runs(folders)
    maps = maps or Maps([], {}, dict(episode_counts(runs)))
    return render_page(runs, plots_of(runs, colours_of(runs)), entries, maps, "").decode()


class Elements(HTMLParser):
    """Counts elements, and collects the content of JSON scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.data: list[object] = []
        self._json = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._json = ("type", "application/json") in attrs

    def handle_data(self, data: str) -> None:
        if self._json:
            self.data.append(json.loads(data))
            self._json = False


def test_a_policys_cell_is_the_summary_of_its_episodes(tmp_path: Path) -> None:
    """A policy's cell is the summary of its episodes; rows of the paper are marked and appear only
    with its suites."""
    (own,) = read_runs([run_of(tmp_path / "run", ["goal", HIT, HIT, "goal", "goal"], "mine")])
    spec = msgspec.structs.replace(own.spec, suite="unit")
    reported = ReportedRun("mine", own.whole._replace(spec=spec))
    mean, low, high = summary_of(reported.table, ["success"]).iloc[0][["mean", "low", "high"]]
    ours = next(table for table in tables_of([reported]) if table.title == "Unit tests")
    (row,) = ours.rows
    assert row.name == "mine" and row.cells[0][:4] == (mean, low, high, 5) and mean == 0.6
    assert ours.paper is UNIT_OF_PAPER
    text = render_page([reported], [], [], Maps([], {}, {}), "").decode()
    assert f">{mean:.2f}<small>{low:.2f}&ndash;{high:.2f}</small>" in text
    assert text.index("models, in another engine") < text.index("OpenPilot")
    assert text.count('class="paper"') == len(UNIT_OF_PAPER)
    (other,) = tables_of([own])
    assert not other.paper and [row.name for row in other.rows] == ["mine: straight"]


def test_figures_of_the_paper_are_in_the_columns_of_their_metrics(tmp_path: Path) -> None:
    """A row of long ways has a cell for each column, the paper's V is in column V, and it has no
    falls."""
    way = short_way("s-000", suite="long-horizon", ends_on_failure=False, structure="route")
    runs = read_runs([run_of(tmp_path / "run", ["goal"], scenarios=[way])])
    (long,) = [table for table in tables_of(runs) if table.title == "Long ways"]
    for row in long.paper.values():
        assert len(row) == len(long.heads)
    places = zip(long.heads, long.paper["ViNT"], strict=True)
    assert [*places][:6] == [
        ("FC", 21.20),
        ("C", 4.29),
        ("OL", 16.90),
        ("F", 0.00),
        ("FL", None),
        ("V", 1.11),
    ]


def test_a_row_names_a_robot_other_than_the_default(tmp_path: Path) -> None:
    """The tables name the scout in a row's note, and not the courier."""
    ways = [short_way("s-0"), short_way("s-1", robot="scout")]
    (own,) = read_runs([run_of(tmp_path / "run", ["goal", "goal"], "mine", ways)])
    (table,) = tables_of([own])
    assert [row.notes for row in table.rows] == ["2 episodes, blind, robot scout"]


def test_tables_hold_runs_of_one_sensor_track(tmp_path: Path) -> None:
    """Runs with tracked people and blind runs have their own tables; rows and summary name the
    track."""
    runs = read_runs([run_of(tmp_path / name, ["goal", HIT], name) for name in ("a", "b")])
    records = {
        name: msgspec.structs.replace(one, manifest=replace(one.manifest, people="seen"))
        for name, one in runs[1].whole.records.items()
    }
    both = [runs[0], ReportedRun("b", runs[1].whole._replace(records=records))]
    tables = tables_of(both)
    assert [(one.title.partition(", ")[2], [row.name for row in one.rows]) for one in tables] == [
        ("sensor track people", ["b: straight"]),
        ("sensor track blind", ["a: straight"]),
    ]
    assert tables[0].rows[0].notes == "2 episodes, people"
    summary = summary_table(both, {"a": "#000000", "b": "#ffffff"})
    assert [row.track for row in summary.rows] == ["blind", "people"]


def test_tables_name_a_custom_gait(tmp_path: Path) -> None:
    """Rows and facts of a report, a comparison, and the table of a run have its file and hash."""
    folder = run_of(tmp_path / "run", ["goal"], robot="dog", gait="onnx:/gaits/walk.onnx")
    words = "gait walk.onnx (01234567)"
    (own,) = read_runs([folder])
    (table,) = tables_of([own])
    assert [row.notes for row in table.rows] == [f"1 episode, blind, robot dog, {words}"]
    assert words in render_page([own], [], [], Maps([], {}, {}), "").decode().split("its source")[1]
    plain = run_of(tmp_path / "plain", ["goal"])
    notes = compare_runs([plain, folder]).notes
    assert notes[0] == f"p, dog: robot dog (h), {words}"
    assert not any("robot courier (h" in note for note in notes)
    for path, found in ((folder, True), (plain, False)):
        console = Console(file=StringIO(), width=300)
        print_table(console, table_of(read_records(path)), 1, path)
        assert (f"robot dog (h), {words}" in console.file.getvalue()) == found  # type: ignore[attr-defined]


def test_below_five_episodes_a_report_has_counts_and_no_error_bars(tmp_path: Path) -> None:
    """Four curves give counts and a bare point, six straight ways give intervals, and crashes have
    a column."""
    ways = [short_way(f"s-{k}", structure="curve" if k < 4 else "straight") for k in range(10)]
    hows = ["goal", HIT, "goal", "goal", "crashed", *["goal"] * 5]
    (own,) = read_runs([run_of(tmp_path / "run", hows, "mine", ways)])
    (plot,) = [p for p in plots_of([own], {"mine": "red"}) if p.title == "Success by structure"]
    (trace,) = plot.figure["data"]
    assert dict(zip(trace["y"], trace["customdata"], strict=True)) == {
        "straight": "0.83 (0.44 to 0.97), n = 6",
        "curve": "3/4, n = 4",
    }
    assert trace["error_x"]["array"] == [0.1366, None] and trace["x"] == [0.8333, 0.75]
    assert trace["error_x"]["arrayminus"][1] is None
    summary = summary_table([own], {"mine": "red"})
    assert summary.heads[:3] == ("scored", "crashed", "invalid")
    assert (summary.rows[0].scored, summary.rows[0].crashed, summary.rows[0].invalid) == (10, 1, 0)
    text = render_page([own], [plot], [], Maps([], {}, {}), "").decode()
    assert '<td title="n = 4">3/4</td>' in text and "nan" not in text.split("<script")[0]
    assert "1 crashed" in text and "<td>10</td><td>1</td><td>0</td>" in text


def test_blind_schedules_are_a_row_of_the_tables_of_success(tmp_path: Path) -> None:
    """Only the runs of that suite get the row, with the share of each kind that was searched."""
    (own,) = read_runs([run_of(tmp_path / "run", ["goal", HIT], "mine")])
    reported = ReportedRun(
        "mine", own.whole._replace(spec=msgspec.structs.replace(own.spec, suite="unit"))
    )
    share = Estimate(0.95, 0.76, 0.99, 20, 19.0)
    blind = {"unit": {"straight": share}}
    ours = next(table for table in tables_of([reported], blind) if table.title == "Unit tests")
    mine, row = ours.rows
    assert row.name == BEST_BLIND and row.cells[0] == share and len(row.cells) == len(mine.cells)
    assert sum(cell.n > 0 for cell in row.cells) == 1
    text = render_page([reported], [], [], Maps([], {}, {}), "", blind).decode()
    assert text.index(BEST_BLIND) < text.index("models, in another engine")
    assert BEST_BLIND not in render_page([own], [], [], Maps([], {}, {}), "", blind).decode()


@pytest.mark.skipif(not PAPER.exists(), reason="the paper is not here")
def test_the_papers_figures_are_those_of_its_tables() -> None:
    """Every row for the paper equals the table of the paper's source, figure by figure."""
    text = PAPER.read_text()

    def row(table: str, name: str, nth: int = 0) -> tuple[float | None, ...]:
        part = text.split(rf"\label{{{table}}}")[0].split(r"\begin{table}")[-1]
        found = re.findall(rf"{name}~\\cite{{[^}}]*}}(.*?)\\\\", part)[nth]
        cells = [
            re.sub(r"\\textbf|\\cellcolor{\w+}|[{}\s]", "", cell) for cell in found.split("&")[1:]
        ]
        return tuple(None if cell == "--" else float(cell) for cell in cells)

    for name in UNIT_OF_PAPER:
        assert row("tab:terrain_only", name) == UNIT_OF_PAPER[name]
        assert row("tab:long_horizon", name) == LONG_OF_PAPER[name]
        assert row("tab:hand_crafted", name) == REACTIVE_OF_PAPER["success"][name]
        assert (None, *row("tab:hand_crafted_full", name, 0)) == REACTIVE_OF_PAPER[
            "pedestrian_collision"
        ][name]
        apart = REACTIVE_OF_PAPER["pedestrian_distance_min_success_m"][name]
        assert (None, *row("tab:hand_crafted_full", name, 1)) == apart


def test_the_gallery_shows_every_kind_and_cause_up_to_its_limit(tmp_path: Path) -> None:
    """Of many failures of few kinds the earliest of each is chosen first, within the limit."""
    kinds = [("straight", "curve", "crosswalk")[i % 3] for i in range(38)]
    ways = [short_way(f"s-{i:03d}", structure=kind) for i, kind in enumerate(kinds)]
    runs = read_runs([run_of(tmp_path / "run", [HIT] * 38, "mine", ways)])
    candidates = showable_failures(runs)
    picked = choose_failures(candidates, 3).picks
    assert len(candidates) == 38 and {kinds[int(one.scenario[2:])] for one in picked} == {*kinds}
    picked, limit = choose_failures(candidates, 48)
    assert (
        len(picked) == 36
        and len({one.scenario for one in picked}) == 36
        and limit.startswith("the others show no")
    )


def test_a_failure_counts_in_the_bin_of_nearby_people() -> None:
    """With two people within 10 m in the second of the failure, it and that second's metres are in
    their bin."""
    way = short_way("s-000", ends_on_failure=False)
    record, log = episode_of(way, "h", HIT)
    assert log is not None
    seen = np.array([0, 20, 40, 60, 60])
    xy = np.column_stack([log.pose[seen, 0] + [50.0, 50.0, 50.0, 3.0, -3.0], np.zeros(5)])
    near = people_nearby(log.pose, seen, xy)
    assert near[59] == 0.0 and near[60] == near[79] == 2.0
    record = msgspec.structs.replace(
        record, failures=(failure_at(log, 70), failure_at(log, 75, "freezing"))
    )
    exposure = exposure_of(record, log.travelled_m, near, (1.0, 3.0), moving=False)
    assert exposure.failures.tolist() == [0.0, 2.0, 0.0]
    assert exposure.metres.sum() == pytest.approx(log.travelled_m.sum()) and exposure.metres[
        1
    ] == pytest.approx(1.0)
    assert exposure_of(
        record, log.travelled_m, near, (1.0, 3.0), moving=True
    ).failures.tolist() == [0.0, 1.0, 0.0]


def test_rates_exclude_the_metres_of_invalid_episodes(tmp_path: Path) -> None:
    """Plots do not read the trajectory of an invalid episode that reached its goal."""
    (run,) = read_runs([run_of(tmp_path / "run", [HIT, "goal", "goal"], "mine")])
    records = {
        n: msgspec.structs.replace(r, status="invalid") if n == "s-001" else r
        for n, r in run.whole.records.items()
    }
    reported = ReportedRun("mine", run.whole._replace(records=records))
    assert [record.scenario.id for record, _ in reported.tracks()] == ["s-000", "s-002"]


def test_a_run_without_failures_is_plotted_at_0_beside_one_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both runs have a point for quick and for slow ticks, and the clean run alone has no plot."""
    runs = read_runs([run_of(tmp_path / how, [how] * 8, how) for how in (HIT, "goal")])
    speed = np.repeat([[0.5, 0.0], [1.0, 0.0]], 40, axis=0)
    nobody = np.zeros(0, dtype=int)
    track = {
        "pose": np.zeros((80, 3)),
        "speed": speed,
        "travelled_m": np.full(80, 0.1),
        "people_tick": nobody,
    }
    tracks = track | {"people_xy": np.zeros((0, 2))}
    monkeypatch.setattr(
        ReportedRun, "tracks", lambda run: [(record, tracks) for record in run.records]
    )
    (plot,) = [plot for plot in plots_of(runs, colours_of(runs)) if "speed" in plot.title]
    assert {trace["name"]: trace["x"] for trace in plot.figure["data"]} == {
        HIT: [0.0, 25.641],
        "goal": [0.0, 0.0],
    }
    assert not [plot for plot in plots_of(runs[1:], colours_of(runs)) if "speed" in plot.title]


def test_crashed_long_ways_are_noted_beside_their_rates(tmp_path: Path) -> None:
    """Rates of long ways leave out crashed episodes, and a note counts them."""
    ways = [short_way(f"s-{k}", ends_on_failure=False, time_limit_s=300.0) for k in range(3)]
    # 4 m to a failure in each: the rates of a run need 20 m
    runs = read_runs(
        [
            run_of(tmp_path / "shaky", [HIT, "crashed", "crashed"], "shaky", ways),
            run_of(tmp_path / "sound", [HIT] * 3, "sound", ways),
        ]
    )
    far = {
        n: msgspec.structs.replace(r, measures=r.measures | {"rated_m": 50.0})
        for n, r in runs[0].whole.records.items()
    }
    shaky = ReportedRun("shaky", runs[0].whole._replace(records=far))
    (plot,) = [
        one
        for one in plots_of([shaky, runs[1]], colours_of(runs))
        if one.title.startswith("What goes wrong")
    ]
    assert plot.note.endswith("the policy crashed: 2 of 3 of shaky.")
    (bar,) = plot.figure["data"]
    assert dict(zip(bar["y"], bar["x"], strict=True)) == {"shaky": 2.0}


def test_runs_of_different_scenarios_of_a_suite_are_marked(tmp_path: Path) -> None:
    """A run of two of three scenarios beside one of all gets a note with both counts, and otherwise
    there is none."""
    runs = read_runs([run_of(tmp_path / name, ["goal"] * 3, name) for name in ("one", "other")])
    assert not any(warnings_of(runs))
    first = runs[0]
    run = runs[1].whole
    spec = msgspec.structs.replace(run.spec, scenarios=run.spec.scenarios[:2])
    part = ReportedRun("other", run._replace(spec=spec, records=dict([*run.records.items()][:2])))
    assert warnings_of([first, part]).mixed == (("s", "one 3, other 2"),)
    text = render_page([first, part], [], [], Maps([], {}, {}), "").decode()
    assert "not all runs are of the same scenarios (one 3, other 2)" in text


def test_names_and_reasons_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    """Markup in a structure, a policy and a reason is shown as text, without any element."""
    plain, hostile = (
        Elements(page(folder, entries=(entry,), maps=maps))
        for folder, entry, maps in (
            _named(tmp_path / "plain", "plain"),
            _named(tmp_path / "hostile", HOSTILE),
        )
    )
    assert hostile.tags == plain.tags and "script" in plain.tags
    assert HOSTILE in json.dumps(hostile.data[0]).replace('\\"', '"')
    assert len(hostile.data) == len(plain.data) == 1


def _named(path: Path, name: str) -> tuple[Path, Entry, Maps]:
    """A run in which every name is the given one, with a card and a map of it."""
    ways = [short_way("s-000", structure=name), short_way("s-001", structure=f"{name} 2")]
    run = run_of(path, [HIT, "goal"], name, ways)
    entry = Entry(
        label=name,
        suite="s",
        scenario="s-000",
        kind=name,
        event=name,
        place=name,
        light="fog",
        cause="obstacle",
        reason=name,
        at_s=4.0,
        why=name,
    )
    picture = PlacePicture(place=name, image="data:image/webp;base64,", bounds=(0.0, 0.0, 1.0, 1.0))
    return (
        run,
        entry,
        Maps(
            [picture],
            {name: [Spot(x_m=0.0, y_m=0.0, cause="obstacle", words=name)]},
            {name: (1, 1)},
        ),
    )


def test_the_page_is_one_file_that_loads_nothing(tmp_path: Path) -> None:
    """Its content policy forbids every address, and no element names one."""
    text = page(run_of(tmp_path / "run", [HIT, "goal"]))
    assert (
        "content=\"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src"
        in text
    )
    head = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', head) and "<link" not in head


def test_two_runs_of_one_policy_and_suite_have_the_names_of_their_folders(tmp_path: Path) -> None:
    """A single run has the name of its policy."""
    first = run_of(tmp_path / "first", ["goal"], "mine")
    second = run_of(tmp_path / "second", [HIT], "mine")
    assert [run.label for run in read_runs([first])] == ["mine"]
    assert [run.label for run in read_runs([first, second])] == ["first", "second"]


def test_a_folder_with_the_name_of_another_policy_has_its_own_row(tmp_path: Path) -> None:
    """Two runs of one policy in folders, of which one has the name of the policy of a third run."""
    runs = read_runs(
        [
            run_of(tmp_path / "other", ["goal"] * 2, "mine"),
            run_of(tmp_path / "b", ["goal"] * 2, "mine"),
            run_of(tmp_path / "c", [HIT] * 2, "other"),
        ]
    )
    labels = [f"other ({tmp_path / 'other'})", "b", f"other ({tmp_path / 'c'})"]
    assert [run.label for run in runs] == labels
    (table,) = tables_of(runs)
    assert len(table.rows) == 3


def test_runs_of_one_suite_by_several_robots_share_a_table(tmp_path: Path) -> None:
    """Rows of a policy that drove several robots have the robot in their name."""
    runs = read_runs(
        [
            run_of(tmp_path / "one", ["goal"] * 3, "mine"),
            run_of(tmp_path / "two", [HIT] * 3, "mine", robot="dog"),
            run_of(tmp_path / "three", ["goal"] * 3, "other", robot="dog"),
        ]
    )
    assert [run.label for run in runs] == ["mine, courier", "mine, dog", "other"]
    (table,) = tables_of(runs)
    names = ["mine, courier: straight", "mine, dog: straight", "other: straight"]
    assert [row.name for row in table.rows] == names


def _truncated(run: Path) -> str:
    file = run / "episodes/s-000/record.json"
    file.write_bytes(file.read_bytes()[:200])
    return "episodes/s-000/record.json"


def _truncated_trajectory(run: Path) -> str:
    file = run / "episodes/s-000/trajectory.npz"
    file.write_bytes(file.read_bytes()[:200])
    return "episodes/s-000/trajectory.npz"


def _edited(run: Path) -> str:
    file = run / "scenarios.json"
    file.write_text(file.read_text().replace('"time_limit_s":12.0', '"time_limit_s":13.0'))
    return "scenarios.json"


@pytest.mark.parametrize(
    "damage", [_truncated, _truncated_trajectory, _edited], ids=["record", "trajectory", "suite"]
)
def test_a_damaged_run_is_refused_by_the_name_of_its_file(
    tmp_path: Path, cosim: Cosim, damage: Callable[[Path], str]
) -> None:
    """One line has the file and the remedy, the exit code is 2, and there is no page."""
    run = run_of(tmp_path / "run", [HIT, "goal"])
    file = damage(run)
    result = cosim("report", "run", "-o", "report.html", cwd=tmp_path)
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error:")]
    assert result.returncode == 2 and file in line and "again" in line
    assert not list(tmp_path.glob("*.html*"))


def test_no_run_a_run_twice_and_a_run_without_an_episode_are_refused(
    tmp_path: Path, cosim: Cosim
) -> None:
    """Each refusal is one line with the remedy."""
    run = run_of(tmp_path / "run", [HIT])
    with RunFolder.create(
        tmp_path / "empty", read_spec(run), read_suite(run / "scenarios.json")
    ) as folder:
        assert (
            "in use by process"
            in cosim("report", str(folder.path), "-o", "r.html", cwd=tmp_path).stderr
        )
    words = {
        ("nowhere",): "unknown run",
        ("run", "../" + tmp_path.name + "/run"): "is given twice: name each run once",
        ("empty",): "no episode of it has ended",
    }
    for folders, expected in words.items():
        result = cosim("report", *folders, "-o", "r.html", cwd=tmp_path)
        assert result.returncode == 2 and expected in result.stderr, result.stderr
    assert not list(tmp_path.glob("*.html*"))


def test_two_suites_of_one_name_are_not_put_in_one_table(tmp_path: Path, cosim: Cosim) -> None:
    """The refusal names both folders and both hashes."""
    run_of(tmp_path / "one", [HIT], "mine")
    run_of(tmp_path / "two", [HIT], "mine", [short_way("s-000", time_limit_s=20.0)])
    result = cosim("report", "one", "two", "-o", "r.html", cwd=tmp_path)
    assert result.returncode == 2 and re.search(
        r"two and one are of different suites 's' \(\w{16}, \w{16}\)", result.stderr
    )


def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The previous page stays, no other file is left, and the exit code is 3."""
    run_of(tmp_path / "run", ["goal", "goal"])
    (tmp_path / "report.html").write_text("the page before")

    def full(path: Path, data: bytes) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    result = cosim("report", "run", "-o", "report.html", cwd=tmp_path)
    assert (
        result.returncode == 3 and "report.html: cannot be written: No space left" in result.stderr
    )
    assert [path.name for path in tmp_path.glob("report*")] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "the page before"
