"""The command line, put together: each command stands in a file of its own, in the room of its subject."""

from __future__ import annotations

import signal
from typing import Annotated, NoReturn

import typer
from rich.markup import escape

from cosim.cli.bench.bench import bench_app
from cosim.cli.installation.cache import cache_app
from cosim.cli.installation.verify import installation_app
from cosim.cli.network.certs import certs_app
from cosim.cli.network.direct import direct_app
from cosim.cli.network.live import live_app
from cosim.cli.network.serve import serve_app
from cosim.cli.options.file_path import with_paths_checked
from cosim.cli.options.panels import LEARN, MEASURE, PLACES, STEP_IN
from cosim.cli.pictures.export import export_app
from cosim.cli.pictures.film import film_app
from cosim.cli.pictures.look import look_app
from cosim.cli.places.city import city_app
from cosim.cli.places.map import map_app
from cosim.cli.policies.check import policy_app
from cosim.cli.results.compare import compare_app
from cosim.cli.results.report import report_app
from cosim.cli.results.score import score_app
from cosim.cli.results.show import show_app
from cosim.cli.runs.collect import collect_app
from cosim.cli.runs.coordinator import coordinator_app
from cosim.cli.runs.counterfactual import counterfactual_app
from cosim.cli.runs.dataset import dataset_app
from cosim.cli.runs.merge import merge_app
from cosim.cli.runs.replay import replay_app
from cosim.cli.runs.run import run_app
from cosim.cli.runs.status import status_app
from cosim.cli.runs.train import train_app
from cosim.cli.suites.catalog import list_app
from cosim.cli.suites.scenario import scenario_app
from cosim.cli.suites.suite import suite_app
from cosim.cli.terminal.consoles import err
from cosim.cli.terminal.streams import told_streams
from cosim.core.cache import cache_limit_bytes
from cosim.core.errors import CosimError, of_file

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Sidewalk-navigation benchmark: SUMO crowds, a PyBullet robot, Zenoh between them.",
    epilog="Examples:  \n`cosim run long-horizon --policy route --episodes 2`  \n`cosim COMMAND --help`\n\n"
    "Exit codes: 0 done, of a run: all is scored; 1 ended, but not all is scored, or a check has failed; 2 wrong use "
    "or bad input; 3 the machine or an engine; 130 interrupted, by Ctrl-C or SIGTERM: what is finished is kept; 141 "
    "nobody read what it printed.",
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


def _say_versions(asked: bool) -> None:
    """Print the versions and end, if asked for."""
    if asked:
        from cosim.core.versions import versions_in_words

        typer.echo(versions_in_words())
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_versions, is_eager=True, help="Say the versions and end.")
    ] = False,
) -> None:
    """Options of `cosim` itself. A limit of the cache that is none is refused before anything is made."""
    cache_limit_bytes()


def main() -> None:
    """Run the command line. SIGTERM ends it as Ctrl-C does: exit code 130, nothing half-written is left."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with told_streams():
        try:
            with_paths_checked(typer.main.get_command(app))()
        except CosimError as error:
            _end(error)
        except OSError as error:
            if error.filename is None:
                raise
            _end(of_file(error))


def _end(error: CosimError) -> NoReturn:
    err.print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True, highlight=False)
    raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
