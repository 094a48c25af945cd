"""`cosim bench`: choice of measurements, and comparison of two checkouts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from cosim.cli.app import app
from scenarios.tools.bench.figures import Figure
from scenarios.tools.bench.measurements import take_rounds
from tests.conftest import Cosim

TAKE = """
import json, sys
from pathlib import Path
name, started_s, path = sys.argv[1:]
with Path("{log}").open("a") as log:
    print("{here}", name, file=log)
figure = {{"name": f"{{name}}, ms", "value": {value}, "limit": 2.0, "limit_is": "an engine"}}
Path(path).write_text(json.dumps([figure]))
"""


def checkout(folder: Path, value: float) -> Path:
    """A folder whose measurements all give one value, each noted in a file next to the folder."""
    bench = folder / "scenarios" / "tools" / "bench"
    bench.mkdir(parents=True)
    for package in (bench, bench.parent, bench.parents[1]):
        (package / "__init__.py").touch()
    take = TAKE.format(log=folder.parent / "log", here=folder.name, value=value)
    (bench / "take.py").write_text(take, encoding="utf-8")
    return folder


def test_checkouts_take_turns(tmp_path: Path) -> None:
    """Both checkouts take each measurement in turn, and the first one changes from round to round."""
    both = [checkout(tmp_path / "one", 3.0), checkout(tmp_path / "two", 6.0)]
    one, two = take_rounds(["driving"], both, 2, lambda _: None)
    assert (tmp_path / "log").read_text().split("\n")[:-1] == [
        f"{x} driving" for x in ("one", "two", "two", "one")
    ]
    assert one == {"driving, ms": [Figure("driving, ms", 3.0, 2.0, "an engine")] * 2}
    assert [figure.ratio for figure in two["driving, ms"]] == [3.0, 3.0]


@pytest.mark.engine
def test_compare_shows_the_figures_of_both_checkouts(tmp_path: Path, cosim: Cosim) -> None:
    """--compare shows both medians and their ratio for common measurements."""
    other = checkout(tmp_path / "other", 1e6)
    (other / "scenarios" / "tools" / "bench" / "take.py").write_text(
        "import json, sys\nfrom pathlib import Path\nfigures = {'shortest walk, ms': 1e9, "
        "'elsewhere': 1.0}\nPath(sys.argv[3]).write_text(json.dumps([{'name': k, 'value': v} for "
        "k, v in figures.items()]))"
    )
    result = cosim("bench", "--only", "places", "--rounds", "1", "--compare", str(other))
    assert result.returncode == 0, result.stderr
    (row,) = [line.split() for line in result.stdout.splitlines() if "shortest walk" in line]
    assert float(row[4]) == 1e9 and float(row[5]) == 0.0
    assert "elsewhere" not in result.stdout and "point in the walkable area" not in result.stdout


def test_unknown_measurements_and_checkouts_are_refused(tmp_path: Path, cosim: Cosim) -> None:
    """An unknown measurement and a folder that is no checkout are named before anything is
    measured."""
    result = cosim("bench", "--only", "drivin")
    assert (
        result.returncode == 2
        and "Did you mean driving?" in result.stderr
        and "street 50" in result.stderr
    )
    result = cosim("bench", "--compare", str(tmp_path))
    assert (
        result.returncode == 2
        and str(tmp_path) in result.stderr
        and "scenarios/tools/bench/take.py" in result.stderr
    )


def test_options_of_bench_are_grouped_by_measurement(cosim: Cosim) -> None:
    """The help shows each option below the measurement that reads it; shared ones name theirs."""
    bench: Any = get_command(app).commands["bench"]  # type: ignore[attr-defined]
    options = {one.name: one for one in bench.params if one.param_type_name == "option"}
    assert all(one.rich_help_panel for one in options.values())
    assert options["weights"].rich_help_panel == "Options of realism"
    text = cosim("bench", "--help").stdout
    panels = [line for line in text.splitlines() if "Options of " in line]
    names = ("several", "environment", "crowd", "crossings", "exploit", "realism", "legs")
    assert [name in line for name, line in zip(names, panels, strict=True)] == [True] * 7
