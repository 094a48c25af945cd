"""Export the street of a scenario, with its robot, as a file for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import shapely

from cosim.core.clock import Clock
from cosim.core.errors import UsageError, unwritable
from cosim.core.progress import Progress, ignore
from cosim.core.state import RobotState
from cosim.spec.robot import Robot, robot_called
from cosim.spec.scenario import Scenario
from physics.cameras.gl.robot_body import parts_in_place
from physics.ground.mesh import Part
from physics.ground.tiles import tiles_touching
from physics.street.gltf import as_gltf
from physics.street.surface import Surface
from scenarios.episodes.replay import load_recorded
from scenarios.places.nets import surface_of_place

_AROUND_M: Final = 30.0
"""Largest distance of the written tiles from the route, in metres."""


def export_street(
    scenario: Scenario, path: Path, robot: RobotState | None = None, progress: Progress = ignore
) -> int:
    """Write the street along a scenario's route as .glb, and return the number of its tiles.

    It has fences, obstacles and the robot. y is up, x and -z are the map's x and y, in metres.

    robot: state of the robot, on wheels without its height; by default at rest at the start.

    Raises MachineError when the file cannot be written.
    """
    progress(f"reading the street map of {scenario.place.name}")
    surface = surface_of_place(scenario.place)
    keys = tiles_touching(shapely.buffer(shapely.LineString(scenario.route), _AROUND_M))
    body = _robot(surface, robot_called(scenario.robot), robot or RobotState(scenario.start_pose))
    written = as_gltf(surface, keys, scenario.barriers, progress, scenario.obstacles, body)
    try:
        path.write_bytes(written)
    except OSError as error:
        raise unwritable(path, error) from error
    return len(keys)


def recorded_robot(folder: Path, scenario_id: str, time_s: float) -> tuple[Scenario, RobotState]:
    """Return a scenario of a run, and its robot as recorded at a time.

    Raises UsageError for an unknown episode and for a time after its end.
    """
    recorded = load_recorded(folder, scenario_id)
    end_s = Clock().time_s(len(recorded.log))
    if not 0.0 <= time_s <= end_s:
        raise UsageError(f"--at {time_s:g}: '{scenario_id}' ended after {end_s:g} s")
    tick = Clock().ticks(time_s)
    if not tick:
        return recorded.scenario, RobotState(recorded.scenario.start_pose)
    return recorded.scenario, recorded.log.robot(tick - 1)


def _robot(surface: Surface, model: Robot, robot: RobotState) -> tuple[Part, ...]:
    """Return the parts of a robot in the map's frame; without attitude it is on the ground."""
    if robot.legs is None:
        height_m = surface.lean(robot.pose, model.drive.span_m)[0]
        robot = replace(robot, z_m=height_m)
    return parts_in_place(surface, model, robot)
