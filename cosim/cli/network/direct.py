"""`cosim direct`: the director as a process of its own."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from cosim.cli.options.endpoint import DIRECTOR, Insecure, Tls, listening, warned
from cosim.cli.options.panels import STEP_IN
from cosim.core.errors import INTERRUPTED

direct_app = typer.Typer()


@direct_app.command(
    rich_help_panel=STEP_IN,
    epilog="Example, in two terminals:  \n`cosim direct --listen tcp/127.0.0.1:7448`  \n"
    "`cosim run reactive --event frontal --policy orca --director tcp/127.0.0.1:7448`",
)
def direct(
    listen: Annotated[str, typer.Option(help="Where runs find it.")] = DIRECTOR,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Direct the event pedestrians of runs that were started with --director, until stopped.

    It keeps nothing: stop it, kill it and start it again in the middle of an episode, and the episode waits, goes on
    and comes to the same state hash. A run of other code is refused.
    """
    from bridge.session import open_session
    from scenarios.execution.directing import behaviours, direct_all

    with open_session(listening("director", "--listen", listen, tls, insecure), warned) as session:
        direct_all(session)
        print(f"directing at {listen}, behaviours {behaviours()}; stop with Ctrl-C", flush=True)
        try:
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None
