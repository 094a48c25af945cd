"""`cosim policy check`: what users of a policy get wrong and never notice."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.text import Text

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.options import Camera, Insecure, Tls, camera_here, check_output, replaced
from cosim.cli.progress import doing
from cosim.core.errors import SOME_CRASHED, unknown
from cosim.spec.run_config import ends_of_run

if TYPE_CHECKING:
    from scenarios.tools.policy_check.checks import CheckedPolicy

policy_app = typer.Typer(no_args_is_help=True, help="Policies: are they what they are taken for?")
_NAME_HELP = "As --policy of `cosim run` has it: a name, my.py:Class, onnx:FOLDER, zenoh:NAME."
_GOAL_HELP = "What it is told of where to go (`cosim list`), in place of what its manifest says."
_FRAMES_HELP = "Observations of each drive: more than the history of the policy is long."
_OWN_CAMERA_HELP = "It may see by a camera that the robot does not have."
_POLICY_AT_HELP = "Where `cosim serve` listens, for zenoh:NAME; may be repeated."
_COLOURS = {"passed": "green", "warning": "yellow", "failed": "red", "does not apply": "dim"}


@policy_app.callback()
def policies() -> None:
    """A group of commands, also while there is one of them."""


@policy_app.command(
    "check",
    epilog="Examples:  \n`cosim policy check my.py:Mine -o check.png`  \n`cosim policy check "
    "onnx:bundle --json`  \n`cosim policy check zenoh:vint --policy-at tcp/gpu:7449 --goal image`",
)
def check_policy(
    name: Annotated[str, typer.Argument(metavar="NAME", help=_NAME_HELP)],
    only: Annotated[
        list[str] | None, typer.Option(help="Only this check; may be repeated.")
    ] = None,
    goal: Annotated[str, typer.Option(help=_GOAL_HELP)] = "",
    frames: Annotated[int, typer.Option(min=2, max=256, help=_FRAMES_HELP)] = 16,
    picture: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Write what it answers, drawn into what it sees: a PNG."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="What came out, as JSON.")] = False,
    camera: Camera = "auto",
    own_camera: Annotated[bool, typer.Option("--own-camera", help=_OWN_CAMERA_HELP)] = False,
    policy_at: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help=_POLICY_AT_HELP)
    ] = None,
    tls: Tls = "",
    insecure: Insecure = False,
) -> None:
    """Ask a policy about streets, mirrored streets, wrong colours, old pictures, other goals: does
    it answer as it should?

    Nothing is simulated. A check can fail, doubt (what may be right, with the reason) or not apply;
    passing proves no more than what it asks. Exit code 1: one has failed.
    """
    from secrets import token_hex

    from cosim.episode.manifest_checks import with_goal
    from cosim.report.mapsheet import write_png
    from cosim.spec.goal import goal_called
    from cosim.spec.options import PolicyHost
    from scenarios.runs.policy_host import policy_driver
    from scenarios.tools.policy_check.checks import POLICY_CHECKS, checked_policy
    from scenarios.tools.policy_check.drives import drives_for
    from scenarios.tools.policy_check.sheet import check_sheet

    if picture is not None:
        check_output(picture, endings=(".png",))
    instead = replaced(picture)
    for check in only or ():
        if check not in POLICY_CHECKS:
            raise unknown("check", check, POLICY_CHECKS)
    asked_goal = goal_called(goal) if goal else None
    servers = ends_of_run(None, None, policy_at or (), tls, insecure).servers
    driver = policy_driver(name, PolicyHost(servers=servers, run=token_hex(8)))
    try:
        manifest = with_goal(driver.manifest, asked_goal)
        with doing(f"checking {name}") as progress:
            drives = drives_for(manifest, frames, camera_here(camera), own_camera, progress)
            found = checked_policy(driver, manifest, drives, progress, only or ())
            if picture is not None:
                progress("drawing")
                write_png(check_sheet(found.asker), picture)
    finally:
        driver.close()
    if as_json:
        told = {
            "policy": manifest.name,
            "version": manifest.version,
            "source": driver.source_hash,
            "goal": manifest.goal,
            "answers": found.answers,
            "answer_ms": found.answer_ms,
            "checks": {check: one._asdict() for check, one in found.outcomes.items()},
        }
        typer.echo(msgspec.json.format(msgspec.json.encode(told), indent=2).decode())
    else:
        _print(found)
        out.print(
            f"{manifest.name} {manifest.version}, goal {manifest.goal}: {found.count('passed')} "
            f"passed, {found.count('warning')} doubted, {found.count('failed')} failed, "
            f"{found.count('does not apply')} do not apply; an answer takes {found.answer_ms:.1f} "
            f"ms (median of {found.answers})",
            soft_wrap=True,
            highlight=False,
        )
        if picture is not None:
            out.print(f"Picture: {picture}{instead}", soft_wrap=True, highlight=False)
    if found.count("failed"):
        raise typer.Exit(SOME_CRASHED)


def _print(found: CheckedPolicy) -> None:
    rows = [
        (name, Text(outcome, _COLOURS[outcome]), seen)
        for name, (outcome, seen) in found.outcomes.items()
    ]
    tables.show(
        out, [*tables.names("check"), *tables.labels(""), *tables.words("what was seen")], rows
    )
