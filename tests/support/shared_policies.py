"""Policies for test_shared_renderer.py, in the processes of its runs, whose answers depend on their
observations."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import ImageGoal
from cosim.spec.manifest import Manifest

NOTES = "SHARED_NOTES"
"""Environment variable with the path of a file for notes: queried episodes and the process."""


class Seeing:
    """Drives by the brightness of a part of 48 x 32 pixels of its picture, so that any changed bit
    changes the state hash."""

    manifest = Manifest("seeing", rate_hz=4.0, camera=CameraSpec(64, 40, crop=(8, 4, 56, 36)))

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps no state."""

    def act(self, observation: Observation) -> Command:
        assert observation.rgb is not None
        left, right = (
            float(half.mean()) for half in (observation.rgb[:, :24], observation.rgb[:, 24:])
        )
        return Command(0.6 + left / 1000.0, (left - right) / 100.0)


class Together(Seeing):
    """Drives by the brightness of its picture, queried for all episodes together."""

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        if NOTES in os.environ:
            with Path(os.environ[NOTES]).open("a") as notes:
                notes.write(f"{os.getpid()} {' '.join(one.episode for one in observations)}\n")
        return [self.act(observation) for observation in observations]

    def ended(self, episode_id: str) -> None:
        if NOTES in os.environ:
            with Path(os.environ[NOTES]).open("a") as notes:
                notes.write(f"ended {episode_id}\n")


class Guided(Together):
    """Drives by all parts of its observation: a picture goal, labels, odometry and calibration.
    Every other answer is waypoints."""

    manifest = Manifest(
        "guided",
        rate_hz=4.0,
        camera=CameraSpec(48, 32, labels=True),
        goal="image",
        odometry="wheel",
    )

    def act(self, observation: Observation) -> Command | Floats:  # type: ignore[override]
        goal, odometry, camera = observation.goal, observation.odometry, observation.camera
        assert (
            isinstance(goal, ImageGoal)
            and goal.rgb.shape == (32, 48, 3)
            and observation.labels is not None
        )
        assert odometry is not None and odometry.heading_rad is not None and camera is not None
        turn = (
            float(goal.rgb.mean()) / 1000.0
            + float(observation.labels.mean()) / 100.0
            + odometry.heading_rad
        )
        command = Command(0.6 + odometry.x_m / 10.0, turn + float(camera.matrix[0, 2]) / 1000.0)
        if observation.tick % 10:
            return np.outer((1.0, 2.0, 3.0, 4.0), (0.1 * command.v_mps, 0.01 * turn))
        return command


class Spy:
    """Stands, and notes every text of its observations and of its process: arguments, environment,
    folder, names."""

    manifest = Manifest("spy", rate_hz=4.0, camera=None, privileged=True)

    def reset(self, episode_id: str, seed: int) -> None:
        process = [Path("/proc/self", name).read_bytes() for name in ("cmdline", "comm", "environ")]
        links = [
            str(path.readlink()) for path in Path("/proc/self/fd").iterdir() if path.is_symlink()
        ]
        threads = [thread.name for thread in threading.enumerate()]
        self.note(
            episode_id, seed, sys.argv, str(Path.cwd()), dict(os.environ), process, links, threads
        )

    def act(self, observation: Observation) -> Command:
        self.note(*texts_in(observation, set()))
        return STILL

    def note(self, *seen: object) -> None:
        with Path(os.environ[NOTES]).open("a") as notes:
            notes.write(f"{json.dumps(seen, default=repr)}\n")


def texts_in(value: object, known: set[int]) -> list[str]:
    """Yield every text that can be reached from a value by fields, attributes and items."""
    if isinstance(value, str | bytes):
        return [value if isinstance(value, str) else repr(value)]
    if (
        id(value) in known
        or value is None
        or isinstance(value, int | float | np.ndarray | type | ModuleType)
    ):
        return []
    known.add(id(value))
    if isinstance(value, Mapping):
        parts = [*value.keys(), *value.values()]
    elif isinstance(value, tuple | list | set | frozenset):
        parts = [*value]
    else:
        names = {
            *getattr(value, "__dict__", ()),
            *(n for one in type(value).__mro__ for n in getattr(one, "__slots__", ())),
        }
        parts = [getattr(value, name, None) for name in names]
    return [text for part in parts for text in texts_in(part, known)]


class Knowing:
    """A blind and privileged policy that does what its episode is called at the third query."""

    manifest = Manifest("knowing", rate_hz=4.0, camera=None, privileged=True)

    def __init__(self) -> None:
        self.count: dict[str, int] = {}

    def reset(self, episode_id: str, seed: int) -> None:
        if episode_id == "fails-in-reset":
            raise FileNotFoundError("weights.pt")
        self.count[episode_id] = 0

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        assert known is not None and known.route is not None and known.free.area > 0.0
        assert known.robot.v_mps == observation.v_mps and known.people.xy.shape == (
            len(known.people),
            2,
        )
        self.count[observation.episode] += 1
        nearest = min(((known.people.xy - known.robot.pose.xy) ** 2).sum(axis=1), default=0.0)
        return Command(0.5 + 0.1 * nearest / (1.0 + nearest), 0.0)

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        answers = [self.act(observation) for observation in observations]
        for observation in observations:
            if self.now(observation, "raises"):
                raise KeyError("no such weight")
            if self.now(observation, "hangs"):
                time.sleep(3600)
            if self.now(observation, "exits"):
                os._exit(7)
            if self.now(observation, "closes"):
                os.closerange(3, 1024)
        return answers

    def now(self, observation: Observation, name: str) -> bool:
        return observation.episode == name and self.count[name] == 3
