"""Codec of observations for policies in other processes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Final

import msgspec
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from bridge.policy_server import EpisodeConstants, EpisodeDecoder
from cosim.core.geometry import Polyline
from cosim.core.state import (
    People,
    RobotState,
    Signal,
    Vehicles,
    write_protect,
    write_protected_copy,
)
from cosim.episode.interfaces import Observation, Privileged
from cosim.spec.camera import Calibration, CameraPicture
from cosim.spec.goal import decoded_goal
from cosim.spec.odometry import Odometry
from cosim.spec.robot import Robot, robot_called
from cosim.spec.sensors import Imu, Scan, ScanSpec, Tracks

Arrays = dict[str, NDArray[Any]]
_ROBOT_FIELDS: Final = tuple(
    name for name in Robot.__dataclass_fields__ if name not in ("urdf", "drive", "mounts")
)
"""Fields of a robot that are sent: its size and limits."""


def encode_extra(value: object) -> object:
    """Encode arrays and read-only mappings, which MessagePack does not know (an `enc_hook`)."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, MappingProxyType):
        return dict(value)
    raise NotImplementedError(f"a {type(value).__name__} cannot be sent")


def decode_extra(kind: type, packed: Any) -> Any:
    """Decode a write-protected array (a `dec_hook`)."""
    dtype, shape, data = packed
    return write_protected_copy(np.frombuffer(data, dtype).reshape(shape), dtype)


_Moment = tuple[
    RobotState, float, People, Vehicles, Mapping[str, Signal], tuple[tuple[str, float, float], ...]
]
"""The fields of `Privileged` that change during an episode, in their order."""
_encode = msgspec.msgpack.Encoder(enc_hook=encode_extra).encode
_decode_moment = msgspec.msgpack.Decoder(_Moment, dec_hook=decode_extra).decode
_decode_ground = msgspec.msgpack.Decoder(
    tuple[NDArray[np.float64], bytes, tuple[float, ...]], dec_hook=decode_extra
).decode


def encode_constants(seen: Observation) -> EpisodeConstants:
    """Encode the constants of an episode."""
    robot = {name: getattr(seen.robot, name) for name in _ROBOT_FIELDS}
    cameras = {name: one.camera for name, one in seen.pictures.items()}
    if seen.camera is not None:
        cameras[""] = seen.camera
    calibrations = {
        name: (one.matrix.tolist(), one.distortion.tolist(), one.on_robot.tolist())
        for name, one in cameras.items()
    }
    known = seen.privileged
    ground = (
        b""
        if known is None
        else _encode((known.route.points, shapely.to_wkb(known.free), known.waits_m))
    )
    lidar: dict[str, Any] = {}
    if seen.scan is not None:
        spec = seen.scan.spec
        lidar = msgspec.to_builtins(spec) | {"angles_rad": spec.angles_rad.tolist()}
    return EpisodeConstants(robot, calibrations, ground, lidar)


def encode_observation(seen: Observation) -> tuple[dict[str, Any], Arrays]:
    """Encode an observation: the fields of an `ActRequest`, and the arrays that belong to it."""
    arrays = {"rgb": seen.rgb, "depth": seen.depth, "labels": seen.labels}
    for name, one in seen.pictures.items():
        arrays |= {f"{name}/rgb": one.rgb, f"{name}/depth": one.depth, f"{name}/labels": one.labels}
    goal: dict[str, Any] | None = None
    if seen.goal is not None:
        goal = seen.goal.encoded()
        for name, value in [*goal.items()]:
            if isinstance(value, np.ndarray):
                arrays[f"goal.{name}"] = goal.pop(name)
    fields = {name: getattr(seen, name) for name in ("tick", "time_s", "v_mps", "w_radps", "reset")}
    fields["goal"] = goal
    if seen.odometry is not None:
        fields["odometry"] = msgspec.structs.astuple(seen.odometry)
    if seen.scan is not None:
        arrays["scan"] = seen.scan.ranges_m
    if seen.imu is not None:
        fields["imu"] = (*seen.imu.gyro_radps, *seen.imu.accel_mps2)
    if seen.people is not None:
        arrays |= {
            f"people.{name}": one for name, one in msgspec.structs.asdict(seen.people).items()
        }
    if (known := seen.privileged) is not None:
        fields["knowledge"] = _encode(
            (
                known.robot,
                known.route_s_m,
                known.people,
                known.vehicles,
                known.signals,
                known.crossings,
            )
        )
    return fields, {name: array for name, array in arrays.items() if array is not None}


class ObservationDecoder(EpisodeDecoder):
    """Decoder of the observations of one episode, to the same types as in this process.

    Raises an error for an invalid message.
    """

    makes: ClassVar[dict[str, Any]] = {
        "robot": lambda **fields: robot_called(fields["name"]),
        "camera": lambda **arrays: Calibration(
            **{name: write_protect(one) for name, one in arrays.items()}
        ),
        "picture": CameraPicture,
        "goal": lambda **fields: decoded_goal(fields),
        "odometry": Odometry,
        "lidar": lambda angles_rad, **fields: msgspec.convert(fields, ScanSpec),
        "scan": Scan,
        "imu": Imu,
        "people": Tracks,
        "observation": Observation,
    }
    _ground: tuple[Polyline, Polygon | MultiPolygon, tuple[float, ...]] | None = None

    def privileged(self, knowledge: bytes) -> Privileged:
        if self._ground is None:
            points, wkb, waits_m = _decode_ground(self.about.knowledge)
            free = shapely.from_wkb(wkb)
            if not isinstance(free, Polygon | MultiPolygon):
                raise ValueError(f"a {type(free).__name__} is no ground")
            shapely.prepare(free)
            self._ground = Polyline(points), free, waits_m
        route, free, waits_m = self._ground
        robot, route_s_m, people, vehicles, signals, crossings = _decode_moment(knowledge)
        return Privileged(
            robot, route, route_s_m, people, vehicles, signals, crossings, free, waits_m
        )
