"""DS-RNN: changes of speed and heading, by recurrent networks of the robot and five people.

S. Liu, P. Chang, W. Liang, N. Chakraborty and K. Driggs-Campbell, "Decentralized structural-RNN for
robot crowd navigation with deep reinforcement learning", ICRA 2021; the model for a unicycle. Each
person has a place in the input with a memory of its own. Positions are in an arena: axes at rest,
found by odometry, with its centre between the robot and the goal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.network import Gru, softmax
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
    nearest_tracks,
    rotated,
    torch_layer,
)
from cosim.spec.manifest import Manifest
from cosim.spec.sensors import Tracks

PEOPLE: Final = 5
"""Number of people in the input."""
GOAL_MOST_M: Final = 12.0
"""Largest distance of a goal in the arena in metres, the width of the arena in training."""
GOAL_NEAR_M: Final = 4.0
"""Distance in metres from which a farther goal gets a new arena."""
RADIUS_M: Final = 0.3
"""Radius of the robot in training, in metres."""
PREFERRED_MPS: Final = 1.0
"""Preferred and largest speed in training, in m/s."""
MAX_CHANGE: Final = 0.1
"""Largest change of the speed in m/s, and of the heading in rad, in a step."""
STEP_S: Final = 0.1
"""Time step in seconds."""
FORGET_S: Final = 1.0
"""Time in seconds for which an unseen person is moved on with the last velocity."""
AWAY_M: Final = 15.0
"""Coordinates in the arena of a place without a person, in metres."""
_MOVED_M: Final = 0.5
"""Motion of a goal in metres that counts as a new goal."""
_NODE: Final = 128
_EDGE: Final = 256
_TEMPERATURE: Final = np.float32(PEOPLE / 8.0)
"""Factor of the attention: number of people over the square root of its 64 dimensions."""


class Memory(NamedTuple):
    """State of the recurrent networks.

    node: (128,).
    motion: (256,), of the robot's velocity.
    people: (5, 256), of the person in each place.
    """

    node: NDArray[np.float32]
    motion: NDArray[np.float32]
    people: NDArray[np.float32]


EMPTY: Final = Memory(
    np.zeros(_NODE, np.float32), np.zeros(_EDGE, np.float32), np.zeros((PEOPLE, _EDGE), np.float32)
)
"""Memory at the start of an episode."""


class DsrnnNetwork:
    """Network from states and memory to changes of speed and heading."""

    def __init__(self, arrays: Arrays) -> None:
        published = PublishedArrays(arrays)

        def gru(name: str) -> Gru:
            weights = [published.take(f"{name}.weight_{part}_l0") for part in ("ih", "hh")]
            biases = [published.take(f"{name}.bias_{part}_l0") for part in ("ih", "hh")]
            return Gru(*(np.ascontiguousarray(one.T) for one in weights), *biases)

        edges, node = "base.humanhumanEdgeRNN", "base.humanNodeRNN"
        self._motion_in = torch_layer(published, f"{edges}_temporal.encoder_linear", "relu")
        self._motion = gru(f"{edges}_temporal.gru")
        self._people_in = torch_layer(published, f"{edges}_spatial.encoder_linear", "relu")
        self._people = gru(f"{edges}_spatial.gru")
        self._query = torch_layer(published, "base.attn.temporal_edge_layer.0", "linear")
        self._keys = torch_layer(published, "base.attn.spatial_edge_layer.0", "linear")
        self._robot = torch_layer(published, "base.robot_linear", "linear")
        self._node_in = torch_layer(published, f"{node}.encoder_linear", "relu")
        self._edges_in = torch_layer(published, f"{node}.edge_attention_embed", "relu")
        self._node = gru(f"{node}.gru")
        self._actor = (
            torch_layer(published, f"{node}.output_linear", "linear"),
            torch_layer(published, "base.actor.0", "tanh"),
            torch_layer(published, "base.actor.2", "tanh"),
            torch_layer(published, "dist.fc_mean", "linear"),
        )

    def changes(
        self, robot: Floats, velocity: Floats, people: Floats, memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return (2,) unclipped changes of speed in m/s and heading in rad, and the next memory.

        robot: (7,) position, radius, goal, preferred speed and heading in the arena.
        velocity: (2,) of the robot.
        people: (5, 2) positions relative to the robot, in the arena's axes.
        """
        narrow = np.float32
        motion = self._motion.remember(
            self._motion_in.answer(velocity.astype(narrow)), memory.motion
        )
        crowd = self._people.remember(self._people_in.answer(people.astype(narrow)), memory.people)
        products = self._keys.answer(crowd) * self._query.answer(motion)
        scores = np.add.reduce(np.ascontiguousarray(products.T), axis=0)
        shares = softmax(_TEMPERATURE * scores)
        attended = np.add.reduce(shares[:, None] * crowd, axis=0)
        edges = self._edges_in.answer(np.concatenate((motion, attended)))
        own = self._node_in.answer(self._robot.answer(robot.astype(narrow)))
        node = self._node.remember(np.concatenate((own, edges)), memory.node)
        changes = chained(self._actor, node)
        return changes, Memory(node, motion, crowd)


@dataclass
class Place:
    """Place of a person in the input: id of the track, position and velocity in the arena's axes.

    seen_s: time of the last observation of the track.
    """

    track: int
    position: Floats
    velocity: Floats
    seen_s: float


