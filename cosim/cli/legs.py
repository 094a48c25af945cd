"""The measurement `cosim bench legs`."""

from __future__ import annotations

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.progress import doing
from cosim.core.errors import UsageError


def bench_legs(name: str, minutes: float) -> None:
    """Measure how a robot with legs walks, and print the figures.

    minutes: simulated time of random commands
    """
    from cosim.spec.robot import ROBOTS, Legs, robot_called
    from scenarios.tools.bench.legs import measure

    robot = robot_called(name)
    if not isinstance(robot.drive, Legs):
        legged = ", ".join(sorted(n for n, one in ROBOTS.items() if isinstance(one.drive, Legs)))
        raise UsageError(f"robot '{name}' has wheels; robots with legs: {legged}")
    with doing("walking") as progress:
        rows = measure(robot, minutes, progress)
    tables.show(
        out, [*tables.names(name), *tables.words("measured"), *tables.words("target")], rows
    )
