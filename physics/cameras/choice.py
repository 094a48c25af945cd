"""Cameras by name: `gl` with OpenGL, `bullet` anywhere, `bullet-egl` on request.

`auto` selects `gl` where it works, otherwise `bullet`.
OpenGL and PyBullet are imported only when a camera needs them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.place.scan import Scan
from cosim.results.run_setup import MESH_LOOK, appearance_of
from cosim.spec.camera import CameraSpec
from cosim.spec.options import CameraName
from cosim.spec.run_config import Appearance, CameraChoice
from cosim.spec.scenario import Light
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from physics.cameras.gl import context

if TYPE_CHECKING:
    from physics.cameras.bullet_camera import BulletCamera
    from physics.cameras.gl.camera import GlCamera
    from physics.dynamics.world import BulletWorld


def camera_of_choice(choice: CameraChoice) -> CameraName:
    """Resolve a choice to the camera available here.

    Raises EngineError when it is `gl` and OpenGL is missing.
    """
    if choice == "auto":
        return "gl" if context.available() else "bullet"
    if choice == "gl":
        context.context()
    return choice


def renderer_of(name: CameraName, appearance: Appearance = "splats") -> str:
    """Return the renderer's name for records.

    appearance: of scanned places, which only the gl camera draws in several ways

    Pictures have the same bits on the same renderer only.
    """
    if name == "gl":
        return context.renderer() + (MESH_LOOK if appearance == "mesh" else "")
    return {"bullet": "bullet-tiny", "bullet-egl": "bullet-egl"}[name]


def drawn_appearance(renderer: str, scan: Scan) -> Appearance:
    """Return the appearance with which a renderer, by its name, draws a scan."""
    if scan.splats is None or renderer.startswith("bullet"):
        return "mesh"
    return appearance_of(renderer)


def camera_of(
    name: CameraName,
    world: BulletWorld,
    spec: CameraSpec,
    *,
    light: Light | None = None,
    weather: Weather = WEATHERS[CLEAR],
    depth: bool = False,
    appearance: Appearance = "splats",
) -> GlCamera | BulletCamera:
    """Create a camera in a world, for use in a `with` block.

    light, weather: for the gl camera; the other's pictures are always of a clear day
    appearance: of a scanned place in the gl camera; the other draws its mesh
    """
    if name == "gl":
        from physics.cameras.gl.camera import GlCamera

        return GlCamera(world, spec, depth, light or Light(), appearance, weather)
    from physics.cameras.bullet_camera import BulletCamera

    return BulletCamera(world, spec, depth, egl=name == "bullet-egl")
