"""`cosim serve`: a policy as a process of its own, here or on another machine."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.options.endpoint import POLICIES_AT, Insecure, Tls, connecting, listening, warned
from cosim.cli.options.panels import MANY
from cosim.core.errors import INTERRUPTED, UsageError

serve_app = typer.Typer()


@serve_app.command(
    "serve",
    rich_help_panel=MANY,
    epilog="Examples, each with a run in another terminal:  \n"
    "`cosim serve my.py:Mine --name mine`, "
    "`cosim run reactive --policy zenoh:mine --policy-at tcp/127.0.0.1:7449`  \n"
    "`cosim serve my.py:Mine --name mine --listen tls/0.0.0.0:7449 --tls certs/policy`  \n"
    "`cosim serve my.py:Mine --name mine --connect tcp/127.0.0.1:7449`: a further one, where another listens",
)
def serve_command(
    policy: Annotated[str, typer.Argument(help="Your own, as my.py:Class, or a baseline.")],
    name: Annotated[str, typer.Option(help="What runs ask for, as --policy zenoh:NAME; else the manifest's.")] = "",
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where runs find it.")] = POLICIES_AT,
    connect: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Instead: where another one listens, beside which runs find it.")
    ] = "",
    jpeg: Annotated[bool, typer.Option("--jpeg", help="Have pictures sent as JPEG; every row says so.")] = False,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Answer for a policy in runs of other processes, until stopped.

    A policy with act_batch is asked for all episodes that wait, together; any other has an object for each episode
    under way. Several servers of one name share the episodes; one that is killed loses its own, which are run again.
    Where cosim cannot be installed, copy bridge/policy_server.py and call its `serve`.
    """
    from bridge import keys
    from bridge.policy_server import serve
    from bridge.session import open_session
    from cosim.episode.driver import Untimed
    from cosim.episode.ports import Policy
    from cosim.policies.load import load_policy
    from scenarios.serving.observed import seen_from_afar

    first = load_policy(policy)
    if first.manifest.privileged:
        raise UsageError(
            f"policy '{policy}' is told what the simulator knows (privileged), and a remote one sees only observations"
        )
    spare = [first.policy]

    def another() -> Policy:
        return spare.pop() if spare else load_policy(policy, Untimed()).policy

    if connect:
        connection = connecting("policy", "--connect", connect, tls, insecure)
    else:
        connection = listening("policy", "--listen", listen, tls, insecure)
    with open_session(connection, warned) as session:
        serve(
            first.policy if first.batches else another,
            name=keys.name(name) if name else keys.chunk(first.manifest.name),
            listen=connection.listen,
            connect=connection.connect,
            jpeg=jpeg,
            told=first.manifest,
            source=first.source_hash,
            observe=seen_from_afar,
            session=session.itself,
        )
    raise typer.Exit(INTERRUPTED)
