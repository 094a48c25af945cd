"""Policy `follow`: detects people and walkable area with networks, and drives along the middle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import STILL, Command
from cosim.episode.interfaces import Observation
from cosim.policies.follow.networks import Networks
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.pictures import picture_tensor
from cosim.spec.camera import Calibration, CameraSpec
from cosim.spec.goal import PointGoal
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot

GROUND_CELL_M: Final = 0.1
"""Side of a cell in metres."""
GROUND_AHEAD_M: Final = 8.0
"""Metres ahead of the robot's centre covered by the map."""
GROUND_ASIDE_M: Final = 4.0
"""Metres to either side covered by the map."""
_STREET_INPUT: Final = PictureInput(
    size=(512, 256), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)
)
"""Preprocessing of the picture for ESPNetv2."""
_ROAD = 0
_SIDEWALK = 1
_LIGHT = 6
_SIGN = 7
_SKY = 10
_NO_OBSTACLE: Final = (_ROAD, _SIDEWALK, _LIGHT, _SIGN, _SKY)
"""Classes of Cityscapes that are not obstacles. A network trained on cars labels most of a near
sidewalk road. Lights, signs and sky are false detections in the joints of a pavement."""
_SPECKS: Final = 5
"""Size of the median filter in pixels."""


def walkable_pixels(rgb: NDArray[np.uint8], network: Graph) -> NDArray[np.bool_]:
    """Return (128, 256): whether a picture (H, W, 3) shows walkable area."""
    tensor = np.ascontiguousarray(
        picture_tensor(rgb, _STREET_INPUT).transpose(2, 0, 1)[None], np.float32
    )
    kinds = network.run({"picture": tensor}, ["scores"])["scores"][0].argmax(axis=0)
    free = np.isin(kinds, _NO_OBSTACLE).astype(np.uint8)
    return np.asarray(cv2.medianBlur(free, _SPECKS), np.bool_)


