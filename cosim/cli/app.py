"""The `cosim` command line, assembled from the commands of the other modules."""

from __future__ import annotations

import signal
from functools import cache
from typing import Annotated, Any, NoReturn

import typer
from rich.markup import escape

from cosim.cli.bench import bench_app
from cosim.cli.collect import collect_app, dataset_app
from cosim.cli.console import err, guarded_streams
from cosim.cli.installation import cache_app, installation_app
from cosim.cli.network import certs_app, direct_app, live_app, serve_app
from cosim.cli.options import LEARN, MEASURE, PLACES, STEP_IN, with_paths_checked
from cosim.cli.pictures import (
    counterfactual_app,
    export_app,
    film_app,
    look_app,
    replay_app,
)
from cosim.cli.places import city_app, map_app
from cosim.cli.policy import policy_app
from cosim.cli.results import compare_app, merge_app, report_app, score_app, show_app
from cosim.cli.run import run_app
from cosim.cli.scan import scan_app
from cosim.cli.scenario import scenario_app
from cosim.cli.suites import list_app, suite_app
from cosim.cli.train import train_app
from cosim.cli.workers import coordinator_app, status_app
from cosim.core.cache import cache_limit_bytes
from cosim.core.errors import CosimError, file_error

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Sidewalk-navigation benchmark: SUMO crowds, a PyBullet robot, Zenoh between them.",
    epilog="Examples:  \n`cosim run long-horizon --policy route --episodes 2`  \n`cosim COMMAND "
    "--help`\n\nExit codes: 0 done, of a run: all is scored; 1 ended, but not all is scored, or a "
    "check has failed; 2 wrong use or bad input; 3 the machine or an engine; 4 the time of "
    "--minutes is over; 130 interrupted, by Ctrl-C or SIGTERM: finished episodes are stored; 141 "
    "the output was closed early.",
)
for commands in (
    *(run_app, list_app, show_app, installation_app, cache_app),
    *(look_app, film_app, report_app, replay_app, export_app, counterfactual_app),
    *(live_app, direct_app, serve_app, merge_app, coordinator_app, status_app),
    *(bench_app, score_app, compare_app, collect_app, train_app),
):
    app.add_typer(commands)
app.add_typer(certs_app, name="certs", rich_help_panel=STEP_IN)
app.add_typer(dataset_app, name="dataset", rich_help_panel=LEARN)
app.add_typer(suite_app, name="suite", rich_help_panel=MEASURE)
app.add_typer(scenario_app, name="scenario", rich_help_panel=MEASURE)
app.add_typer(policy_app, name="policy", rich_help_panel=MEASURE)
app.add_typer(city_app, name="city", rich_help_panel=PLACES)
app.add_typer(map_app, name="map", rich_help_panel=PLACES)
app.add_typer(scan_app, name="scan", rich_help_panel=PLACES)


def _print_versions(requested: bool) -> None:
    """Print the versions and exit if `--version` is given."""
    if requested:
        from cosim.core.versions import versions_in_words

        typer.echo(versions_in_words())
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_versions,
            is_eager=True,
            help="Print the versions and exit.",
        ),
    ] = False,
) -> None:
    """Define the options of `cosim` itself, and refuse an invalid cache limit first."""
    cache_limit_bytes()


def main() -> None:
    """Run the command line. SIGTERM ends it like Ctrl-C: exit code 130, no half-written files."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with guarded_streams():
        try:
            _command()()
        except CosimError as error:
            _end(error)
        except OSError as error:
            if error.filename is None:
                raise
            _end(file_error(error))


@cache
def _command() -> Any:
    """Return the Typer command with all subcommands, built once."""
    return with_paths_checked(typer.main.get_command(app))


def _end(error: CosimError) -> NoReturn:
    err.print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True, highlight=False)
    raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
