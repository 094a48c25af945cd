"""The metric discerned (D): pairs of an event and its decoy, in tables, comparisons, reports and
files."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pandas as pd
import pytest

from cosim.core.errors import RunError, SpecError
from cosim.core.progress import ignore
from cosim.report.compared import as_latex, as_markdown, flips_in_words
from cosim.report.page.page import Maps, colours_of, render_page
from cosim.report.page.plots import plots_of
from cosim.report.page.runs import read_runs
from cosim.report.page.three_tables import summary_table, tables_of
from cosim.results.compare import compare_runs
from cosim.results.discerned import episode_pairs
from cosim.results.intervals import wilson
from cosim.results.merge import merge_runs
from cosim.results.run_folder import read_records
from cosim.results.table import summary_of, table_of, why_inconclusive
from cosim.spec.events import Event
from cosim.spec.scenario import Scenario, Suite, read_suite, write_suite
from scenarios.events import EVENT_KINDS
from tests.conftest import Cosim
from tests.support.driven_runs import HIT, run_of, short_way, with_decoys

KINDS = ("lateral", "frontal")
GOAL = "goal"


def way(kind: str, number: int) -> Scenario:
    """A scenario of `reactive` with one event."""
    event = Event(
        id="e0", kind=kind, x_m=5.0, y_m=0.0, heading_rad=0.0, route_s_m=5.0, half_width_m=1.5
    )
    return short_way(f"{kind}-{number:03d}", suite="reactive", structure=kind, events=(event,))


EVENTS = [way(kind, number) for kind in KINDS for number in range(5)]
PAIRS = with_decoys(*EVENTS)
STATIC = short_way("static-000", suite="reactive", structure="static")
EVERY = (*PAIRS, STATIC)
"""Five events of two kinds, each followed by its decoy; and one scenario without an event."""
MIXED = [GOAL, GOAL, GOAL, HIT, HIT, GOAL, GOAL, "crashed", "invalid", GOAL]
"""Outcomes of pairs of `lateral`: both solved; either unsolved; a decoy that crashed; an event that is invalid."""
FRONTAL = [GOAL, GOAL] * 3 + [GOAL, "invalid"] + [HIT, HIT]
"""Outcomes of pairs of `frontal`: three pairs solved, one with an invalid decoy, one unsolved."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs: `a` as above, `b` solves everything, `events` is of the former suite without decoys."""
    folder = tmp_path_factory.mktemp("runs")
    run_of(folder / "a", [*MIXED, *FRONTAL, GOAL], "a", EVERY)
    run_of(folder / "b", [GOAL] * 21, "b", EVERY)
    run_of(folder / "events", [GOAL] * 11, "c", (*EVENTS, STATIC))
    return folder


def table(run: Path) -> pd.DataFrame:
    return table_of(read_records(run))


def test_a_pair_counts_only_if_both_are_solved(runs: Path) -> None:
    """Crashes count as unsolved, pairs with an invalid member are excluded and counted, and D is
    over all pairs."""
    episodes = table(runs / "a")
    for kind, mean in (("lateral", 0.25), ("frontal", 0.75)):
        part = episodes[episodes["structure"] == kind]
        found = summary_of(part, ["discerned"]).loc["discerned"]
        assert (found["mean"], found["n"]) == (mean, 4)
        assert episode_pairs(part).in_words == "4 pairs; left out: 1 with an invalid member"
    found = summary_of(episodes).loc["discerned"]
    assert (found["mean"], found["low"], found["high"], found["n"]) == (0.5, *wilson(4.0, 8), 8)
    assert summary_of(table(runs / "b")).loc["discerned", ["mean", "n"]].tolist() == [1.0, 10]


def test_every_other_mean_is_over_scenarios_without_decoys(runs: Path) -> None:
    """The rows of the events alone give the same values, so that a decoy's crash removes no rate."""
    episodes = table(runs / "a")
    events = episodes[episodes["decoy_of"] == ""]
    summary = summary_of(episodes).drop("discerned")
    pd.testing.assert_frame_equal(summary, summary_of(events))
    assert summary.loc["success"].tolist()[3] == 10 and summary.loc["failures_per_100m", "n"] == 10


