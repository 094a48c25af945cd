"""The measurement `cosim bench legs`."""

from __future__ import annotations

from functools import partial

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.progress import doing
from cosim.core.errors import UsageError


def bench_legs(name: str, minutes: float, gait: str) -> None:
    """Measure how a robot with legs walks, and print the figures.

    minutes: simulated time of random commands
    gait: in place of the robot's own, onnx:FILE.onnx; "" for its own
    """
    from cosim.results.run_setup import gait_in_words
    from cosim.spec.robot import ROBOTS, Legs, robot_called
    from physics.dynamics.drive import SUBSTEP_S
    from physics.dynamics.drives import gait_drive
    from physics.dynamics.legs.gait_file import user_gait
    from scenarios.tools.bench.legs import measure, own_drive

    robot = robot_called(name)
    if not isinstance(robot.drive, Legs):
        legged = ", ".join(sorted(n for n, one in ROBOTS.items() if isinstance(one.drive, Legs)))
        raise UsageError(f"robot '{name}' has wheels; robots with legs: {legged}")
    setup = user_gait(gait, robot, SUBSTEP_S) if gait else None
    drive = own_drive if setup is None else partial(gait_drive, robot, setup)
    with doing("walking") as progress:
        rows = measure(robot, minutes, progress, drive)
    walked = name if setup is None else f"{name}, {gait_in_words(gait, setup.digest)}"
    tables.show(
        out, [*tables.names(walked), *tables.words("measured"), *tables.words("target")], rows
    )
