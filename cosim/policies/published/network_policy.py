"""Common parts of published policies that take states: files of weights, layers, goals, people."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import UsageError
from cosim.core.geometry import Floats
from cosim.core.network import Activation, Dense
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.policies.onnx.converting import PublishedArrays
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.weights import NetworkFile, read_file, weights_file
from cosim.spec.goal import GoalProtocol, PointGoal, protocols_of
from cosim.spec.manifest import Manifest
from cosim.spec.sensors import Tracks

Arrays = Mapping[str, NDArray[Any]]
POINT_GOALS: Final[tuple[GoalProtocol, ...]] = protocols_of(PointGoal)
"""Goal protocols of networks that drive to a point."""
_MAX_BYTES: Final = 64 << 20
"""Largest size of a file of weights in bytes."""


class NetworkPolicy(ABC):
    """Policy of a published network, evaluated with the same bits on every processor.

    A subclass declares `manifest`, `files` and the licence, builds its network of the files' bytes,
    and acts. Its docstring's first line is its description in `cosim list`.

    digest: Hash of all files.

    Raises UsageError if a file is missing or differs, with its origin.
    """

    manifest: ClassVar[Manifest]
    files: ClassVar[tuple[NetworkFile, ...]]

    def __init__(self) -> None:
        digest = hashlib.blake2b()
        read = []
        for file in self.files:
            path = weights_file(
                f"policy '{self.manifest.name}'", file.name, file.facts, file.source
            )
            data = read_file(path, _MAX_BYTES)
            file.check(path, data)
            digest.update(data)
            read.append(data)
        self.digest = digest.hexdigest()
        try:
            self.build(*read)
        except ValueError as error:
            raise UsageError(f"{self.files[0].name}: {error}") from error
        self.on_reset()

    @abstractmethod
    def build(self, *files: bytes) -> None:
        """Build the network of the content of `files`. Raises ValueError for other weights."""

    @abstractmethod
    def act(self, observation: Observation) -> Command:
        """Return the command."""

    def reset(self, episode_id: str, seed: int) -> None:
        """Clear the state."""
        self.on_reset()

    def on_reset(self) -> None:  # noqa: B027
        """Clear the state, if there is one."""


def weights_in_words(policy: type[NetworkPolicy]) -> str:
    """Describe where a policy's weights are, or which are missing."""
    folders, missing = [], []
    for file in policy.files:
        try:
            folders.append(weights_file("", file.name, file.facts, file.source).parent)
        except UsageError:
            missing.append(file.name)
    return f"weights missing ({', '.join(missing)})" if missing else f"weights {folders[0]}"


def file_of(folder: str, name: str, source: str, size: int, sha256: str) -> NetworkFile:
    """Return a file in a folder of `$COSIM_WEIGHTS`."""
    return NetworkFile(f"{folder}/{name}", source, FileFacts(bytes=size, sha256=sha256))


def torch_layer(published: PublishedArrays, name: str, activation: Activation) -> Dense:
    """Return a fully connected layer of PyTorch, whose weight is (outputs, inputs)."""
    weight = published.take(f"{name}.weight")
    bias = published.take(f"{name}.bias", weight.shape[:1])
    return Dense(np.ascontiguousarray(weight.T), bias, activation)


def goal_point(observation: Observation, most_m: float) -> tuple[float, float]:
    """Return distance in metres and bearing in radians of the goal.

    most_m: largest distance; a farther goal counts as this far.
    Raises ValueError without a goal that is a point.
    """
    goal = observation.goal
    if not isinstance(goal, PointGoal):
        raise ValueError(f"needs a goal that is a point, not {type(goal).__name__}")
    return min(goal.distance_m, most_m), goal.bearing_rad


def nearest_tracks(people: Tracks | None, most: int, most_m: float = math.inf) -> Floats:
    """Return (N, 4): positions and velocities of the first tracks, which are the nearest.

    most, most_m: largest number and distance.

    Raises ValueError without tracked people.
    """
    if people is None:
        raise ValueError("needs tracked people (manifest: people='seen')")
    rows = np.asarray(people, dtype=np.float64).reshape(-1, 4)
    return rows[lengths(rows[:, :2]) <= most_m][:most]


def rotated(rows: Floats, angle_rad: float) -> Floats:
    """Return vectors (N, 2) in axes that are turned by an angle, counter-clockwise."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    x, y = rows[:, 0], rows[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def lengths(rows: Floats) -> Floats:
    """Return the lengths of vectors (N, 2)."""
    return np.sqrt(rows[:, 0] * rows[:, 0] + rows[:, 1] * rows[:, 1])


def chained(layers: tuple[Dense, ...], numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the outputs of fully connected layers in order, (outputs,) or (batch, outputs)."""
    for layer in layers:
        numbers = layer.answer(numbers)
    return numbers
