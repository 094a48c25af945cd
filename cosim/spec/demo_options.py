"""Options of recorded demonstrations, and of the disturbances of their expert."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

import msgspec

from cosim.core.clock import Clock
from cosim.core.errors import SpecError, UsageError
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import GOALS, GoalProtocol, goal_called
from cosim.spec.manifest import Manifest
from cosim.spec.run_config import DataFormat
from cosim.spec.sensors import ImuKind, PeopleKind, ScanSpec
from cosim.spec.weather import weather_called

RECORDING_CAMERA: Final = "collected"
"""Name of the recording camera when the expert has a camera of its own."""
_MAX_NOISE: Final = 0.9
"""Maximum share of the time with disturbed commands."""
_MAX_WAYPOINTS: Final = 100
"""Maximum number of waypoints in a row."""
_FASTEST_HZ: Final = 20.0
"""Maximum rate of pictures; a tick takes 0.05 s."""


class DemoOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of recorded demonstrations.

    camera: camera of the pictures.
    rate_hz: rate of the expert's queries and of the pictures.
    waypoints: number of future positions in a row.
    waypoint_s: time between them in seconds, whole ticks of 0.05 s.
    noise: share of the time in which another command than the expert's is driven, in bursts.
    learner: policy that drives in this time; "" for the expert's command, slowed and turned at
        random.
    explore: if above 0, the learner drives all the time, and its commands are the stored ones. In
        this share of the time, they are changed at random. Rows have rewards.
    format: form of the data set: LeRobot, a ROS 2 bag of each episode, or raw demonstrations.
    unsolved: also record episodes that the expert fails, up to the first reset of the robot, raw
        ones to their end.
    scan, imu, people: sensors that are recorded with the pictures, as in a manifest.
    labels: whether labels of the simulator are stored, for auxiliary heads.
    astray: share of the episodes that begin aside of the route, turned away from it.
    weathers: names from which the weather of each episode is drawn, in place of its own.

    Raises SpecError.
    """

    camera: CameraSpec = CameraSpec(width=160, height=90)
    rate_hz: float = 5.0
    waypoints: int = 8
    waypoint_s: float = 0.2
    noise: float = 0.0
    learner: str = ""
    explore: float = 0.0
    unsolved: bool = False
    format: DataFormat = "lerobot"
    scan: ScanSpec | None = None
    imu: ImuKind = "none"
    people: PeopleKind = "none"
    labels: bool = False
    astray: float = 0.0
    weathers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.rate_hz not in (
            rates := [n for n in range(1, int(_FASTEST_HZ) + 1) if not 1000 % n and _ticks(1 / n)]
        ):
            valid = ", ".join(map(str, rates))
            raise SpecError(
                f"a data set has {valid} pictures a second, not {self.rate_hz:g}: choose one "
                f"of these rates"
            )
        for name, share in (("noise", self.noise), ("explore", self.explore)):
            if not 0.0 <= share <= _MAX_NOISE:
                raise SpecError(
                    f"{name} must be in [0, {_MAX_NOISE:g}], a share of the time, not {share:g}"
                )
        if self.explore and not (self.learner and self.unsolved and not self.noise):
            raise SpecError(
                "explore changes the commands of a learner, also in episodes that it fails: give "
                "--learner and --unsolved, and no --noise"
            )
        if self.learner and not (self.noise or self.explore):
            raise SpecError(
                f"learner '{self.learner}' drives in the share of the time that is noise: "
                f"give --noise 0.6, or --explore 0.3 for drives of its own"
            )
        if not 0.0 <= self.astray <= 1.0:
            raise SpecError(f"astray must be in [0, 1], a share of the episodes, not {self.astray}")
        for name in self.weathers:
            weather_called(name)
        if not 1 <= self.waypoints <= _MAX_WAYPOINTS:
            raise SpecError(f"waypoints must be in [1, {_MAX_WAYPOINTS}], not {self.waypoints}")
        if not (
            math.isfinite(self.waypoint_s)
            and 0.0 < self.waypoint_s <= 10.0
            and _ticks(self.waypoint_s)
        ):
            raise SpecError(
                "from one waypoint to the next it must be a whole number of ticks of 0.05 s, up "
                f"to 10 s, not {self.waypoint_s:g} s"
            )
        if self.camera.size[0] % 2 or self.camera.size[1] % 2 or min(self.camera.size) < 16:
            wide, high = self.camera.size
            raise SpecError(
                f"a film's pictures have even sides of 16 pixels or more, not {wide} x {high}"
            )


def _ticks(time_s: float) -> int:
    """Return the number of ticks in a time; 0 if it is not a whole number."""
    ticks = Clock().ticks(time_s)
    return ticks if math.isclose(ticks * Clock().tick_s, time_s) else 0


