"""`cosim certs`: a private authority and a certificate for each role."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer
from rich.table import Table

from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.core.errors import AccessError, unknown
from cosim.spec.connection import Role

certs_app = typer.Typer(no_args_is_help=True, help="Make, renew and show the certificates of --tls.")
_Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="NAME", help="A name or address that others reach it by; may be given again."),
]
_Days = Annotated[int, typer.Option(min=1, max=3650, help="How long it is valid.")]


@certs_app.command(
    epilog="Example, then copy each role's folder to where it is needed:  \n"
    "`cosim certs init certs --host hub.lan --host 10.0.0.7`  \n`cosim certs role certs worker`"
)
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder.")],
    host: _Hosts = None,
    days: _Days = 365,
) -> None:
    """Make a private authority, and the certificate of a coordinator, who is reached by each --host."""
    from bridge.security.authority import make_authority

    make_authority(folder, host or ["localhost", "127.0.0.1"], days)
    _print_made(folder / "coordinator")
    words = f"Keep {folder / 'ca.key'} to yourself: whoever has it can make every role."
    out.print(words, soft_wrap=True, markup=False, highlight=False)


@certs_app.command(
    epilog="Examples:  \n`cosim certs role certs viewer`  \n`cosim certs role certs policy --host gpu.lan`  \n"
    "`cosim certs role certs worker --renew`"
)
def role(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="What `cosim certs init` made.")],
    name: Annotated[str, typer.Argument(metavar="ROLE", help=", ".join(get_args(Role)) + ".")],
    host: _Hosts = None,
    days: _Days = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Replace the one that is there.")] = False,
) -> None:
    """Issue the certificate of a role. Who listens (a coordinator, a director, some policies) needs --host."""
    from bridge.security.authority import issue

    if name not in get_args(Role):
        raise unknown("role", name, get_args(Role))
    _print_made(issue(folder, cast(Role, name), host or [], days, renew=renew))


@certs_app.command("show", epilog="Examples:  \n`cosim certs show certs`  \n`cosim certs show certs/worker`")
def show_certificates(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="An authority's folder, or a role's.")],
) -> None:
    """Show whose the certificates of a folder are, how they are reached, what they may do, and until when."""
    from bridge.security.identity import identity_in, time_left
    from bridge.security.rights import RIGHTS

    places = (folder, *(folder / name for name in get_args(Role)))
    found = [path for path in places if (path / "cert.pem").exists()]
    if not found:
        raise AccessError(f"{folder} holds no certificate: `cosim certs init` makes one")
    table = Table("folder", "role", "reached by", "may", "valid until", box=None, padding=(0, 2, 0, 0))
    for path in found:
        who = identity_in(path)
        may = RIGHTS[who.role].words
        table.add_row(path.name, who.role, ", ".join(who.hosts), may, time_left(who))
    print_fitted(out, table, words=[2, 3])


def _print_made(place: Path) -> None:
    from bridge.security.identity import identity_in, time_left

    who = identity_in(place)
    names = f", reached by {', '.join(who.hosts)}" if who.hosts else ""
    words = f"{place}: role {who.role}{names}, valid until {time_left(who)}"
    out.print(words, soft_wrap=True, markup=False, highlight=False)
