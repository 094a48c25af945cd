"""SARL: the velocity with the best value, by a network that attends to people.

C. Chen, Y. Liu, S. Kreiss and A. Alahi, "Crowd-robot interaction: crowd-aware robot navigation
with attention-based deep reinforcement learning", ICRA 2019. The robot may move in any direction.
For each of 81 velocities, people are moved on by a step; the value of the resulting state and the
reward of the step are added. The policy turns to the best velocity and drives its component ahead.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.network import Dense, softmax
from cosim.core.state import Command
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.converting import PublishedArrays
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.policies.published.network_policy import (
    POINT_GOALS,
    Arrays,
    NetworkPolicy,
    chained,
    file_of,
    goal_point,
    lengths,
    nearest_tracks,
    torch_layer,
)
from cosim.spec.manifest import Manifest

PEOPLE: Final = 5
"""Number of people in the input, as in training."""
GOAL_MOST_M: Final = 8.0
"""Largest distance of the goal in metres, as in training."""
RADIUS_M: Final = 0.3
"""Radius of the robot and of people in training, in metres."""
PREFERRED_MPS: Final = 1.0
"""Preferred speed in training, in m/s."""
STEP_S: Final = 0.25
"""Time step in seconds."""
DISCOUNT: Final = 0.9
"""Discount of the value, per second at 1 m/s."""
GAIN_PER_S: Final = 2.0
"""Gain of the turning rate on the bearing of the velocity in 1/s."""
PEOPLE_MOST_M: Final = 8.0
"""Largest distance of people in the input in metres, about that of training."""
EMPTY: Final = np.array([-3.0, 0.0, 0.0, 0.0])
"""Person in an empty place of the input: standing 3 m behind. The network learned with five."""
_SPEEDS: Final = 5
_DIRECTIONS: Final = 16
_DISCOMFORT_M: Final = 0.2
"""Distance in metres below which a step costs."""


def _velocities() -> Floats:
    """Return (81, 2): standing, and five exponential speeds in each of 16 directions."""
    speeds = [math.expm1((i + 1) / _SPEEDS) / math.expm1(1.0) for i in range(_SPEEDS)]
    angles = [2.0 * math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS)]
    moving = [
        (PREFERRED_MPS * speed * math.cos(angle), PREFERRED_MPS * speed * math.sin(angle))
        for angle in angles
        for speed in speeds
    ]
    return np.array([(0.0, 0.0), *moving])


VELOCITIES: Final = _velocities()
"""Velocities (81, 2) to choose from, in m/s."""


class SarlNetwork:
    """Network from states to their value."""

    def __init__(self, arrays: Arrays) -> None:
        published = PublishedArrays(arrays)

        def mlp(name: str, last: int, last_relu: bool = False) -> tuple[Dense, ...]:
            return tuple(
                torch_layer(published, f"{name}.{i}", "relu" if i < last or last_relu else "linear")
                for i in range(0, last + 1, 2)
            )

        self._person = mlp("mlp1", 2, last_relu=True)
        self._feature = mlp("mlp2", 2)
        self._attention = mlp("attention", 4)
        self._value = mlp("mlp3", 6)
        published.check_all_used()

    def values(self, joint: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (batch,) values of joint states.

        joint: (batch, people, 13), of each person distance of the goal, preferred speed, 0, radius
            and velocity of the robot, then position, velocity and radius of the person, distance,
            and sum of radii; axes with x to the goal.
        """
        count, people, width = joint.shape
        person = chained(self._person, joint.reshape(-1, width))
        feature = chained(self._feature, person).reshape(count, people, -1)
        person = person.reshape(count, people, -1)
        mean = _sum_over_people(person) / np.float32(people)
        attended = np.concatenate(
            (person, np.broadcast_to(mean[:, None], person.shape)), axis=2
        ).reshape(count * people, -1)
        shares = softmax(chained(self._attention, attended).reshape(count, people))
        crowd = _sum_over_people(shares[:, :, None] * feature)
        values = chained(self._value, np.concatenate((joint[:, 0, :6], crowd), axis=1))
        return values[:, 0]