class Ground:
    """Map with cells of `GROUND_CELL_M`: rows ahead from the robot's centre, columns right to left.

    size: Width and height of the picture.
    """

    def __init__(self, camera: Calibration, size: tuple[int, int]) -> None:
        self._camera = camera
        self._size = size
        ahead = np.arange(0.0, GROUND_AHEAD_M, GROUND_CELL_M) + 0.5 * GROUND_CELL_M
        aside = np.arange(-GROUND_ASIDE_M, GROUND_ASIDE_M, GROUND_CELL_M) + 0.5 * GROUND_CELL_M
        x, y = np.meshgrid(ahead, aside, indexing="ij")
        points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=-1)
        in_camera = points @ np.linalg.inv(camera.on_robot).T
        depth = in_camera[..., 2]
        pixels = (in_camera[..., :3] @ camera.matrix.T)[..., :2] / np.where(
            depth > 0.0, depth, 1.0
        )[..., None]
        inside = ((pixels >= 0.0) & (pixels <= np.array(size) - 1.0)).all(axis=-1)
        self._seen = inside & (depth > 0.0)
        self._share = np.clip(pixels / np.array(size), 0.0, 0.999)

    def free(self, walkable: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (80, 80): whether cells are walkable; invisible cells count as walkable."""
        rows, columns = walkable.shape
        there = walkable[
            (self._share[..., 1] * rows).astype(int), (self._share[..., 0] * columns).astype(int)
        ]
        return np.asarray(there | ~self._seen)

    def ground_positions(self, boxes: Floats) -> Floats:
        """Return (N, 2) ground positions in the robot's frame of people in boxes (N, 4).

        People whose feet are above the horizon or beyond `GROUND_AHEAD_M` are left out.
        """
        if not len(boxes):
            return np.zeros((0, 2))
        bottom = np.minimum(boxes[:, 3], self._size[1] - 1.0)
        pixels = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), bottom, np.ones(len(boxes))], axis=1)
        rays = pixels @ np.linalg.inv(self._camera.matrix).T @ self._camera.on_robot[:3, :3].T
        at = self._camera.on_robot[:3, 3]
        down = rays[:, 2] < -1e-6
        way = at[2] / -rays[down, 2]
        feet: Floats = at[:2] + rays[down, :2] * way[:, None]
        return feet[feet[:, 0] < GROUND_AHEAD_M]


_SIDE_PX: Final = 416
"""Side of YOLOX-nano's input in pixels."""
_PEOPLE_INPUT: Final = PictureInput(
    size=(_SIDE_PX, _SIDE_PX), fit="corner", resample="linear", colour="bgr", scale=1.0
)
"""Preprocessing of the picture for YOLOX-nano."""
_STRIDES_PX: Final = (8, 16, 32)
"""Sides of the cells of YOLOX-nano's three grids in pixels."""
_PERSON: Final = 5
"""Column of class 0 (person), after centre, size and objectness."""
_SURE: Final = 0.35
"""Lowest confidence of a detected person."""
_OVERLAP: Final = 0.45
"""Overlap (IoU) above which the less confident of two boxes is dropped."""


def detect_people(rgb: NDArray[np.uint8], network: Graph) -> Floats:
    """Return (N, 4): left, top, right and bottom in pixels of people in a picture (H, W, 3)."""
    tensor = np.ascontiguousarray(
        picture_tensor(rgb, _PEOPLE_INPUT).transpose(2, 0, 1)[None], np.float32
    )
    output = network.run({"images": tensor}, ["output"])["output"][0]
    return decode_boxes(output, _SIDE_PX / max(rgb.shape[:2]))


def decode_boxes(output: NDArray[np.float32], scale: float) -> Floats:
    """Decode the network's output (3549, 85) to boxes (N, 4): left, top, right and bottom.

    scale: Size of the network's input relative to the picture.
    """
    corner, stride = _grid()
    confidence = output[:, 4] * output[:, _PERSON]
    kept = confidence > _SURE
    middle = (output[kept, :2] + corner[kept]) * stride[kept, None]
    size = np.exp(output[kept, 2:4]) * stride[kept, None]
    boxes = np.concatenate([middle - 0.5 * size, size], axis=1).astype(float) / scale
    if not len(boxes):
        return np.zeros((0, 4))
    chosen = np.array(
        cv2.dnn.NMSBoxes(boxes.tolist(), confidence[kept].tolist(), _SURE, _OVERLAP)
    ).ravel()
    best: Floats = boxes[chosen]
    best[:, 2:] += best[:, :2]
    return best


def _grid() -> tuple[Floats, Floats]:
    """Return the corner (x, y) of each cell in cells, and its side in pixels."""
    corners = []
    strides = []
    for stride in _STRIDES_PX:
        side = _SIDE_PX // stride
        rows, columns = np.mgrid[:side, :side]
        corners.append(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
        strides.append(np.full(side * side, float(stride)))
    return np.concatenate(corners), np.concatenate(strides)


_NEAR_M: Final = (2.5, 0.9)
"""Area in which a person is near, in metres: ahead of the robot's centre, and to either side."""
_WAITS_S: Final = 4.0
"""Longest time in seconds that the robot waits for people."""
_LOST_S: Final = 1.0
"""Seconds without a detection after which a person counts as gone."""


class WaitForPeople:
    """Timer of the wait for people nearby."""

    def __init__(self) -> None:
        self._first_s = self._last_s = -math.inf

    def stands(self, time_s: float, people: Floats) -> bool:
        """Return whether the robot waits, given people (N, 2) in its frame.

        >>> WaitForPeople().stands(1.0, np.array([[2.0, 0.0]]))
        True
        """
        near = (people[:, 0] > 0.0) & (people[:, 0] < _NEAR_M[0]) & (abs(people[:, 1]) < _NEAR_M[1])
        if not near.any():
            return False
        if time_s - self._last_s > _LOST_S:
            self._first_s = time_s
        self._last_s = time_s
        return time_s - self._first_s < _WAITS_S


ARC_LENGTH_M: Final = 5.0
"""Length of an arc in metres."""
_PERSON_M: Final = 0.45
"""Distance in metres to the centre of a person, in addition to `_CLEAR_M`."""
_CLEAR_M: Final = 0.10
"""Distance in metres between the robot's side and cells that are not walkable."""
_ROOM_M: Final = 1.2
"""Distance in metres to either side beyond which more space has no value."""
_STOPS_M: Final = 0.9
"""Free length in metres below which the robot stops."""
_SLOWS_M: Final = 1.5
"""Further free length in metres at which it drives at full speed."""
_TURNS_RAD: Final = math.radians(70.0)
"""Turn in radians at which arcs end, because the camera does not see beyond."""
_PACE: Final = 0.8
"""Full speed as a fraction of the robot's cruising speed."""
_ARCS: Final = 41
"""Number of arcs compared."""
_STEPS_M: Final = np.arange(0.3, ARC_LENGTH_M, GROUND_CELL_M)
"""Distances in metres along an arc at which it is checked."""
_ROOM = 0.8
"""Value of space to both sides, relative to the free length."""
_GOAL = 0.5
"""Cost per radian of difference to the goal's bearing."""
_STRAIGHT = 0.1
"""Cost per radian of turning, without a goal."""
_STEADY = 0.05
"""Cost per 1/m of difference to the previous curvature."""


@dataclass(frozen=True)
class Arc:
    """Arc from the robot's centre.

    curvature: In 1/m, positive to the left.
    free_m: Free length in metres.
    """

    curvature: float
    free_m: float


def best_arc(
    free: NDArray[np.bool_],
    people: Floats,
    robot: Robot,
    towards_rad: float | None,
    last: float = 0.0,
) -> Arc:
    """Return the best arc on cells from `Ground.free`.

    people: (N, 2) positions in metres.
    towards_rad: Bearing of the goal; None without a goal.
    last: Curvature of the previous arc in 1/m.
    """
    room_m = _room(free, people)
    curvatures = np.linspace(-1.0, 1.0, _ARCS) * robot.w_max_radps / (_PACE * robot.cruise_mps)
    x, y = _points(curvatures)
    rows = np.clip((x / GROUND_CELL_M).astype(int), 0, free.shape[0] - 1)
    columns = np.clip(((y + GROUND_ASIDE_M) / GROUND_CELL_M).astype(int), 0, free.shape[1] - 1)
    rooms = room_m[rows, columns]
    blocked = (rooms < 0.5 * robot.width_m + _CLEAR_M) | (
        np.abs(curvatures[:, None] * _STEPS_M) > _TURNS_RAD
    )
    first = np.where(blocked.any(axis=1), blocked.argmax(axis=1), len(_STEPS_M))
    free_m = np.where(
        first < len(_STEPS_M), _STEPS_M[np.minimum(first, len(_STEPS_M) - 1)], ARC_LENGTH_M
    )
    on_the_way = np.arange(len(_STEPS_M)) < np.maximum(first, 1)[:, None]
    mean_room = (np.minimum(rooms, _ROOM_M) * on_the_way).sum(axis=1) / on_the_way.sum(axis=1)
    end = np.arctan2(y[:, -1], x[:, -1])
    worth = free_m / ARC_LENGTH_M + _ROOM * mean_room / _ROOM_M
    worth -= (
        _STRAIGHT * np.abs(end)
        if towards_rad is None
        else _GOAL * np.abs(end - np.clip(towards_rad, -1.2, 1.2))
    )
    worth -= _STEADY * np.abs(curvatures - last)
    best = int(worth.argmax())
    return Arc(float(curvatures[best]), float(free_m[best]))


def command_along(arc: Arc, robot: Robot) -> Command:
    """Return the command along an arc, slower for a short free length; STILL if too short."""
    share = min((arc.free_m - _STOPS_M) / _SLOWS_M, 1.0)
    if share < 0.05:
        return STILL
    v_mps = _PACE * robot.cruise_mps * share
    return Command(v_mps, arc.curvature * v_mps)


def turn_aside(free: NDArray[np.bool_], robot: Robot) -> Command:
    """Return a turn on the spot, to the side with more walkable cells."""
    half = free.shape[1] // 2
    left = free[:, half:].sum()
    right = free[:, :half].sum()
    return Command(0.0, math.copysign(0.8 * robot.w_max_radps, float(left) - float(right)))


def _room(free: NDArray[np.bool_], people: Floats) -> NDArray[np.float32]:
    """Return metres from each cell to the nearest obstacle or person."""
    cells = free.astype(np.uint8)
    for x, y in people:
        middle = int((y + GROUND_ASIDE_M) / GROUND_CELL_M), int(x / GROUND_CELL_M)
        cv2.circle(cells, middle, round(_PERSON_M / GROUND_CELL_M), 0, thickness=-1)
    return np.asarray(
        cv2.distanceTransform(cells, cv2.DIST_L2, 5) * np.float32(GROUND_CELL_M), np.float32
    )


def _points(curvatures: Floats) -> tuple[Floats, Floats]:
    """Return (arcs, steps): x and y of points along arcs from the origin at `_STEPS_M`."""
    turned = curvatures[:, None] * _STEPS_M
    bent = np.where(np.abs(turned) < 1e-6, 1e-6, turned)
    return _STEPS_M * np.sin(bent) / bent, _STEPS_M * (1.0 - np.cos(bent)) / bent


_STUCK_S: Final = 0.6
"""Seconds of standing in front of an obstacle after which the robot turns on the spot."""


class Follow:
    """Follows the middle of the walkable area (ESPNetv2) and stops for people (YOLOX-nano).

    Raises UsageError if weights are missing, with their origin.
    """

    manifest = Manifest(
        "follow",
        rate_hz=5.0,
        camera=CameraSpec(512, 288, 60.0),
        goal="route_point",
        goals=("route_point", "final_point", "random_point", "none"),
    )

    def __init__(self) -> None:
        self._networks = Networks()
        self.digest = self._networks.digest
        self.on_reset()

    def reset(self, episode_id: str, seed: int) -> None:
        """Clear the state."""
        self.on_reset()

    def on_reset(self) -> None:
        """Clear the state."""
        self._waiting = WaitForPeople()
        self._last = 0.0
        self._stands_since_s: float | None = None
        self._turn: Command | None = None

    def act(self, observation: Observation) -> Command:
        rgb, camera = observation.rgb, observation.camera
        assert rgb is not None and camera is not None, "the manifest asks for a camera"
        robot, goal = observation.robot, observation.goal
        ground = Ground(camera, (rgb.shape[1], rgb.shape[0]))
        free = ground.free(walkable_pixels(rgb, self._networks.street))
        people = ground.ground_positions(detect_people(rgb, self._networks.people))
        if self._waiting.stands(observation.time_s, people):
            return STILL
        towards = goal.bearing_rad if isinstance(goal, PointGoal) else None
        arc = best_arc(free, people, robot, towards, self._last)
        self._last = arc.curvature
        command = command_along(arc, robot)
        if command != STILL:
            self._stands_since_s = self._turn = None
            return command
        if self._stands_since_s is None:
            self._stands_since_s = observation.time_s
        if self._turn is None and observation.time_s - self._stands_since_s >= _STUCK_S:
            self._turn = turn_aside(free, robot)
        return self._turn or STILL