@dataclass
class Places:
    """People in the order of the input. A person stays in place until forgotten or too far."""

    held: list[Place | None] = field(default_factory=lambda: [None] * PEOPLE)

    def update(self, tracks: Tracks, here: Floats, heading_rad: float, now_s: float) -> list[int]:
        """Take over tracks; return the places that were given to another person.

        here, heading_rad: (2,) position and heading of the robot.
        """
        rows = nearest_tracks(tracks, len(tracks.ids))
        ids = tracks.ids.tolist()
        found = {
            track: Place(track, here + position, velocity, now_s)
            for track, position, velocity in zip(
                ids,
                rotated(rows[:, :2], -heading_rad),
                rotated(rows[:, 2:], -heading_rad),
                strict=True,
            )
        }
        wanted = ids[:PEOPLE]
        for i, one in enumerate(self.held):
            if one is None or one.track in wanted:
                continue
            if one.track in found or now_s - one.seen_s > FORGET_S:
                self.held[i] = None
        return self._filled(found, wanted)

    def _filled(self, found: dict[int, Place], wanted: list[int]) -> list[int]:
        taken = []
        for track in wanted:
            at = [i for i, one in enumerate(self.held) if one is not None and one.track == track]
            free = at or self._free(found)
            if not free:
                continue
            taken += [] if at else free[:1]
            self.held[free[0]] = found[track]
        return taken

    def _free(self, found: dict[int, Place]) -> list[int]:
        """Return the places that are empty or of unseen people, longest unseen first."""
        unseen_s = [
            (-math.inf if one is None else one.seen_s, i)
            for i, one in enumerate(self.held)
            if one is None or one.track not in found
        ]
        return [i for _, i in sorted(unseen_s)]

    def relative(self, here: Floats, centre: Floats, now_s: float) -> Floats:
        """Return (5, 2) positions relative to the robot; unseen people are moved on."""
        away = centre + AWAY_M - here
        return np.array(
            [
                away if one is None else one.position + (now_s - one.seen_s) * one.velocity - here
                for one in self.held
            ]
        )


@dataclass
class Arena:
    """Frame of the input: its centre and the goal in the axes of the odometry, in metres.

    of: the observation's goal for which it was laid out.
    """

    centre: Floats
    goal: Floats
    of: Floats


def arena(last: Arena | None, here: Floats, goal: Floats) -> Arena:
    """Return the arena of a goal: the last one, or a new one around the robot and the goal.

    here, goal: (2,) in the axes of the odometry, metres.
    """
    far = math.dist(here, goal)
    if last is not None and math.dist(goal, last.of) <= _MOVED_M:
        cut = math.dist(goal, last.goal) > _MOVED_M
        if not (cut and math.dist(here, last.goal) < GOAL_NEAR_M):
            return last
    there = here + (goal - here) * min(1.0, GOAL_MOST_M / max(far, 1e-9))
    return Arena((here + there) / 2.0, there, goal)


class Dsrnn(NetworkPolicy):
    """DS-RNN (Liu et al. 2021): tracked people and a goal to changes of speed and heading."""

    manifest = Manifest(
        "dsrnn",
        rate_hz=10.0,
        camera=None,
        goal="route_point",
        goals=POINT_GOALS,
        odometry="wheel",
        people="seen",
    )
    files = (
        file_of(
            "crowdnav_dsrnn",
            "unicycle_55554.pt",
            "Shuijing725/CrowdNav_DSRNN, commit 91fb53c0, "
            "data/example_model_unicycle/checkpoints/55554.pt (MIT)",
            3904861,
            "e8b5ee59e289ebe87d98314ff701fe3893882b7e133a64ba5b68d1631a49120f",
        ),
    )

    def build(self, *files: bytes) -> None:
        self.network = DsrnnNetwork(read_torch_file(files[0]))

    def on_reset(self) -> None:
        self._memory = EMPTY
        self._places = Places()
        self._arena: Arena | None = None
        self._speed = 0.0

    def act(self, observation: Observation) -> Command:
        pose, tracks = observation.odometry, observation.people
        if pose is None or pose.heading_rad is None or tracks is None:
            raise ValueError("needs odometry with a heading, and tracked people")
        here, heading_rad = np.array([pose.x_m, pose.y_m]), pose.heading_rad
        distance_m, bearing_rad = goal_point(observation, math.inf)
        towards = heading_rad + bearing_rad
        goal = here + distance_m * np.array([math.cos(towards), math.sin(towards)])
        self._arena = arena(self._arena, here, goal)
        memories = self._memory.people.copy()
        memories[self._places.update(tracks, here, heading_rad, observation.time_s)] = 0.0
        velocity = observation.v_mps * np.array([math.cos(heading_rad), math.sin(heading_rad)])
        centre = self._arena.centre
        robot = np.concatenate(
            [
                here - centre,
                [RADIUS_M],
                self._arena.goal - centre,
                [PREFERRED_MPS, heading_rad % (2.0 * math.pi)],
            ]
        )
        people = self._places.relative(here, centre, observation.time_s)
        memory = self._memory._replace(people=memories)
        changes, self._memory = self.network.changes(robot, velocity, people, memory)
        faster, turn_rad = np.clip(changes, -MAX_CHANGE, MAX_CHANGE).tolist()
        self._speed = min(max(self._speed + faster, 0.0), PREFERRED_MPS)
        return clipped(Command(self._speed, turn_rad / STEP_S), observation.robot)
