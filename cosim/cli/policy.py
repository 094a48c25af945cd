"""The command `cosim policy check`, which finds mistakes in adapted policies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.text import Text

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.generated_options import ConfiguredCommand, Fields, configured
from cosim.cli.options import Camera, Insecure, Tls, camera_here, check_output, replacement_note
from cosim.cli.progress import doing
from cosim.core.errors import SOME_CRASHED, unknown
from cosim.spec.run_config import RunConfig, run_connections

if TYPE_CHECKING:
    from cosim.spec.manifest import Manifest
    from scenarios.tools.policy_check.checks import CheckedPolicy

policy_app = typer.Typer(no_args_is_help=True, help="Checks of policies.")
_NAME_HELP = "As --policy of `cosim run` has it: a name, my.py:Class, onnx:FOLDER, zenoh:NAME."
_GOAL_HELP = "Goal protocol (`cosim list`), in place of its manifest's."
_FRAMES_HELP = "Observations of each drive; more than the policy's history has."
_OWN_CAMERA_HELP = "Allow a camera that the robot does not have."
_POLICY_AT_HELP = "Where `cosim serve` listens, for zenoh:NAME; may be repeated."
_OF_CHECK = Fields(only=("isolated", "policy_data", "policy_memory"))
"""Options that `cosim policy check` shares with `cosim run`."""
_COLOURS = {"passed": "green", "warning": "yellow", "failed": "red", "does not apply": "dim"}


@policy_app.callback()
def policies() -> None:
    """Make typer treat `policy` as a group although it has only one command."""


@policy_app.command(
    "check",
    cls=ConfiguredCommand,
    epilog="Examples:  \n`cosim policy check my.py:Mine -o check.png`  \n`cosim policy check "
    "onnx:bundle --json`  \n`cosim policy check zenoh:vint --policy-at tcp/127.0.0.1:7449 --goal "
    "image`",
)
@configured
def check_policy(
    name: Annotated[str, typer.Argument(metavar="NAME", help=_NAME_HELP)],
    config: Annotated[RunConfig, _OF_CHECK],
    only: Annotated[
        list[str] | None, typer.Option(help="Only this check; may be repeated.")
    ] = None,
    goal: Annotated[str, typer.Option(help=_GOAL_HELP)] = "",
    frames: Annotated[int, typer.Option(min=2, max=256, help=_FRAMES_HELP)] = 16,
    picture: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Write its answers, drawn into its pictures: a PNG."),
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
    """Check a policy's answers to streets, mirrored streets, wrong colours and other goals.

    Nothing is simulated. A check can pass, fail, doubt (the answer may be right, with the reason)
    or not apply. Exit code 1: a check has failed.
    """
    from cosim.episode.manifest_checks import with_goal
    from cosim.report.mapsheet import write_png
    from cosim.spec.goal import goal_called
    from scenarios.runs.policy_host import host_of, inspected_caller, policy_caller
    from scenarios.tools.policy_check.checks import POLICY_CHECKS, checked_policy
    from scenarios.tools.policy_check.drives import shown_drives
    from scenarios.tools.policy_check.sheet import check_sheet

    if picture is not None:
        check_output(picture, endings=(".png",))
    instead = replacement_note(picture)
    for check in only or ():
        if check not in POLICY_CHECKS:
            raise unknown("check", check, POLICY_CHECKS)
    asked_goal = goal_called(goal) if goal else None
    servers = run_connections(None, None, policy_at or (), tls, insecure).servers
    host = host_of(config, servers)
    expected = inspected_caller(name, host).manifest if host.isolated != "no" else None
    caller = policy_caller(name, host, expected=expected)
    try:
        manifest = with_goal(caller.manifest, asked_goal)
        with doing(f"checking {name}") as progress:
            drives = shown_drives(manifest, frames, camera_here(camera), own_camera, progress)
            found = checked_policy(caller, manifest, drives, progress, only or ())
            if picture is not None:
                progress("drawing")
                write_png(check_sheet(found.query), picture)
    finally:
        caller.close()
    if as_json:
        _print_json(found, manifest, caller.source_hash)
    else:
        _print_outcomes(found, manifest)
        if picture is not None:
            out.print(f"Picture: {picture}{instead}", soft_wrap=True, highlight=False)
    if found.count("failed"):
        raise typer.Exit(SOME_CRASHED)


def _print_json(found: CheckedPolicy, manifest: Manifest, source_hash: str) -> None:
    """Print the outcomes of all checks as one JSON object."""
    report = {
        "policy": manifest.name,
        "version": manifest.version,
        "source": source_hash,
        "goal": manifest.goal,
        "answers": found.answers,
        "answer_ms": found.answer_ms,
        "checks": {check: one._asdict() for check, one in found.outcomes.items()},
    }
    typer.echo(msgspec.json.format(msgspec.json.encode(report), indent=2).decode())


def _print_outcomes(found: CheckedPolicy, manifest: Manifest) -> None:
    """Print a row per check, and a line with their numbers."""
    rows = [
        (name, Text(outcome, _COLOURS[outcome]), seen)
        for name, (outcome, seen) in found.outcomes.items()
    ]
    tables.show(
        out, [*tables.names("check"), *tables.labels(""), *tables.words("what was seen")], rows
    )
    out.print(
        f"{manifest.name} {manifest.version}, goal {manifest.goal}: {found.count('passed')} "
        f"passed, {found.count('warning')} doubted, {found.count('failed')} failed, "
        f"{found.count('does not apply')} do not apply; an answer takes {found.answer_ms:.1f} "
        f"ms (median of {found.answers})",
        soft_wrap=True,
        highlight=False,
    )
