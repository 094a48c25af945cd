"""Which cameras a policy may see by: those of the robot's mounts, within their limits; any other
one is marked."""

from __future__ import annotations

from cosim.core.errors import UsageError
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Mount, Robot


def nonstandard(manifest: Manifest, robot: Robot) -> str:
    """What of a policy's cameras no mount of the robot allows, in words; "" if nothing. Raises
    UsageError, listing the robot's mounts, if it has none of that name."""
    cameras = [*([] if manifest.camera is None else [manifest.camera]), *manifest.cameras.values()]
    return " and ".join(
        filter(None, [_beyond(camera, manifest.rate_hz, robot) for camera in cameras])
    )


def check_camera(manifest: Manifest, robot: Robot, own_camera: bool) -> None:
    """Raises UsageError, with the robot's mounts and their limits, for a camera that is none of the
    robot's, unless that was asked for."""
    odd = nonstandard(manifest, robot)
    if odd and not own_camera:
        mounts = "; ".join(f"'{name}' {mount.in_words}" for name, mount in robot.mounts.items())
        raise UsageError(
            f"policy '{manifest.name}' sees by {odd}, which robot '{robot.name}' does not have. It "
            f"has: {mounts}. Choose one of these, or give --own-camera "
            "(EpisodeOptions.own_camera), which marks every row as nonstandard"
        )


def _beyond(camera: CameraSpec, rate_hz: float, robot: Robot) -> str:
    """The same of one camera."""
    mount = camera.on(robot)
    if isinstance(camera.mount, Mount):
        at = ", ".join(f"{m:g}" for m in mount.at_m)
        return (
            f"a camera of its own at ({at}) m, {mount.pitch_down_deg:g} deg down, "
            f"{mount.yaw_left_deg:g} to the left"
        )
    beyond = []
    if camera.width > mount.most_px[0] or camera.height > mount.most_px[1]:
        beyond.append(f"{camera.width} x {camera.height} px")
    if not mount.fov_deg[0] <= camera.fov_deg <= mount.fov_deg[1]:
        beyond.append(f"{camera.fov_deg:g} deg")
    if rate_hz > mount.most_hz:
        beyond.append(f"{rate_hz:g} Hz")
    return f"a camera of {', '.join(beyond)} at '{camera.mount}'" if beyond else ""
