"""Serves InternVLA-N1 (Wei et al. 2026) where its code, its checkpoint and a GPU are.

    COSIM_INTERNVLA=~/InternVLA-N1 cosim serve docs/examples/internvla_n1.py:InternVlaN1 --name
    internvla-n1 cosim run unit --policy zenoh:internvla-n1 --goal instruction

Its authors' agent (`internnav.agent.internvla_n1_agent_realworld`) is asked with each picture and
the instruction, a flat plane for depth, no pose, and the camera's matrix. It answers with a way, or
with one of a few actions.
"""

from __future__ import annotations

import importlib
import os
from argparse import Namespace
from typing import Any, Final

import numpy as np

from cosim.core.errors import UsageError
from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import Instruction
from cosim.spec.manifest import Manifest, WaypointRule

CHECKPOINT_VARIABLE: Final = "COSIM_INTERNVLA"
_SIZE_PX: Final = 384
_PLANE_M: Final = 10.0
_LOOKS_DOWN: Final = 5
_HOPS: Final = 2
_ACTIONS: Final = {1: Command(0.5, 0.0), 2: Command(0.0, 0.5), 3: Command(0.0, -0.5)}
"""Forward, left and right: what 0.25 m and 15 degrees are in about half a second. 0 is to stop."""


class InternVlaN1:
    """The policy. agent: the authors', loaded from the checkpoint of `$COSIM_INTERNVLA` where none
    is given.

    Raises UsageError where that cannot be loaded, saying where it is to be had.
    """

    manifest = Manifest(
        "internvla-n1",
        rate_hz=5.0,
        camera=CameraSpec(_SIZE_PX, _SIZE_PX, 75.0),
        goal="instruction",
        goals=("instruction",),
        waypoints=WaypointRule(index=4, unit_m=1.0, dt_s=1.0, rule="atan2"),
    )

    def __init__(self, agent: Any = None) -> None:
        self._agent = _loaded() if agent is None else agent
        self._matrix = np.eye(4)

    def reset(self, episode_id: str, seed: int) -> None:
        """A new episode begins."""
        self._agent.reset()

    def on_reset(self) -> None:
        """What was seen before is no history."""
        self._agent.reset()

    def act(self, observation: Observation) -> Any:
        """Waypoints (N, 2), metres ahead and to the left, or a command."""
        rgb, goal, camera = observation.rgb, observation.goal, observation.camera
        assert rgb is not None and isinstance(goal, Instruction), "the manifest asks for both"
        if camera is not None:
            self._matrix[:3, :3] = camera.matrix
        depth = np.full(rgb.shape[:2], _PLANE_M, np.float32)
        for hop in range(_HOPS + 1):
            told = self._agent.step(
                rgb, depth, np.eye(4), goal.text, intrinsic=self._matrix, look_down=hop > 0
            )
            actions = [] if told.output_action is None else list(told.output_action)
            if _LOOKS_DOWN not in actions:
                break
        if told.output_trajectory is not None and not actions:
            return np.asarray(told.output_trajectory, float)[:, :2]
        return _ACTIONS.get(actions[0], STILL) if actions else STILL


def _loaded() -> Any:
    """The authors' agent."""
    folder = os.environ.get(CHECKPOINT_VARIABLE, "")
    try:
        agents = importlib.import_module("internnav.agent.internvla_n1_agent_realworld")
    except ImportError as error:
        raise UsageError(
            f"InternVLA-N1: github.com/InternRobotics/InternNav is to be on PYTHONPATH: {error}"
        ) from error
    if not folder:
        raise UsageError(
            f"InternVLA-N1: {CHECKPOINT_VARIABLE} must name the folder of "
            f"InternRobotics/InternVLA-N1-DualVLN's files"
        )
    size = {"resize_w": _SIZE_PX, "resize_h": _SIZE_PX}
    return agents.InternVLAN1AsyncAgent(
        Namespace(device="cuda:0", model_path=folder, num_history=8, plan_step_gap=4, **size)
    )
