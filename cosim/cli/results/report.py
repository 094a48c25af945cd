"""`cosim report`: one HTML file of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.camera import CAMERA_HELP, Choice, camera_here
from cosim.cli.options.output_file import check_output, replaced
from cosim.cli.options.panels import LOOK
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing

report_app = typer.Typer()


@report_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim report runs/mine -o report.html`  \n"
    "`cosim report runs/unit-mine runs/reactive-mine runs/reactive-theirs --failures 24`",
)
def report(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to write the page, an .html.")] = Path(
        "report.html"
    ),
    failures: Annotated[int, typer.Option(min=0, max=200, help="Show at most so many failures again.")] = 48,
    within: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Of an episode show its first failure, and others this soon: to come to later ones takes long.",
        ),
    ] = 150.0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that show them again.")] = 2,
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
) -> None:
    """Write one HTML file about runs: tables beside the paper's, plots, maps of failures, failures to play again.

    It opens from disk and asks nobody for anything. Failures are shown by running their episodes again.
    """
    check_output(output, "a page", (".html", ".htm"))
    from scenarios.viewing.report import make_report

    instead = replaced(output)
    with doing("choosing the camera") as tell:
        drawn_by = camera_here(camera)
        made = make_report(folders, output, camera=drawn_by, jobs=jobs, most=failures, within_s=within, tell=tell)
    size = f"{made.size_bytes / 1e6:.1f} MB, {made.shown} of {made.failures} failures"
    out.print(f"Report: {output} ({size}){instead}", soft_wrap=True, highlight=False)
