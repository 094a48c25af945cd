"""cosim: a benchmark for robots that deliver on sidewalks.

This module is the public API; everything that is not listed here is private. Names are imported on
first use, so importing cosim loads no engine.

    suite = cosim.load_suite("reactive")
    table = cosim.run(suite, "orca", episodes=2)

Or step through one episode:

    with cosim.Episode(suite.scenarios[0], policy.manifest) as episode:
        policy.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(policy.act(observation))
    record, log = episode.result()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cosim.rounding import settle_rounding

if TYPE_CHECKING:
    from cosim.core.errors import CosimError
    from cosim.core.state import Command
    from cosim.episode.interfaces import BatchPolicy, Observation, Policy
    from cosim.policies.load import load_policy
    from cosim.results.log import Log
    from cosim.results.record import Record
    from cosim.spec.camera import Calibration, CameraPicture, CameraSpec
    from cosim.spec.goal import ImageGoal, Instruction, PointGoal, RoutePatch
    from cosim.spec.manifest import Manifest, WaypointRule
    from cosim.spec.odometry import Odometry
    from cosim.spec.options import EpisodeOptions, PolicyHost
    from cosim.spec.robot import Mount, Robot
    from cosim.spec.scenario import Scenario, Suite
    from cosim.spec.sensors import Imu, Scan, ScanSpec, Tracks
    from scenarios.episodes.episode import Episode
    from scenarios.runs.run import run
    from scenarios.suites.catalog import load_suite
    from scenarios.tools.gym.make_env import make_env

settle_rounding()

__all__ = [
    "BatchPolicy",
    "Calibration",
    "CameraPicture",
    "CameraSpec",
    "Command",
    "CosimError",
    "Episode",
    "EpisodeOptions",
    "ImageGoal",
    "Imu",
    "Instruction",
    "Log",
    "Manifest",
    "Mount",
    "Observation",
    "Odometry",
    "PointGoal",
    "Policy",
    "PolicyHost",
    "Record",
    "Robot",
    "RoutePatch",
    "Scan",
    "ScanSpec",
    "Scenario",
    "Suite",
    "Tracks",
    "WaypointRule",
    "load_policy",
    "load_suite",
    "make_env",
    "run",
]

_HOMES = {
    "BatchPolicy": "cosim.episode.interfaces",
    "Calibration": "cosim.spec.camera",
    "CameraPicture": "cosim.spec.camera",
    "CameraSpec": "cosim.spec.camera",
    "Command": "cosim.core.state",
    "CosimError": "cosim.core.errors",
    "Episode": "scenarios.episodes.episode",
    "EpisodeOptions": "cosim.spec.options",
    "ImageGoal": "cosim.spec.goal",
    "Imu": "cosim.spec.sensors",
    "Instruction": "cosim.spec.goal",
    "Log": "cosim.results.log",
    "Manifest": "cosim.spec.manifest",
    "Mount": "cosim.spec.robot",
    "Observation": "cosim.episode.interfaces",
    "Odometry": "cosim.spec.odometry",
    "PointGoal": "cosim.spec.goal",
    "Policy": "cosim.episode.interfaces",
    "PolicyHost": "cosim.spec.options",
    "Record": "cosim.results.record",
    "Robot": "cosim.spec.robot",
    "RoutePatch": "cosim.spec.goal",
    "Scan": "cosim.spec.sensors",
    "ScanSpec": "cosim.spec.sensors",
    "Scenario": "cosim.spec.scenario",
    "Suite": "cosim.spec.scenario",
    "Tracks": "cosim.spec.sensors",
    "WaypointRule": "cosim.spec.manifest",
    "load_policy": "cosim.policies.load",
    "load_suite": "scenarios.suites.catalog",
    "make_env": "scenarios.tools.gym.make_env",
    "run": "scenarios.runs.run",
}
"""Module of each public name, for loading on demand (PEP 562)."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(
            f"module 'cosim' has no attribute '{name}'. It has: {', '.join(__all__)}"
        )
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__
