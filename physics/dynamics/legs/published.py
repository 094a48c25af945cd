"""Load the gait of a robot: its manifest, and the network in a folder of weights."""

from __future__ import annotations

from pathlib import Path
from cosim.core.npz import read_npz
from cosim.spec.robot import Legs, Robot
from physics.dynamics.legs.gait_manifest import read_gait_manifest
from physics.dynamics.legs.network import network_of
from physics.dynamics.legs.network_gait import NetworkGait, NetworkSetup
from physics.robots.make_urdf import MODELS
from cosim.policies.onnx.weights import weights_file
import physics.robots


def published_gait(robot: Robot, legs: Legs, dt_s: float) -> NetworkGait:
    m = read_gait_manifest(Path(physics.robots.__file__).parent / f"{robot.name}_gait.json")
    m.check_robot(robot, dt_s)
    path = weights_file(robot.name, m.model, None, m.source)
    return NetworkGait(robot, legs, dt_s, NetworkSetup(m, network_of(read_npz(path))), MODELS[robot.name])
