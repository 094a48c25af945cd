"""Builds a policy's observations from what its manifest requests; simulates odometry."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from cosim.core.errors import UsageError
from cosim.core.geometry import Pose, wrap_angle
from cosim.core.state import Frame
from cosim.episode.interfaces import Camera, Observation, Privileged, RangeSensor
from cosim.episode.loop import Moment, Step
from cosim.episode.manifest_checks import calibration_of
from cosim.episode.sensing import InertialSensor, Lidar, Tracker, sensing_range_m
from cosim.spec.camera import CameraPicture, CameraSpec
from cosim.spec.episode_id import episode_id_of, seed_for
from cosim.spec.goal import TakePicture, goals_for, in_robot_frame
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import LEG_NOISE, DriftNoise, GpsNoise, Odometry, OdometryKind
from cosim.spec.robot import COURIER, Legs, Robot, robot_called
from cosim.spec.scenario import Scenario


class Odometer(Protocol):
    """Odometry of an episode."""

    def moved(self, before: Pose, after: Pose) -> None:
        """Record the motion of one tick, from one pose to another."""

    def read(self, pose: Pose, time_s: float) -> Odometry | None:
        """Return the odometry of a robot whose true pose is `pose`."""


def odometer_for(
    kind: OdometryKind, start: Pose, draws: np.random.Generator, robot: Robot = COURIER
) -> Odometer:
    """Return the odometry of an episode that starts at a pose.

    draws: generator of its errors.
    """
    if kind == "wheel":
        return DeadReckoning(draws, LEG_NOISE if isinstance(robot.drive, Legs) else DriftNoise())
    return Gps(start, draws) if kind == "gps" else _ExactOdometer(start, reported=kind == "exact")


class _ExactOdometer:
    def __init__(self, start: Pose, reported: bool) -> None:
        self._start = start
        self._reported = reported

    def moved(self, before: Pose, after: Pose) -> None:
        """Nothing to count."""

    def read(self, pose: Pose, time_s: float) -> Odometry | None:
        place = in_robot_frame(self._start, pose)
        turned = wrap_angle(pose.heading_rad - self._start.heading_rad)
        return Odometry(place.x_m, place.y_m, turned) if self._reported else None


class DeadReckoning:
    """Odometry by wheels or legs: it counts turns or steps, so it misses resets of the robot."""

    def __init__(self, draws: np.random.Generator, noise: DriftNoise = DriftNoise()) -> None:  # noqa: B008
        self._draws = draws
        self._noise = noise
        errors = draws.standard_normal(3).tolist()
        self._scale = 1.0 + noise.scale * errors[0]
        self._turn_scale = 1.0 + noise.turn_scale * errors[1]
        self._drift_radpm = noise.drift_radpm * errors[2]
        self._x_m = self._y_m = self._heading_rad = 0.0

    def moved(self, before: Pose, after: Pose) -> None:
        place = in_robot_frame(before, after)
        along_m = place.x_m
        turned = wrap_angle(after.heading_rad - before.heading_rad)
        far_m = abs(along_m)
        (one, two) = self._draws.standard_normal(2).tolist()
        counted_m = self._scale * along_m + self._noise.along_m * math.sqrt(far_m) * one
        turn = (
            self._turn_scale * turned
            + self._drift_radpm * far_m
            + self._noise.heading_rad * math.sqrt(far_m) * two
        )
        middle = self._heading_rad + 0.5 * turn
        self._x_m += counted_m * math.cos(middle)
        self._y_m += counted_m * math.sin(middle)
        if self._noise.sideways:
            aside_m = self._scale * place.y_m
            self._x_m -= aside_m * math.sin(middle)
            self._y_m += aside_m * math.cos(middle)
        self._heading_rad = wrap_angle(self._heading_rad + turn)

    def read(self, pose: Pose, time_s: float) -> Odometry:
        return Odometry(self._x_m, self._y_m, self._heading_rad)


class Gps:
    """GPS fixes of the robot; they include resets."""

    def __init__(
        self, start: Pose, draws: np.random.Generator, noise: GpsNoise = GpsNoise()
    ) -> None:
        self._start = start
        self._draws = draws
        self._noise = noise
        self._bias_m = noise.bias_m * draws.standard_normal(2)
        self._time_s = 0.0

    def moved(self, before: Pose, after: Pose) -> None:
        """Nothing to count."""

    def read(self, pose: Pose, time_s: float) -> Odometry:
        decay = math.exp(-(time_s - self._time_s) / self._noise.bias_s)
        fresh = math.sqrt(1.0 - decay * decay) * self._noise.bias_m
        self._bias_m = decay * self._bias_m + fresh * self._draws.standard_normal(2)
        self._time_s = time_s
        place = in_robot_frame(self._start, pose)
        x_m, y_m = (self._bias_m + self._noise.noise_m * self._draws.standard_normal(2)).tolist()
        return Odometry(place.x_m + x_m, place.y_m + y_m, None)


class Observer:
    """Builds the observations of one episode.

    manifest: manifest with the goal protocol of the run.
    run_seed: seed of goals and odometry errors, each with its own generator.
    privileged_at: returns the simulator state at a moment.
    cameras: further cameras by name.
    take_picture: takes pictures for picture goals.
    rays: rays of lidar and tracked people; without them, a manifest with one raises UsageError.
    """

    def __init__(
        self,
        scenario: Scenario,
        manifest: Manifest,
        run_seed: int,
        privileged_at: Callable[[Moment], Privileged],
        cameras: Mapping[str, Camera],
        take_picture: TakePicture | None = None,
        rays: RangeSensor | None = None,
    ) -> None:
        def draws(purpose: str) -> np.random.Generator:
            return np.random.default_rng(seed_for(purpose, run_seed, scenario))

        spec = manifest.camera
        self._episode_id = episode_id_of(run_seed, scenario).episode
        self._robot = robot_called(scenario.robot)
        self._manifest = manifest
        self._privileged_at = privileged_at
        self._cameras = cameras
        self._goals = goals_for(
            manifest.goal, scenario, draws("goal"), manifest.picture_size, take_picture
        )
        self._odometer = odometer_for(
            manifest.odometry, scenario.start_pose, draws("odometry"), self._robot
        )
        self._calibration = None if spec is None else calibration_of(spec, self._robot)
        self._lidar: Lidar | None = None
        self._tracker: Tracker | None = None
        self._imu: InertialSensor | None = None
        if rays is None and sensing_range_m(manifest):
            raise UsageError(f"policy '{manifest.name}' has a lidar or tracked people: give rays")
        if rays is not None and manifest.scan is not None:
            self._lidar = Lidar(manifest.scan, rays, draws("lidar"))
        if rays is not None and manifest.people != "none":
            self._tracker = Tracker(self._robot, rays, draws("people"))
        if manifest.imu != "none":
            self._imu = InertialSensor(manifest.imu, draws("imu"))

    def moved(self, step: Step, is_reset: bool) -> None:
        """Record a tick.

        is_reset: whether the robot is reset to another pose after the tick.
        """
        self._odometer.moved(step.robot.pose, step.motion.robot.pose)
        if self._imu is not None:
            self._imu.moved(step.robot, step.motion.robot)
        if self._tracker is not None:
            self._tracker.moved(step.street)
        if is_reset:
            self._goals.on_reset()
            if self._tracker is not None:
                self._tracker.on_reset()
            if self._imu is not None:
                self._imu.on_reset()

    def observed(
        self, now: Moment, time_s: float, camera: Camera | None, was_reset: bool
    ) -> tuple[Observation, Frame | None]:
        """Return the observation of a moment, and its camera frame.

        camera: camera of the policy.
        was_reset: whether the robot was reset since the last observation.
        """
        robot = now.robot
        spec = self._manifest.camera
        # Before the robot's own picture: the camera's last frame must be that one.
        goal = self._goals.at(robot.pose, now.route_s_m)
        frame = None if camera is None else camera.render(robot, now.street)
        observation = Observation(
            tick=now.tick,
            time_s=time_s,
            rgb=None if frame is None else frame.rgb,
            v_mps=robot.v_mps,
            w_radps=robot.w_radps,
            robot=self._robot,
            privileged=self._privileged_at(now) if self._manifest.privileged else None,
            episode=self._episode_id,
            reset=was_reset,
            goal=goal,
            odometry=self._odometer.read(robot.pose, time_s),
            camera=self._calibration,
            depth=frame.depth if frame is not None and spec is not None and spec.depth else None,
            labels=frame.labels if frame is not None and spec is not None and spec.labels else None,
            pictures={
                name: self._picture(extra, self._manifest.cameras[name], now)
                for name, extra in self._cameras.items()
            },
            scan=None if self._lidar is None else self._lidar.read(robot, now.street),
            imu=None if self._imu is None else self._imu.read(robot, time_s),
            people=None if self._tracker is None else self._tracker.read(robot, now.street, time_s),
        )
        return observation, frame

    def _picture(self, camera: Camera, spec: CameraSpec, now: Moment) -> CameraPicture:
        """Return the picture of a further camera."""
        frame = camera.render(now.robot, now.street)
        labels, depth = frame.labels if spec.labels else None, frame.depth if spec.depth else None
        return CameraPicture(frame.rgb, labels, depth, calibration_of(spec, self._robot))