def test_without_the_other_member_there_is_no_pair(runs: Path) -> None:
    """D of events alone, of decoys alone and of halves is absent, not 0; halves are counted."""
    episodes = table(runs / "b")
    events, decoys = episodes[episodes["decoy_of"] == ""], episodes[episodes["decoy_of"] != ""]
    assert "discerned" not in summary_of(events).index
    alone = summary_of(decoys).loc[["discerned", "success"]]
    assert alone["n"].tolist() == [0, 0] and alone["mean"].isna().all()
    halves = pd.concat([events.iloc[:3], decoys.iloc[2:]])
    assert episode_pairs(halves).in_words == "1 pair; left out: 9 episodes without the other member"
    nothing = pd.concat([events.iloc[:2], decoys.iloc[2:4]])
    assert summary_of(nothing).loc["discerned", "n"] == 0


def test_invalid_episodes_are_counted_apart_from_decoys(runs: Path) -> None:
    """Decoys do not dilute the share of invalid scenarios, and each costs D a pair."""
    assert why_inconclusive(table(runs / "a"), 21).startswith("1 of 11 scheduled episodes are inv")
    valid = run_of(runs / "valid", [*[GOAL, GOAL] * 9, GOAL, "invalid", GOAL], "v", EVERY)
    words = "1 of 10 pairs with a decoy have an invalid episode, more than 2 %"
    assert why_inconclusive(table(valid), 21) == words


def test_files_record_the_event_of_a_decoy(runs: Path) -> None:
    """record.json and results.csv have the column, so that no table needs the suite."""
    fields = json.loads((runs / "a/episodes/lateral-000-decoy/record.json").read_bytes())
    assert fields["decoy_of"] == "lateral-000"
    rows = pd.read_csv(runs / "a/results.csv").set_index("scenario")["decoy_of"]
    assert rows["lateral-000-decoy"] == "lateral-000" and pd.isna(rows["lateral-000"])


def test_a_run_shows_d_beside_sr(runs: Path, cosim: Cosim) -> None:
    """D is shown over all and per kind with its pairs and exclusions, and not without decoys."""
    result = cosim("show", str(runs / "a"))
    lines = [" ".join(line.replace("│", " ").split()) for line in result.stdout.splitlines()]
    text = " ".join(" ".join(lines).split())
    assert any(line.startswith("discerned (D) 0.50") and line.endswith("8") for line in lines)
    assert "decoys count in D alone, over 8 pairs; left out: 2 with an invalid member" in text
    assert "D share of events solved with their decoys" in text
    assert "of all rows 10 are decoys" in text
    by_kind = {line.split()[0]: line.split() for line in lines if line.startswith(KINDS)}
    assert by_kind["lateral"][:7] == ["lateral", "4", "3/4", "-", "1/4", "-", "4"]
    assert (by_kind["lateral"][-1], by_kind["frontal"][-1]) == ("1", "0")  # invalid, without decoys
    assert "decoy" not in cosim("show", str(runs / "events")).stdout.replace("of decoys: go", "")
    result = cosim("show", str(runs / "a"), "--episode", "lateral-000-decoy")
    assert result.stdout.startswith("lateral-000-decoy (decoy of lateral-000): done goal"), result


def test_a_comparison_pairs_the_pairs(runs: Path, tmp_path: Path) -> None:
    """D is compared over common pairs, for the suite and each kind; SR is over events; exports have
    both."""
    comparison = compare_runs([runs / "a", runs / "b"])
    rows = comparison.differences.set_index(["metric", "group"])
    suite_row = rows.loc[("discerned", "reactive")]
    assert (suite_row["n"], suite_row["value_before"], suite_row["value_after"]) == (8, 0.5, 1.0)
    assert rows.loc[("discerned", "lateral"), "changed"] == 3
    assert (
        rows.loc[("success", "reactive"), "n"] == 10 and rows.loc[("success", "static"), "n"] == 1
    )
    assert "a: D is over 8 pairs; left out: 2 with an invalid member" in comparison.notes
    for text in (as_markdown(comparison), as_latex(comparison)):
        assert "discerned" in text and "D share of events solved with their decoys" in text
        assert any("lateral" in line and " D " in line for line in text.splitlines())


