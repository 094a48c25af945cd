"""Vehicles and robots of all pictures of a batch: culled and uploaded together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import LABELS, RobotState, Vehicles
from cosim.spec.robot import Robot
from physics.cameras.gl.instances import (
    Forms,
    Material,
    ThingArrays,
    Things,
    turned_instances,
)
from physics.cameras.gl.pool import Draws, Pool
from physics.cameras.gl.robot_body import link_parts, robot_parts
from physics.cameras.gl.shading import Pass
from physics.cameras.gl.shadows import SHADOW_REACH_M
from physics.cameras.gl.shots import Shots
from physics.cameras.posture import Posture, posture_of
from physics.cameras.view import VEHICLE_MARGIN_M
from physics.ground.mesh import Part
from physics.robots import urdf_path
from physics.robots.kinematics import angles_of, link_tree, turned
from physics.street import vehicles
from physics.street.surface import Surface

_MATERIALS: Final[tuple[Material, ...]] = ("solid", "cut-out")
_FLEETS_MAX: Final = 256


class _Placed(NamedTuple):
    """N objects.

    form: (N,) numbers of forms
    at: (N, 3) metres from the anchor
    turn: (N, 3) roll, pitch and heading
    paint: (N, 3)
    label: (N,)
    picture: (N,) numbers of the pictures
    shadow: (N,) 1 for shadows
    """

    form: NDArray[np.intp]
    at: Floats
    turn: Floats
    paint: Floats
    label: NDArray[np.intp]
    picture: NDArray[np.intp]
    shadow: NDArray[np.intp]


class Driven(NamedTuple):
    """Vehicles of a picture, and its robot if any.

    body: the robot itself is visible, not only its shadow
    shadows: they cast shadows
    """

    vehicles: Vehicles
    surface: Surface
    model: Robot
    robot: RobotState | None
    body: bool
    shadows: bool


class TrafficDrawing:
    """Drawing of vehicles and robots of the pictures of a batch."""

    def __init__(self, context: moderngl.Context, forms: Forms, rows: Pool) -> None:
        self._forms = forms
        self._things = Things(forms, rows)
        self._arrays = ThingArrays(context, forms, rows)
        self._draws = Draws(context)
        self._fleets: dict[tuple[tuple[str, ...], bytes], tuple[NDArray[np.intp], Floats]] = {}

    def set(
        self,
        driven: Sequence[Driven],
        shots: Shots,
        parts: NDArray[np.intp],
        scene_ids: NDArray[np.intp],
    ) -> None:
        """Upload the vehicles and robots of all pictures.

        parts: part of the batch of each picture, in order
        scene_ids: of the scenes of the pictures
        """
        both = self._vehicles(driven, shots), self._robots(driven, shots)
        placed = [one for one in both if one is not None]
        count = 2 * (int(parts[-1]) + 1)
        if placed:
            form, at, turn, paint, label, picture, shadow = (
                of[0] if len(of) == 1 else np.concatenate(of) for of in zip(*placed, strict=True)
            )
            rows = turned_instances(at, turn[:, 0], turn[:, 1], turn[:, 2], paint, label)
            self._things.set(form, rows, scene_ids[picture], 2 * parts[picture] + shadow, count)
        else:
            self._things.clear(count)
        self._draws.set([self._things.draws[material] for material in _MATERIALS])

    def draw(self, stage: Pass, shadows: int, part: int) -> None:
        """Draw the vehicles and robots of a part."""
        if stage == "still":
            return
        at = 2 * part + (stage == "moving")
        for step, material in enumerate(_MATERIALS):
            if self._draws.count(step, at, at + 1):
                array = self._arrays.of(material, stage != "colour", shadows)
                self._draws.draw(array, step, at, at + 1)

    def _vehicles(self, driven: Sequence[Driven], shots: Shots) -> _Placed | None:
        whose = np.repeat(np.arange(len(driven)), [len(one.vehicles) for one in driven])
        xy = np.concatenate([one.vehicles.xy for one in driven])
        middle = shots.middle[whose]
        shadows = np.array([one.shadows for one in driven])[whose]
        seen = shots.sees(whose, xy, VEHICLE_MARGIN_M)
        casts = shadows & (
            np.hypot(xy[:, 0] - middle[:, 0], xy[:, 1] - middle[:, 1]) < SHADOW_REACH_M
        )
        rows = np.concatenate([seen.nonzero()[0], casts.nonzero()[0]])
        if not len(rows):
            return None
        fleets = [self._fleet(one.vehicles) for one in driven]
        form, paint = (np.concatenate(column) for column in zip(*fleets, strict=True))
        lean = np.concatenate([_leaning(one) for one in driven])[rows]
        heading = np.concatenate([one.vehicles.heading for one in driven])[rows]
        picture = whose[rows]
        at = np.column_stack([xy[rows] - shots.anchor[picture], lean[:, 0]])
        turn = np.column_stack([lean[:, 1:], heading])
        label = np.full(len(rows), LABELS["vehicle"])
        shadow = (np.arange(len(rows)) >= seen.sum()).astype(np.intp)
        return _Placed(form[rows], at, turn, paint[rows], label, picture, shadow)

    def _fleet(self, which: Vehicles) -> tuple[NDArray[np.intp], Floats]:
        """Return (N,) forms of vehicles, and their (N, 3) paints."""
        key = which.ids, which.size.tobytes()
        if key not in self._fleets:
            if len(self._fleets) >= _FLEETS_MAX:
                self._fleets.clear()
            forms = [
                self._form(name, *size)
                for name, size in zip(which.ids, which.size.tolist(), strict=True)
            ]
            paints = np.array([vehicles.vehicle_colour(name) for name in which.ids]).reshape(-1, 3)
            self._fleets[key] = np.array(forms, dtype=np.intp), paints
        return self._fleets[key]

    def _form(self, name: str, length_m: float, width_m: float) -> int:
        size = tuple(np.array([length_m, width_m]).round(1).tolist())
        shape = vehicles.vehicle_shape(name, size[0])
        return self._forms.id(("vehicle", shape, *size), partial(_vehicle_parts, shape, *size))

    def _robots(self, driven: Sequence[Driven], shots: Shots) -> _Placed | None:
        """Return the robots in their postures."""
        forms: list[int] = []
        rows: list[tuple[float, ...]] = []
        pictures: list[int] = []
        shadow: list[int] = []
        for k, (one, anchor) in enumerate(zip(driven, shots.anchor, strict=True)):
            shown = [0] * one.body + [1] * one.shadows
            if one.robot is None or not shown:
                continue
            posture = posture_of(one.surface, one.model, one.robot)
            for form, row in self._bodies(one.model, posture, anchor):
                forms += len(shown) * [form]
                rows += len(shown) * [row]
                pictures += len(shown) * [k]
                shadow += shown
        if not rows:
            return None
        at = np.array(rows)
        label = np.full(len(rows), LABELS["robot"])
        found = at[:, :3], at[:, 3:], np.ones((len(rows), 3)), label
        return _Placed(np.array(forms), *found, np.array(pictures), np.array(shadow))

    def _bodies(
        self, model: Robot, posture: Posture, anchor: Floats
    ) -> Iterator[tuple[int, tuple[float, ...]]]:
        """Yield forms with their positions from the anchor, roll, pitch and heading.

        They are the whole robot on wheels, or each link of a robot with legs.
        """
        (x, y, z), roll, pitch, heading, angles = posture
        x, y = x - float(anchor[0]), y - float(anchor[1])
        if not angles:
            form = self._forms.id(("robot", model.name), partial(_robot_parts, model))
            yield form, (x, y, z, roll, pitch, heading)
            return
        urdf = urdf_path(model)
        base = turned(roll, pitch, heading)
        for link, (turn, shift) in link_tree(urdf).places(angles).items():
            if parts := link_parts(urdf)[link]:
                form = self._forms.id(("robot", model.name, link), partial(tuple, parts))
                at = base @ shift + (x, y, z)
                yield form, (*at.tolist(), *angles_of(base @ turn))


def _vehicle_parts(shape: vehicles.Shape, length_m: float, width_m: float) -> Sequence[Part]:
    """Return the parts of a vehicle whose lamps shine at night, unlike those of parked ones."""
    shining = vehicles.LAMP, vehicles.REAR_LAMP
    return [
        part._replace(cover="lamp") if part.colour in shining else part
        for part in vehicles.vehicle_parts(shape, length_m, width_m)
    ]


def _robot_parts(model: Robot) -> Sequence[Part]:
    return robot_parts(urdf_path(model))


def _leaning(one: Driven) -> Floats:
    """Return (N, 3) height, roll and pitch of vehicles on their wheels."""
    return one.surface.road(one.vehicles.xy, one.vehicles.heading, one.vehicles.size)
