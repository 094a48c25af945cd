"""The cameras by name: `gl` where OpenGL can be had, `bullet` anywhere, `bullet-egl` on request;
`auto` takes `gl` if it works, else `bullet`.

OpenGL and PyBullet are imported when a camera of theirs is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.spec.camera import CameraSpec
from cosim.spec.options import CameraName
from cosim.spec.run_config import CameraChoice
from cosim.spec.scenario import Light
from physics.cameras.gl import context

if TYPE_CHECKING:
    from physics.cameras.bullet_camera import BulletCamera
    from physics.cameras.gl.camera import GlCamera
    from physics.dynamics.world import BulletWorld


def camera_of_choice(choice: CameraChoice) -> CameraName:
    """The camera that a choice comes to here. Raises EngineError when it is `gl` and there is no
    OpenGL."""
    if choice == "auto":
        return "gl" if context.available() else "bullet"
    if choice == "gl":
        context.context()
    return choice


def renderer_of(name: CameraName) -> str:
    """What draws the pictures, as records name it: pictures are the same bits on the same renderer
    only."""
    return (
        context.renderer()
        if name == "gl"
        else {"bullet": "bullet-tiny", "bullet-egl": "bullet-egl"}[name]
    )


def camera_of(
    name: CameraName,
    world: BulletWorld,
    spec: CameraSpec,
    *,
    light: Light | None = None,
    depth: bool = False,
) -> GlCamera | BulletCamera:
    """A camera in a world, to be used in a `with` block. light: for the gl camera; the other's
    light is always day."""
    if name == "gl":
        from physics.cameras.gl.camera import GlCamera

        return GlCamera(world, spec, depth, light or Light())
    from physics.cameras.bullet_camera import BulletCamera

    return BulletCamera(world, spec, depth, egl=name == "bullet-egl")