def test_decoys_solved_by_one_run_alone_are_listed_apart(runs: Path) -> None:
    """Scenarios won minus lost are the change of SR; decoys have lines of their own."""
    comparison = compare_runs([runs / "a", runs / "b"])
    success = comparison.differences.set_index(["metric", "group"]).loc[("success", "reactive")]
    lines = flips_in_words(comparison, comparison.others[0])
    won, lost, *decoys = (int(re.findall(r"alone, (\d+):", line)[0]) for line in lines)
    assert won - lost == round(success["n"] * success["difference"]) and "decoy" not in lines[0]
    assert sum(decoys) == comparison.flipped["decoy"].sum() > 0
    assert all(line.startswith("decoys solved by") and "-decoy" in line for line in lines[2:])


def test_a_report_has_d_in_tables_and_a_plot(runs: Path) -> None:
    """It is beside SR and in a plot by event without `static`, and decoys have their own bar of
    endings."""
    reported = read_runs([runs / "a", runs / "b"])
    colours = colours_of(reported)
    summary = summary_table(reported, colours)
    assert [row.crashed for row in summary.rows] == [0, 0]
    assert "1 crashed (decoys)" in tables_of(reported)[0].rows[0].notes
    assert summary.heads[3:5] == ("SR", "D")
    assert [(row.cells[1].mean, row.cells[1].n) for row in summary.rows] == [(0.5, 8), (1.0, 10)]
    titles = [one.title for one in tables_of(reported)]
    assert titles[:2] == ["People in the way: success", "People in the way: discerned"]
    by_event = tables_of(reported)[1]
    cells = dict(zip(by_event.heads, by_event.rows[0].cells, strict=True))
    assert (cells["lateral"].mean, cells["frontal"].mean, cells["static"].n) == (0.25, 0.75, 0)
    assert not by_event.paper and "10 pairs" in by_event.rows[1].notes
    plots = {plot.title: plot.figure for plot in plots_of(reported, colours)}
    points = plots["Discerned by event: solved with its decoy"]["data"][0]
    assert points["y"] == ["frontal", "lateral"] and points["x"] == [0.75, 0.25]
    bars = plots["How short episodes end"]["data"][0]["y"]
    assert "a<br>decoys" in bars and "a<br>people in the way" in bars
    text = render_page(reported, [], [], Maps([], {}, {}), "").decode()
    assert "People in the way: discerned" in text and "21 ended, of these 10 decoys" in text
    assert "iscerned" not in "".join(one.title for one in tables_of(read_runs([runs / "events"])))


def refused(runs: Sequence[Path], target: Path) -> dict[str, str]:
    """Return the refusals of a comparison, a report and a merge of runs."""
    refusals = {}
    for name, of in (
        ("compare", lambda: compare_runs(runs)),
        ("report", lambda: read_runs(runs)),
        ("merge", lambda: merge_runs(runs, target, ignore)),
    ):
        with pytest.raises(RunError) as caught:
            of()
        refusals[name] = str(caught.value)
    return refusals


def test_runs_of_the_former_suite_are_refused(runs: Path, tmp_path: Path) -> None:
    """Comparison, report and merge refuse a suite without decoys, with both hashes or the differing
    field."""
    refusals = refused([runs / "b", runs / "events"], tmp_path / "merged")
    assert "run both on the same version of it (former suite, edited" in refusals["compare"]
    assert "are of different suites 'reactive'" in refusals["report"]
    assert "its suite_hash is" in refusals["merge"]
    assert not (tmp_path / "merged").exists()


def test_a_decoy_without_its_event_is_refused_in_a_suite_file_only(tmp_path: Path) -> None:
    """A part of a suite may lack the event; decoys of decoys and go-on rules at stops are refused."""
    part = Suite(name="reactive", version="1", scenarios=PAIRS[1:])
    write_suite(part, tmp_path / "s.json")
    assert len(read_suite(tmp_path / "s.json").scenarios) == 19
    with pytest.raises(
        SpecError, match=r"'lateral-000-decoy': decoy_of names no scenario of the suite: 'lateral"
    ):
        read_suite(tmp_path / "s.json", EVENT_KINDS)
    again = msgspec.structs.replace(PAIRS[0], id="x", decoy_of=PAIRS[1].id)
    with pytest.raises(SpecError, match="scenario 'x': decoy_of names another decoy"):
        Suite(name="reactive", version="1", scenarios=(*PAIRS, again))
    with pytest.raises(SpecError, match="go_on_mps needs an event to pass"):
        msgspec.structs.replace(PAIRS[1], ends_at="stop")
