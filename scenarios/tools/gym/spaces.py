"""Observations and actions of a learner as Gymnasium spaces: a dictionary of arrays and an array.

The manifest chooses the observations, as for a policy of the benchmark. Units, frames and shapes
are those of `cosim.episode.interfaces.Observation`. Numbers outside the bounds of their space are
clipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, cast, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cosim.core.errors import UsageError, unknown
from cosim.core.state import LABELS, Command
from cosim.episode.control import check_numbers
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraPicture, CameraSpec
from cosim.spec.goal import GOALS, TextSpace
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot
from cosim.spec.sensors import PEOPLE_ROWS, TRACKING_RANGE_M, people_rows

Actions = Literal["command", "waypoints"]
SeenParts = dict[str, Any]
"""Observation of a learner: arrays, and a text if the goal is an instruction."""

_FARTHEST_M: Final = 10_000.0
_MAX_GYRO_RADPS: Final = 35.0
_MAX_ACCEL_MPS2: Final = 160.0
_MAX_PERSON_MPS: Final = 10.0


def seen_space(manifest: Manifest, robots: Sequence[Robot]) -> spaces.Dict:
    """Return the space of observations.

    robots: robots of the scenarios.

        speeds            (2,), m/s and rad/s
        picture, depth, labels   of the camera, where it has them
        picture_NAME, ...        of each further camera
        goal              as in the protocol; a point is (2,) metres ahead and to the left
        odometry          (3,), or (2,) without a heading
        scan              (rings, rays) metres, the lidar's range without a return
        imu               (6,) angular speeds in rad/s, specific force in m/s2
        people            (32, 5), nearest first: 1, x, y, and velocity; 0 in rows without one

    Raises UsageError for a manifest with inputs that only the simulator knows.
    """
    if manifest.privileged:
        raise UsageError(
            "a learner is given what a robot has: leave privileged=True out of the manifest"
        )
    fastest = np.array(
        [max(one.v_max_mps for one in robots), max(one.w_max_radps for one in robots)]
    )
    parts: dict[str, spaces.Space[Any]] = {"speeds": _box(2.0 * fastest)}
    for end, spec in _cameras(manifest):
        parts |= _picture_spaces(end, spec)
    parts |= _goal_space(manifest)
    if manifest.odometry != "none":
        heading = [] if manifest.odometry == "gps" else [2.0 * np.pi]
        parts["odometry"] = _box([_FARTHEST_M, _FARTHEST_M, *heading])
    if (scan := manifest.scan) is not None:
        parts["scan"] = spaces.Box(0.0, scan.range_m, (scan.rings, scan.rays), np.float32)
    if manifest.imu != "none":
        parts["imu"] = _box([*[_MAX_GYRO_RADPS] * 3, *[_MAX_ACCEL_MPS2] * 3])
    if manifest.people != "none":
        most = [1.0, *[2.0 * TRACKING_RANGE_M] * 2, *[_MAX_PERSON_MPS] * 2]
        parts["people"] = _box(np.tile(most, (PEOPLE_ROWS, 1)))
    return spaces.Dict(parts)


def seen_by(observation: Observation, space: spaces.Dict) -> SeenParts:
    """Convert an observation to its space."""
    parts: SeenParts = {"speeds": (observation.v_mps, observation.w_radps)}
    pictures: list[tuple[str, Observation | CameraPicture]] = [("", observation)]
    pictures += [(f"_{name}", one) for name, one in observation.pictures.items()]
    for end, one in pictures:
        parts |= {f"picture{end}": one.rgb, f"depth{end}": one.depth, f"labels{end}": one.labels}
    if observation.goal is not None:
        parts["goal"] = observation.goal.plain()
    if (odometry := observation.odometry) is not None:
        parts["odometry"] = [
            v for v in (odometry.x_m, odometry.y_m, odometry.heading_rad) if v is not None
        ]
    parts |= {"scan": observation.scan, "imu": observation.imu}
    if (people := observation.people) is not None:
        parts["people"] = people_rows(people)
    return {name: _within(parts[name], one) for name, one in space.items()}


def action_space_of(actions: Actions, manifest: Manifest, robots: Sequence[Robot]) -> spaces.Box:
    """Return the space of actions.

    `command`: (2,) forward speed in m/s, from 0, and yaw rate in rad/s, left positive.
    `waypoints`: (N, 2) ahead and to the left, in the unit of the manifest. The last one is
    followed.

    Raises UsageError.
    """
    v_mps, w_radps = max(one.v_max_mps for one in robots), max(one.w_max_radps for one in robots)
    if actions == "command":
        return spaces.Box(
            np.array([0.0, -w_radps], np.float32), np.array([v_mps, w_radps], np.float32)
        )
    if actions == "waypoints":
        rule = manifest.waypoints
        return _box(np.full((rule.index + 1, 2), v_mps * rule.dt_s / rule.unit_m))
    raise unknown("kind of actions", str(actions), get_args(Actions))


def action_as_answer(
    action: NDArray[np.floating[Any]], space: spaces.Box
) -> Command | NDArray[np.floating[Any]]:
    """Convert an action to the answer of a policy.

    Raises UsageError for an array of another shape than the space's. Raises PolicyError for one
    with more numbers than an answer may hold.
    """
    array = np.asarray(action)
    check_numbers(array.shape)
    if array.shape != space.shape:
        raise UsageError(
            f"an action of shape {array.shape}: this environment's are {space.shape}, {space}"
        )
    return array if array.ndim == 2 else Command(float(array[0]), float(array[1]))


def _box(most: Any) -> spaces.Box:
    high = np.asarray(most, np.float32)
    return spaces.Box(-high, high, dtype=np.float32)


def _pixels(shape: tuple[int, ...], most: int = 255) -> spaces.Box:
    return spaces.Box(0, most, shape, np.uint8)


def _cameras(manifest: Manifest) -> list[tuple[str, CameraSpec]]:
    """Return the name suffix of each camera's pictures, and the camera."""
    own = [] if manifest.camera is None else [("", manifest.camera)]
    return own + [(f"_{name}", spec) for name, spec in manifest.cameras.items()]


def _picture_spaces(end: str, spec: CameraSpec) -> dict[str, spaces.Space[Any]]:
    width, height = spec.size
    parts: dict[str, spaces.Space[Any]] = {f"picture{end}": _pixels((height, width, 3))}
    if spec.depth:
        parts[f"depth{end}"] = spaces.Box(0.0, _FARTHEST_M, (height, width), np.float32)
    if spec.labels:
        parts[f"labels{end}"] = _pixels((height, width), max(LABELS.values()))
    return parts


def _goal_space(manifest: Manifest) -> dict[str, spaces.Space[Any]]:
    goals = GOALS[manifest.goal].type
    if goals is None:
        return {}
    values = goals.space(manifest.picture_size)
    if isinstance(values, TextSpace):
        return {"goal": spaces.Text(values.most, charset=values.charset)}
    return {"goal": spaces.Box(values.low, values.high, values.shape, values.dtype)}


def _within(value: Any, space: spaces.Space[Any]) -> Any:
    """Convert a value to a part of the space: copied, of its type, and clipped to its bounds."""
    if not isinstance(space, spaces.Box):
        return value
    array = np.array(value, space.dtype)
    return (
        array
        if array.dtype == np.uint8
        else np.clip(array, space.low, space.high, out=cast(Any, array))
    )