def check_learner(
    learner: Manifest, collecting: DemoOptions, expert: Manifest, goal: GoalProtocol
) -> None:
    """Raise UsageError if a learner's inputs differ from the recorded ones.

    goal: goal protocol of the rows.
    """
    if expert.camera is not None:
        raise UsageError(
            f"expert '{expert.name}' sees by a camera of its own, and a learner drives "
            f"beside one that does not"
        )
    camera = learner.camera
    if camera is None or learner.privileged or learner.cameras or learner.odometry != "none":
        raise UsageError(
            f"learner '{learner.name}' is no policy that drives by one camera, speeds, a goal and "
            f"recorded sensors alone"
        )
    recorded = recording_manifest(expert, collecting, goal)
    for sensor, flag in (("scan", "--lidar"), ("imu", "--imu"), ("people", "--people")):
        wanted, given = getattr(learner, sensor), getattr(recorded, sensor)
        if wanted not in (None, "none", given):
            raise UsageError(
                f"learner '{learner.name}' is to sense what is collected: its {sensor} is "
                f"{wanted}, collected is {given}: see {flag}"
            )
    if (camera, learner.rate_hz) != (collecting.camera, collecting.rate_hz):
        seen = f"{camera.in_words}, {learner.rate_hz:g} Hz"
        kept = collecting.camera.in_words
        raise UsageError(
            f"learner '{learner.name}' is to see what is collected. It sees by {seen}, collected "
            f"is {kept}, {collecting.rate_hz:g} Hz: {_matching_options(camera, learner.rate_hz)}"
        )
    if learner.goals and goal not in learner.goals:
        could = ", ".join(learner.goals)
        raise UsageError(
            f"learner '{learner.name}' cannot do with goal '{goal}': give --goal, one of {could}"
        )


def _matching_options(camera: CameraSpec, rate_hz: float) -> str:
    """Return the options that record these pictures, as advice."""
    plain = CameraSpec(camera.width, camera.height, camera.fov_deg, camera.mount)
    if camera != plain or not isinstance(camera.mount, str):
        return (
            "such pictures cannot be collected; give a learner with a plain camera at one of the "
            "robot's mounts"
        )
    return (
        f"give --camera {camera.width}x{camera.height} --fov {camera.fov_deg:g} --mount "
        f"{camera.mount} --rate {rate_hz:g}"
    )


def _sensors(expert: Manifest, collecting: DemoOptions) -> dict[str, Any]:
    """Return the sensors of a recording: those of the expert and the recorded ones.

    Raises UsageError for an expert with another sensor of a recorded kind.
    """
    found = {}
    for sensor in ("scan", "imu", "people"):
        own, recorded = getattr(expert, sensor), getattr(collecting, sensor)
        if own in (None, "none"):
            found[sensor] = recorded
        elif recorded in (None, "none", own):
            found[sensor] = own
        else:
            raise UsageError(
                f"policy '{expert.name}' has a {sensor} of its own, {own}, and another one cannot "
                f"be collected: {recorded}"
            )
    return found


def recording_manifest(
    expert: Manifest, collecting: DemoOptions, goal: GoalProtocol | None = None
) -> Manifest:
    """Return the manifest of an expert for recording, with the recording camera and rate.

    A disturbed expert gets another name, and so does an exploring learner in its place. An expert
    with a camera must keep its rate, because it remembers pictures at that interval. Raises
    UsageError for goals that a data set cannot hold.

    goal: goal protocol of the run, in place of the expert's.
    """
    goal = goal or expert.goal
    if collecting.labels and not expert.privileged:
        raise UsageError(
            f"--labels: expert '{expert.name}' gets no privileged state, which labels are made of: "
            f"give --policy orca"
        )
    kind = GOALS[goal_called(goal)]
    if not kind.has_data_set_column:
        others = ", ".join(one.name for one in GOALS.values() if one.has_data_set_column)
        raise UsageError(
            f"goal protocol '{goal}' ({kind.summary}) cannot be stored in a data set: give "
            f"--goal, one of {others}"
        )
    if expert.camera is not None and collecting.rate_hz != expert.rate_hz:
        raise UsageError(
            f"policy '{expert.name}' sees, and answers {expert.rate_hz:g} times a second, not "
            f"{collecting.rate_hz:g}: give --rate {expert.rate_hz:g}"
        )
    name = f"{expert.name}-disturbed" if collecting.noise else expert.name
    name = "explorer" if collecting.explore else name
    settled = replace(
        expert, name=name, rate_hz=collecting.rate_hz, goal=goal, **_sensors(expert, collecting)
    )
    if expert.camera is None:
        return replace(settled, camera=collecting.camera)
    return replace(settled, cameras={**expert.cameras, RECORDING_CAMERA: collecting.camera})
