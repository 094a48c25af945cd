"""GA3C-CADRL: one of eleven speeds and turns, from the goal and the people around the robot.

M. Everett, Y. F. Chen and J. P. How, "Motion planning among dynamic, decision-making agents with
deep reinforcement learning", IROS 2018. An LSTM reads the people, the nearest last. The input and
the control of the heading are those of the authors' robot (mit-acl/cadrl_ros). All quantities are
in axes whose x points to the goal.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.network import Dense, Lstm
from cosim.core.state import PERSON_RADIUS_M, Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.converting import PublishedArrays
from cosim.policies.published.network_policy import (
    POINT_GOALS,
    Arrays,
    NetworkPolicy,
    chained,
    file_of,
    goal_point,
    lengths,
    nearest_tracks,
    rotated,
)
from cosim.policies.published.tensorflow_file import read_checkpoint
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot

MAX_PEOPLE: Final = 10
"""Number of people in the input, as in training."""
MAX_M: Final = 8.0
"""Distance in metres up to which people are in the input."""
GOAL_MOST_M: Final = 10.0
"""Largest distance of the goal in metres, about that of training."""
STANDING_MPS: Final = 0.2
"""Speed of people below which they count as standing."""
GAIN_PER_S: Final = 2.0
"""Gain of the turning rate on the change of heading in 1/s."""
_PREFERRED_MPS: Final = (0.5, 2.0)
"""Preferred speeds in training."""
_CELLS: Final = 64
_TURN: Final = math.pi / 6.0
ACTIONS: Final = (
    *((1.0, k * _TURN / 2.0) for k in (-2, -1, 0, 1, 2)),
    *((speed, k * _TURN) for speed in (0.5, 0.0) for k in (-1, 0, 1)),
)
"""Speeds as shares of the preferred speed, and changes of heading in radians."""
_HOST_MEAN: Final = np.array([0.0, 0.0, 1.0, 0.5])
_HOST_UNIT: Final = np.array([5.0, 3.14, 1.0, 1.0])
_OTHER_MEAN: Final = np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 1.0])
_OTHER_UNIT: Final = np.array([5.0, 5.0, 1.0, 1.0, 1.0, 5.0, 1.0])
_SOURCE: Final = (
    "mit-acl/gym-collision-avoidance, commit 90356409, "
    "gym_collision_avoidance/envs/policies/GA3C_CADRL/checkpoints/IROS18 (MIT)"
)


class CadrlNetwork:
    """Network from states to the logits of the actions."""

    def __init__(self, arrays: Arrays) -> None:
        published = PublishedArrays(arrays)
        kernel = published.take("rnn/lstm_cell/kernel:0", (7 + _CELLS, 4 * _CELLS))
        bias = published.take("rnn/lstm_cell/bias:0", (4 * _CELLS,)).copy()
        bias[2 * _CELLS : 3 * _CELLS] += np.float32(1.0)  # TensorFlow adds it to the forget gate
        gates = [np.arange(i * _CELLS, (i + 1) * _CELLS) for i in (0, 2, 1, 3)]
        order = np.concatenate(gates)  # TensorFlow has the cell's gate before the forget gate
        self._people = Lstm(np.ascontiguousarray(kernel[:, order]), bias[order])
        self._layers = tuple(
            Dense(
                published.take(f"{name}/kernel:0"),
                published.take(f"{name}/bias:0"),
                "linear" if name == "logits_p" else "relu",
            )
            for name in ("layer1", "layer2", "fullyconnected1", "logits_p")
        )

    def logits(self, host: Floats, others: Floats) -> NDArray[np.float32]:
        """Return (11,) logits of `ACTIONS`.

        host: (4,) distance of the goal, heading, preferred speed, radius.
        others: (N, 7) position, velocity, radius, sum of radii, distance; the nearest last.
        """
        output = cell = np.zeros(_CELLS, np.float32)
        for other in ((others - _OTHER_MEAN) / _OTHER_UNIT).astype(np.float32):
            output, cell = self._people.remember(other, output, cell)
        own = ((host - _HOST_MEAN) / _HOST_UNIT).astype(np.float32)
        return chained(self._layers, np.concatenate((own, output)))


def states(
    goal: tuple[float, float],
    people: Floats,
    radii_m: Floats,
    radius_m: float,
    preferred_mps: float,
) -> tuple[Floats, Floats]:
    """Return host and others as in `CadrlNetwork.logits`.

    goal: distance in metres and bearing in radians.
    people: (N, 4) positions in the robot's frame, and velocities; nearest first.
    radii_m: (N,) of people.
    radius_m, preferred_mps: of the robot.
    """
    distance_m, bearing_rad = goal
    velocity = np.where(lengths(people[:, 2:])[:, None] < STANDING_MPS, 0.0, people[:, 2:])
    both_m = radius_m + radii_m
    others = [
        rotated(people[:, :2], bearing_rad),
        rotated(velocity, bearing_rad),
        radii_m,
        both_m,
        lengths(people[:, :2]) - both_m,
    ]
    host = np.array([distance_m, -bearing_rad, preferred_mps, radius_m])
    return host, np.column_stack(others)[::-1]


def radius(robot: Robot) -> float:
    """Return the radius of the circle around a robot in metres."""
    return math.hypot(*robot.footprint_m) / 2.0


def preferred_mps(robot: Robot) -> float:
    """Return a robot's cruising speed, within the range of training."""
    least, most = _PREFERRED_MPS
    return min(max(robot.cruise_mps, least), most)


class Cadrl(NetworkPolicy):
    """GA3C-CADRL (Everett et al. 2018): tracked people and a goal to a speed and a turn."""

    manifest = Manifest(
        "cadrl", rate_hz=10.0, camera=None, goal="route_point", goals=POINT_GOALS, people="seen"
    )
    files = (
        file_of(
            "ga3c_cadrl",
            "network_01900000.index",
            _SOURCE,
            1420,
            "c662b005f25bdc792b763a2d5a4bb8f4a5c9b786fc8ae564561a037275cb3900",
        ),
        file_of(
            "ga3c_cadrl",
            "network_01900000.data-00000-of-00001",
            _SOURCE,
            2049180,
            "2fa944a6f206c9b7d801997dae74572b263ed190a0743ac72b822b1e2b23e38a",
        ),
    )

    def build(self, *files: bytes) -> None:
        self.network = CadrlNetwork(read_checkpoint(*files))

    def act(self, observation: Observation) -> Command:
        robot = observation.robot
        preferred = preferred_mps(robot)
        people = nearest_tracks(observation.people, MAX_PEOPLE, MAX_M)
        radii_m = np.full(len(people), PERSON_RADIUS_M)
        goal = goal_point(observation, GOAL_MOST_M)
        logits = self.network.logits(*states(goal, people, radii_m, radius(robot), preferred))
        speed, turn_rad = ACTIONS[int(np.argmax(logits))]
        return clipped(Command(speed * preferred, GAIN_PER_S * turn_rad), robot)
