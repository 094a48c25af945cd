"""Readings of a recorded policy's sensors, computed again while its episode is replayed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NoReturn

from cosim.core.clock import Clock
from cosim.episode.interfaces import Observation, RangeSensor
from cosim.episode.loop import Moment, Step
from cosim.episode.observer import Observer
from cosim.episode.sensing import sensing_range_m
from cosim.results.referee import Verdict
from cosim.spec.robot import robot_called
from physics.sensors.caster import RayCaster
from scenarios.episodes.replay import RecordedEpisode
from scenarios.places.nets import surface_of_place


class SensorReplay:
    """Lidar, inertial sensor and tracked people of a recorded policy.

    They are read at the ticks at which the policy observed, with the errors that it got.
    """

    def __init__(self, recorded: RecordedEpisode, rays: RangeSensor | None) -> None:
        manifest = replace(
            recorded.record.manifest,
            camera=None,
            cameras={},
            goal="none",
            odometry="none",
            privileged=False,
        )
        self._observed_ticks = {*recorded.log.answers[:, 0].astype(int).tolist()}
        self._observer = Observer(
            recorded.scenario, manifest, recorded.record.setup.seed, _unknown, {}, rays=rays
        )

    def read(self, step: Step, verdict: Verdict) -> Observation | None:
        """Return the observation at the start of a step, for every step in order.

        None where the policy did not observe.
        """
        seen: Observation | None = None
        if step.tick in self._observed_ticks:
            now = Moment(step.tick, step.robot, step.street, step.route_s_m)
            seen, _ = self._observer.observed(now, Clock().time_s(step.tick), None, False)
        self._observer.moved(step, verdict.reset is not None)
        return seen


@contextmanager
def sensor_replay(recorded: RecordedEpisode) -> Iterator[SensorReplay | None]:
    """Provide the sensors of a recorded policy; None if it has none of them."""
    manifest, scenario = recorded.record.manifest, recorded.scenario
    range_m = sensing_range_m(manifest)
    if not range_m:
        yield None if manifest.imu == "none" else SensorReplay(recorded, None)
        return
    robot = robot_called(scenario.robot)
    surface = surface_of_place(scenario.place)
    with RayCaster(surface, scenario.barriers, scenario.obstacles, robot, range_m) as rays:
        yield SensorReplay(recorded, rays)


def _unknown(now: Moment) -> NoReturn:
    raise AssertionError("a replayed sensor needs no simulator state")
