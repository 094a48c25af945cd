"""The command line of scores: `cosim score`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.panels import TRUST
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import SOME_CRASHED

score_app = typer.Typer()


@score_app.command(rich_help_panel=TRUST, epilog="Example:  \n`cosim score runs/mine`")
def score(folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]) -> None:
    """Compute every metric of a run again from its trajectories; is it what the run recorded, to the bit?

    No engine is started. Exit code 1, and the first difference, where it is not.
    """
    from cosim.judge.metrics import METRICS
    from cosim.records.record import METRIC_SCHEMA
    from cosim.records.score import score_run

    with doing(f"reading {folder}") as tell:
        scored = score_run(folder, tell)
    lines = [f"{scored.episodes} episodes, {len(METRICS)} metrics each, by metric schema {METRIC_SCHEMA}"]
    if lacking := scored.scheduled - scored.episodes - scored.without_trajectory:
        lines.append(f"{lacking} of {scored.scheduled} scheduled episodes have not ended: results.csv is not looked at")
    if scored.without_trajectory:
        lines.append(f"{scored.without_trajectory} have no trajectory: their policy crashed, or an engine failed")
    if scored.untested:
        lines.append(f"no trajectory tells {', '.join(scored.untested)}: see cosim counterfactual")
    if not scored.differences:
        files = ("record.json", "results.sqlite", *["results.csv"] * scored.table)
        lines.append(f"equal to the bit to {', '.join(files)}")
    for line in lines:
        out.print(line, soft_wrap=True, highlight=False, markup=False)
    if scored.differences:
        first, episodes = scored.differences[0], {one.episode for one in scored.differences}
        out.print(
            f"different: episode {first.episode}, {first.metric} in {first.file}: recorded {first.recorded}, "
            f"computed {first.computed} (differences: {len(scored.differences)}, episodes: {len(episodes)})",
            soft_wrap=True, highlight=False, markup=False,
        )  # fmt: skip
        raise typer.Exit(SOME_CRASHED)
