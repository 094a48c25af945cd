"""Visible objects as bodies without collision in a separate PyBullet client."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import EngineError
from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from physics.dynamics.bullet import p
from physics.ground.mesh import Mesh, pybullet_lists
from physics.textures.layers import Colour

_AWAY: Final = (0.0, 0.0, -200.0)
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_LIGHT: Final = {
    "lightDirection": (0.35, -0.5, 0.8),
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.50,
    "lightSpecularCoeff": 0.0,
    "shadow": 0,
}


class BulletCanvas:
    """Coloured, labelled bodies and a PyBullet renderer.

    The renderer is TinyRenderer, or the EGL plugin, which needs OpenGL.
    Physics runs in another client, so these bodies do not slow it down.
    Raises EngineError when the plugin does not start.
    """

    def __init__(self, egl: bool = False) -> None:
        self._client: int = p.connect(p.DIRECT)
        if self._client < 0:
            raise EngineError("PyBullet did not start")
        self._labels = np.zeros(256, dtype=np.uint8)
        self._renderer: int = p.ER_TINY_RENDERER
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if egl:
            self._folder = tempfile.TemporaryDirectory(prefix="cosim-shapes-")
            self._load_egl()
            self._renderer = p.ER_BULLET_HARDWARE_OPENGL

    def close(self) -> None:
        p.disconnect(self._client)
        if self._folder is not None:
            self._folder.cleanup()

    def shape(self, mesh: Mesh) -> int:
        """Create a shape that bodies can share."""
        if self._folder is not None:
            return self._shape_of_file(mesh, Path(self._folder.name))
        with pybullet_lists(mesh.triangles, mesh.vertices, mesh.normals) as (
            indices,
            (vertices, normals),
        ):
            shape: int = p.createVisualShape(
                p.GEOM_MESH,
                vertices=vertices,
                indices=indices,
                normals=normals,
                physicsClientId=self._client,
            )
        return shape

    def add(self, form: Mesh | int, colour: Colour, label: str) -> int:
        """Add a body with a mesh or a shared shape."""
        shape = self.shape(form) if isinstance(form, Mesh) else form
        body: int = p.createMultiBody(
            baseMass=0.0,
            baseVisualShapeIndex=shape,
            basePosition=_AWAY,
            useMaximalCoordinates=True,
            physicsClientId=self._client,
        )
        self.paint(body, colour)
        self._label(body, label)
        return body

    def load(self, urdf: Path, label: str) -> int:
        """Load a robot in its colours."""
        body: int = p.loadURDF(str(urdf), basePosition=_AWAY, physicsClientId=self._client)
        self._label(body, label)
        return body

    def remove(self, bodies: Sequence[int]) -> None:
        for body in bodies:
            p.removeBody(body, self._client)

    def paint(self, body: int, colour: Colour) -> None:
        p.changeVisualShape(body, -1, rgbaColor=(*colour, 1.0), physicsClientId=self._client)

    def put(
        self, body: int, at_m: Sequence[float], heading_rad: float = 0.0, about_y_rad: float = 0.0
    ) -> None:
        """Rotate a body about its y axis, then about the vertical, and move it to (3,) metres."""
        cy, sy = math.cos(0.5 * about_y_rad), math.sin(0.5 * about_y_rad)
        cz, sz = math.cos(0.5 * heading_rad), math.sin(0.5 * heading_rad)
        p.resetBasePositionAndOrientation(
            body, at_m, (-sz * sy, cz * sy, sz * cy, cz * cy), self._client
        )

    def put_turned(self, body: int, at_m: Sequence[float], roll_pitch_yaw: Sequence[float]) -> None:
        p.resetBasePositionAndOrientation(
            body, at_m, p.getQuaternionFromEuler(roll_pitch_yaw), self._client
        )

    def put_jointed(
        self,
        body: int,
        at_m: Sequence[float],
        roll_pitch_yaw: Sequence[float],
        angles_rad: Mapping[str, float],
    ) -> None:
        """Move a loaded robot's base link frame to (3,) metres, and set joints by name."""
        for joint in range(p.getNumJoints(body, self._client)):
            name = p.getJointInfo(body, joint, self._client)[1].decode()
            if name in angles_rad:
                p.resetJointState(body, joint, angles_rad[name], physicsClientId=self._client)
        turn = p.getQuaternionFromEuler(roll_pitch_yaw)
        middle, own = p.getDynamicsInfo(body, -1, self._client)[3:5]
        at, turn = p.multiplyTransforms(at_m, turn, middle, own)
        p.resetBasePositionAndOrientation(body, at, turn, self._client)

    def put_at(self, body: int, at_m: Sequence[float], turn: Sequence[float]) -> None:
        """Move a body to (3,) metres and rotate it by a quaternion x, y, z, w."""
        p.resetBasePositionAndOrientation(body, at_m, turn, self._client)

    def put_away(self, body: int) -> None:
        p.resetBasePositionAndOrientation(body, _AWAY, _UPRIGHT, self._client)

    def draw(
        self,
        eye_m: Floats,
        target_m: Floats,
        size: tuple[int, int],
        fov_deg: float,
        near_m: float,
        far_m: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
        """Render colours (H, W, 3), labels (H, W) and depth along the view (H, W) in metres.

        size: width, height in pixels
        """
        width, height = size
        view = p.computeViewMatrix(eye_m.tolist(), target_m.tolist(), (0.0, 0.0, 1.0))
        projection = list(p.computeProjectionMatrixFOV(fov_deg, width / height, near_m, far_m))
        if self._renderer == p.ER_TINY_RENDERER:
            # TinyRenderer samples a corner of each pixel; shift by half a pixel to its centre.
            projection[8] += 1.0 / width
            projection[9] += 1.0 / height
        _, _, rgba, depth, mask = p.getCameraImage(
            width,
            height,
            view,
            projection,
            renderer=self._renderer,
            physicsClientId=self._client,
            **_LIGHT,
        )
        mask = np.asarray(mask, dtype=np.int32).reshape(height, width)
        labels = self._labels[mask]
        labels[mask < 0] = LABELS["sky"]
        depth = np.asarray(depth, dtype=np.float32).reshape(height, width)
        metres = (far_m * near_m / (far_m - (far_m - near_m) * depth)).astype(np.float32)
        rgb = np.ascontiguousarray(
            np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3]
        )
        return rgb, labels, metres

    def _shape_of_file(self, mesh: Mesh, folder: Path) -> int:
        """Load a mesh from a file, because the EGL plugin draws only meshes from files."""
        from trimesh import Trimesh  # slow import, needed by this renderer only

        path = folder / f"{len(list(folder.iterdir()))}.obj"
        drawn = Trimesh(mesh.vertices, mesh.triangles, vertex_normals=mesh.normals, process=False)
        drawn.export(path, include_normals=True)
        shape: int = p.createVisualShape(
            p.GEOM_MESH, fileName=str(path), physicsClientId=self._client
        )
        return shape

    def _load_egl(self) -> None:
        plugin = find_spec("eglRenderer")
        if plugin is None or plugin.origin is None:
            raise EngineError("this PyBullet has no EGL plugin: use --camera gl or bullet")
        if p.loadPlugin(plugin.origin, "_eglRendererPlugin", self._client) < 0:
            raise EngineError(
                "PyBullet's EGL plugin did not start: is OpenGL here (cosim doctor)? Or use "
                "--camera bullet"
            )

    def _label(self, body: int, label: str) -> None:
        if body >= len(self._labels):
            self._labels = np.concatenate([self._labels, np.zeros(body + 256, dtype=np.uint8)])
        self._labels[body] = LABELS[label]


class Rigs:
    """Pool of interchangeable sets of bodies, assigned per picture. Unused sets are hidden."""

    def __init__(self, canvas: BulletCanvas, meshes: Sequence[Mesh], label: str) -> None:
        self._canvas = canvas
        self._shapes = [canvas.shape(mesh) for mesh in meshes]
        self._label = label
        self._rigs: list[list[int]] = []
        self._lent = 0
        self._in_sight = 0

    def start(self) -> None:
        """Start a new picture: all sets become available."""
        self._lent = 0

    def lend(self) -> list[int]:
        """Return an available set: one body per mesh, in their order."""
        if self._lent == len(self._rigs):
            grey = (0.5, 0.5, 0.5)
            self._rigs.append(
                [self._canvas.add(shape, grey, self._label) for shape in self._shapes]
            )
        self._lent += 1
        return self._rigs[self._lent - 1]

    def finish(self) -> None:
        """Hide the sets of the last picture that this picture does not use."""
        for rig in self._rigs[self._lent : self._in_sight]:
            for body in rig:
                self._canvas.put_away(body)
        self._in_sight = self._lent