def _sum_over_people(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the sum over the second of three axes, in its order."""
    total = numbers[:, 0].copy()
    for i in range(1, numbers.shape[1]):
        total += numbers[:, i]
    return total


def joint_states(goal: Floats, people: Floats) -> NDArray[np.float32]:
    """Return (81, N, 13): the states after a step with each velocity, for `SarlNetwork.values`.

    goal: (2,) position relative to the robot, metres.
    people: (N, 4) positions relative to the robot, and velocities.
    """
    there = people[:, :2] + STEP_S * people[:, 2:]
    here = STEP_S * VELOCITIES
    ahead = goal - here
    distance = lengths(ahead)[:, None]
    along = ahead / np.maximum(distance, 1e-9)
    along[distance[:, 0] < 1e-9] = (1.0, 0.0)

    def turned(vectors: Floats) -> Floats:
        """Return vectors (81, N, 2) in the axes of each state."""
        x = vectors[..., 0] * along[:, :1] + vectors[..., 1] * along[:, 1:]
        y = vectors[..., 1] * along[:, :1] - vectors[..., 0] * along[:, 1:]
        return np.stack([x, y], axis=-1)

    off = there[None] - here[:, None]
    shape = (len(here), len(people), 1)

    def each(numbers: Floats | float) -> Floats:
        return np.broadcast_to(np.asarray(numbers, dtype=float), shape)

    joint = np.concatenate(
        [
            each(distance[:, None]),
            each(PREFERRED_MPS),
            each(0.0),
            each(RADIUS_M),
            np.broadcast_to(turned(VELOCITIES[:, None]), (*shape[:2], 2)),
            turned(off),
            turned(np.broadcast_to(people[None, :, 2:], off.shape)),
            each(RADIUS_M),
            np.sqrt(off[..., :1] * off[..., :1] + off[..., 1:] * off[..., 1:]),
            each(2.0 * RADIUS_M),
        ],
        axis=2,
    )
    return joint.astype(np.float32)


def rewards(joint: NDArray[np.float32]) -> Floats:
    """Return (81,) the rewards of the authors' simulator for a step into each state."""
    apart = (joint[:, :, 11] - joint[:, :, 12]).astype(float).min(axis=1)
    close = np.where(apart < _DISCOMFORT_M, (apart - _DISCOMFORT_M) * 0.5 * STEP_S, 0.0)
    return np.where(apart < 0.0, -0.25, np.where(joint[:, 0, 0] < RADIUS_M, 1.0, close))


def action_values(network: SarlNetwork, goal: Floats, people: Floats) -> Floats:
    """Return (81,) the values of `VELOCITIES`. Arguments are those of `joint_states`."""
    joint = joint_states(goal, people)
    values: Floats = rewards(joint) + DISCOUNT ** (STEP_S * PREFERRED_MPS) * network.values(
        joint
    ).astype(float)
    return values


class Sarl(NetworkPolicy):
    """SARL (Chen et al. 2019): tracked people and a goal to the velocity of best value."""

    manifest = Manifest(
        "sarl", rate_hz=4.0, camera=None, goal="route_point", goals=POINT_GOALS, people="seen"
    )
    files = (
        file_of(
            "crowdnav_sarl",
            "rl_model.pth",
            "vita-epfl/CrowdNav, commit b8d79796 (pull request 34), "
            "crowd_nav/data/output-torch-1.7.0-converted (MIT)",
            389084,
            "c828d8af77408cabf91b25b0c8cc8f6a5199eac1d612bf2fd8ee004952521002",
        ),
    )

    def build(self, *files: bytes) -> None:
        self.network = SarlNetwork(read_torch_file(files[0]))

    def act(self, observation: Observation) -> Command:
        distance_m, bearing_rad = goal_point(observation, GOAL_MOST_M)
        goal = distance_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
        people = np.tile(EMPTY, (PEOPLE, 1))
        seen = nearest_tracks(observation.people, PEOPLE, PEOPLE_MOST_M)
        people[: len(seen)] = seen
        values = action_values(self.network, goal, people)
        velocity = VELOCITIES[int(np.argmax(values))].tolist()
        speed, off_rad = math.hypot(*velocity), math.atan2(velocity[1], velocity[0])
        ahead = Command(speed * max(math.cos(off_rad), 0.0), GAIN_PER_S * off_rad)
        return clipped(ahead, observation.robot)
