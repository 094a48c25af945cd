"""Options that commands generate from the fields of a config, and the checks of a run before it
builds anything."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from cosim.cli.generated_options import Fields, configured
from cosim.core.errors import UsageError
from cosim.spec.run_config import RunConfig
from tests.conftest import Cosim
from tests.support.driven_runs import run_of

_SOME = Fields(
    only=("suite", "policy", "event", "out", "seed", "real_time"),
    help={"out": "Somewhere."},
    default={"policy": "orca"},
    required=("out",),
    hidden=("seed",),
)


def output_of(*words: str) -> tuple[int, str, list[RunConfig]]:
    """Return exit code, output and configs of a command with some options of a run."""
    taken: list[RunConfig] = []

    @configured
    def command(config: Annotated[RunConfig, _SOME], more: int = 0) -> None:
        """Run it."""
        taken.append(config)

    app = typer.Typer(add_completion=False)
    app.command()(command)
    done = CliRunner().invoke(
        app, list(words), terminal_width=80, env={"COLUMNS": "80"}, color=False
    )
    return done.exit_code, done.output, taken


def test_a_command_has_its_fields_with_its_own_help_and_defaults() -> None:
    """Other fields are omitted or hidden, required ones are marked, and the command's own options
    remain."""
    code, text, _ = output_of("--help")
    assert code == 0 and "Somewhere." in text and "--more" in text and "[default: orca]" in text
    assert "--latency" not in text and "--seed" not in text and "[required]" in text
    assert output_of("unit")[0] == 2


def test_typed_options_become_the_config() -> None:
    """Repeated options are a tuple, flags are booleans, and fields without an option have their
    default."""
    code, text, taken = output_of(
        "unit", "--event", "a", "--event", "b", "--out", "x", "--real-time", "--seed", "7"
    )
    assert code == 0, text
    wanted = RunConfig(
        suite="unit", policy="orca", event=("a", "b"), out=Path("x"), real_time=True, seed=7
    )
    assert taken == [wanted]


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"resume": True}, "--resume needs --out"),
        ({"shard": "1/2", "latency": "measured"}, "--shard with --latency measured"),
        ({"roughness": 0.5}, "--roughness goes with --map"),
    ],
    ids=["resume", "shard", "roughness"],
)
def test_contradictory_values_are_refused(fields: dict[str, object], expected: str) -> None:
    """The options are named before anything is loaded."""
    with pytest.raises(UsageError, match=expected):
        RunConfig(suite="unit", **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ((), "used already holds a run. Add --resume to finish it"),
        (("--resume",), "used is of another run: its suite is s, and this command has reactive"),
        (("--map", "sumo-a10kw"), "used already holds a run"),
    ],
    ids=["new", "resumed", "on a map"],
)
def test_a_folder_of_another_run_is_refused_before_a_city_is_built(
    tmp_path: Path,
    cosim: Cosim,
    monkeypatch: pytest.MonkeyPatch,
    more: tuple[str, ...],
    expected: str,
) -> None:
    """The refusal comes while the cache in which cities are built is still empty."""
    run_of(tmp_path / "used", ["goal"])
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    refused = cosim("run", "reactive", "--policy", "straight", "--out", "used", *more, cwd=tmp_path)
    assert refused.returncode == 2 and expected in refused.stderr, refused
    assert not [*(tmp_path / "cache").glob("**/*.net.xml*")]
