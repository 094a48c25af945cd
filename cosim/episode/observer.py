"""What a policy is given at a moment: what its manifest asks for, and nothing more."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cosim.core.state import Frame
from cosim.episode.interfaces import Camera, Observation, Privileged
from cosim.episode.loop import Moment
from cosim.episode.manifest_checks import calibration_of
from cosim.episode.odometer import odometer_for
from cosim.episode.step import Step
from cosim.spec.camera import CameraPicture, CameraSpec
from cosim.spec.episode_id import pseudonym_of, seed_for
from cosim.spec.goal import TakePicture, goals_for
from cosim.spec.manifest import Manifest
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario


class Observer:
    """Makes the observations of one episode.

    manifest: with the goals of the run. run_seed: what goals and errors of odometry are drawn from,
    each from a generator of its own. known: all that the simulator knows at a moment. cameras: the
    further ones; look: for goals that are pictures.
    """

    def __init__(
        self,
        scenario: Scenario,
        manifest: Manifest,
        run_seed: int,
        known: Callable[[Moment], Privileged],
        cameras: Mapping[str, Camera],
        look: TakePicture | None = None,
    ) -> None:
        def draws(purpose: str) -> np.random.Generator:
            return np.random.default_rng(seed_for(purpose, run_seed, scenario))

        spec = manifest.camera
        self._called = pseudonym_of(run_seed, scenario).episode
        self._robot = robot_called(scenario.robot)
        self._manifest = manifest
        self._known = known
        self._cameras = cameras
        self._goals = goals_for(manifest.goal, scenario, draws("goal"), manifest.picture_size, look)
        self._odometer = odometer_for(manifest.odometry, scenario.start_pose, draws("odometry"))
        self._calibration = None if spec is None else calibration_of(spec, self._robot)

    def moved(self, step: Step, put_back: bool) -> None:
        """A tick has passed. put_back: the robot is put elsewhere now."""
        self._odometer.moved(step.robot.pose, step.motion.robot.pose)
        if put_back:
            self._goals.put_back()

    def observed(
        self, now: Moment, time_s: float, camera: Camera | None, put_back: bool
    ) -> tuple[Observation, Frame | None]:
        """What the policy is given now, and its picture. camera: the policy's. put_back: since the
        last observation the robot was put elsewhere."""
        robot = now.robot
        spec = self._manifest.camera
        goal = self._goals.at(
            robot.pose, now.route_s_m
        )  # a goal's picture is drawn first: the last one is the robot's
        frame = None if camera is None else camera.render(robot, now.street)
        seen = Observation(
            tick=now.tick,
            time_s=time_s,
            rgb=None if frame is None else frame.rgb,
            v_mps=robot.v_mps,
            w_radps=robot.w_radps,
            robot=self._robot,
            privileged=self._known(now) if self._manifest.privileged else None,
            episode=self._called,
            reset=put_back,
            goal=goal,
            odometry=self._odometer.read(robot.pose, time_s),
            camera=self._calibration,
            depth=frame.depth if frame is not None and spec is not None and spec.depth else None,
            labels=frame.labels if frame is not None and spec is not None and spec.labels else None,
            pictures={
                name: self._picture(further, self._manifest.cameras[name], now)
                for name, further in self._cameras.items()
            },
        )
        return seen, frame

    def _picture(self, camera: Camera, spec: CameraSpec, now: Moment) -> CameraPicture:
        """What a further camera shows."""
        frame = camera.render(now.robot, now.street)
        labels, depth = frame.labels if spec.labels else None, frame.depth if spec.depth else None
        return CameraPicture(frame.rgb, labels, depth, calibration_of(spec, self._robot))
