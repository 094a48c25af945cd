"""Trace of a case, part by part and tick by tick. The first difference of two traces shows its
cause.
"""

from __future__ import annotations

import base64
import hashlib
import zlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.state import Frame, RobotState, Street
from cosim.episode.loop import Step
from cosim.policies.load import load_policy
from cosim.results.referee import Verdict
from cosim.spec.camera import CameraSpec
from cosim.spec.options import CameraName
from cosim.spec.scenario import Scenario, content_hash
from physics.cameras.choice import camera_of
from physics.dynamics.world import BulletWorld
from scenarios.episodes.episode import Episode
from scenarios.episodes.run_episode import drive
from scenarios.episodes.wiring import StagedScenario

POLICY: Final = "orca"
CAMERAS: Final[tuple[CameraName, ...]] = ("bullet", "gl")
PICTURE_AT_TICK: Final = 60
DIGITS: Final = 3
_BLOCKS: Final = 12
"""Number of means along each side of the small copy of a picture."""
_SPEC: Final = CameraSpec(width=96, height=96, fov_deg=75.0)


class Shown(msgspec.Struct, frozen=True):
    """Picture of a camera.

    hash: of colours and labels.
    small: (12, 12, 3) uint8 means of blocks of the colours, packed.
    labels: (96, 96) uint8, packed.
    """

    hash: str
    small: str
    labels: str

    def beside(self, other: Shown) -> tuple[float, float]:
        """Return the share of pixels with equal labels, and the largest difference of a mean."""
        same = float((_unpacked(self.labels) == _unpacked(other.labels)).mean())
        return same, float(np.abs(_unpacked(self.small).astype(int) - _unpacked(other.small)).max())


class Trace(msgspec.Struct, frozen=True, kw_only=True):
    """Trace of a case.

    ticks: for each of PARTS three hex digits a tick, the first before the first tick.
    pictures: by camera, of the available cameras.
    """

    scenario_hash: str
    ticks: dict[str, str]
    ended: str
    state_hash: str
    measures: dict[str, float | None]
    pictures: dict[str, Shown]


def _street(street: Street) -> list[bytes]:
    people, vehicles = street.people, street.vehicles
    arrays = (
        people.xy,
        people.heading,
        people.kind,
        people.age,
        vehicles.xy,
        vehicles.heading,
        vehicles.speed,
    )
    names = (
        people.ids,
        vehicles.ids,
        sorted((name, signal.walk) for name, signal in street.signals.items()),
    )
    return [*(np.ascontiguousarray(array).tobytes() for array in arrays), repr(names).encode()]


def _robot(robot: RobotState) -> bytes:
    return np.array([*robot.pose, robot.v_mps, robot.w_radps, robot.z_m, robot.tilt_rad]).tobytes()


PARTS: Final[Mapping[str, Callable[[Step, Verdict], list[bytes]]]] = {
    "policy": lambda step, _: [np.array([step.command.v_mps, step.command.w_radps]).tobytes()],
    "events": lambda step, _: [msgspec.msgpack.encode(step.events)],
    "crowd": lambda step, _: _street(step.street_after),
    "robot": lambda step, _: [
        _robot(step.motion.robot),
        step.motion.trace.tobytes(),
        repr(step.motion.contacts).encode(),
    ],
    "referee": lambda _, verdict: [repr(verdict).encode()],
}
"""Parts of a tick in the order of their dependencies."""


def traced(case: Scenario) -> Trace:
    """Run a case with the oracle and take its trace. Raises what an Episode raises."""
    digits_of: dict[str, list[str]] = {part: [] for part in PARTS}
    pictures: dict[str, Shown] = {}
    stages: list[StagedScenario] = []

    def watch(step: Step, verdict: Verdict) -> None:
        if step.tick == 0:
            before = {"crowd": _street(step.street), "robot": [_robot(step.robot)]}
            for part in PARTS:
                digits_of[part].append(_digits(before.get(part, [])))
        for part, data in PARTS.items():
            digits_of[part].append(_digits(data(step, verdict)))
        if step.tick == PICTURE_AT_TICK:
            pictures.update(_pictures(stages[0], case, step))

    caller = load_policy(POLICY)
    with Episode(case, caller.manifest, watches=[watch], through=stages.append) as episode:
        drive(episode, caller)
        record, _ = episode.result()
    return Trace(
        scenario_hash=content_hash(case),
        ticks={part: "".join(digits) for part, digits in digits_of.items()},
        ended=str(record.ended),
        state_hash=record.state_hash,
        measures=record.measures,
        pictures=pictures,
    )


def _digits(data: list[bytes]) -> str:
    return hashlib.blake2b(b"|".join(data), digest_size=2).hexdigest()[:DIGITS]


def _pictures(stage: StagedScenario, case: Scenario, step: Step) -> dict[str, Shown]:
    """Return the picture of each available camera after a step."""
    taken: dict[str, Shown] = {}
    world = stage.engines.world
    assert isinstance(world, BulletWorld)
    for name in CAMERAS:
        with ExitStack() as stack:
            try:
                camera = stack.enter_context(camera_of(name, world, _SPEC, light=case.light))
            except EngineError:
                continue
            taken[name] = kept_picture(camera.render(step.motion.robot, step.street_after))
    return taken


def kept_picture(frame: Frame) -> Shown:
    """A frame of 96 x 96 pixels, with labels."""
    labels = np.zeros(frame.rgb.shape[:2], np.uint8) if frame.labels is None else frame.labels
    side = frame.rgb.shape[0] // _BLOCKS
    means = frame.rgb.reshape(_BLOCKS, side, _BLOCKS, side, 3).mean(axis=(1, 3)).round()
    seen = hashlib.blake2b(np.ascontiguousarray(frame.rgb).tobytes(), digest_size=8)
    seen.update(np.ascontiguousarray(labels).tobytes())
    return Shown(seen.hexdigest(), _packed(means), _packed(labels))


def _packed(array: NDArray[Any]) -> str:
    return base64.b64encode(zlib.compress(array.astype(np.uint8).tobytes(), 9)).decode()


def _unpacked(text: str) -> NDArray[np.uint8]:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8)
