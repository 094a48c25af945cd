"""Gymnasium environment of scenarios.

A step is a period of the policy, an episode an `Episode`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final

import gymnasium
import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import UsageError, unknown
from cosim.episode.interfaces import ViewCamera
from cosim.results.record import Record
from cosim.results.run_setup import RunSetup
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario
from scenarios.episodes.episode import Episode
from scenarios.tools.gym.reward import Period, Reward, Transition
from scenarios.tools.gym.spaces import (
    Actions,
    SeenParts,
    action_as_answer,
    action_space_of,
    seen_by,
    seen_space,
)
from scenarios.tools.viewing.look import eye_behind

_Info = dict[str, Any]
"""Info of a step."""

_RENDER_MODES: Final = ["rgb_array"]
_RENDERED: Final = CameraSpec(640, 360, 62.0)


class SidewalkEnv(gymnasium.Env[SeenParts, NDArray[Any]]):
    """Gymnasium environment that runs each scenario in new engines. See `cosim.make_env`.

    `reset(seed=)` fixes the following scenarios and everything that is drawn in them.
    `options={"scenario": "straight-001"}` chooses one.

    A step ends `terminated` at the goal, before a stopping hand, and by a failure if the scenario
    ends on failures. It ends `truncated` at the time limit. In other scenarios the robot is put
    back after a failure, and `info["put_back"]` is true.

    info: each step has `scenario`, `time_s`, `put_back` and `failures`, their number in this step.
    The last one also has `record`, as in a run but without wall times, `metrics` by name, and
    `is_success`.
    transition: input of the reward in the last step.

    Only one environment with people or vehicles can run in a process, because SUMO runs once in
    each.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        manifest: Manifest,
        actions: Actions,
        reward: Reward,
        options: EpisodeOptions,
        render_mode: str | None = None,
        suite_hash: str = "",
    ) -> None:
        if render_mode not in (None, *_RENDER_MODES):
            raise unknown("render_mode", str(render_mode), _RENDER_MODES)
        self.scenarios = tuple(scenarios)
        self.manifest = manifest
        self.render_mode = render_mode
        self.metadata = {"render_modes": _RENDER_MODES, "render_fps": manifest.rate_hz}
        robots = [robot_called(name) for name in sorted({scenario.robot for scenario in scenarios})]
        self._seen_space = self.observation_space = seen_space(manifest, robots)
        self._answers = self.action_space = action_space_of(actions, manifest, robots)
        self.transition: Transition | None = None
        self._reward = reward
        self._options = options
        self._suite_hash = suite_hash
        self._stack = ExitStack()
        self._episode: Episode | None = None
        self._period: Period | None = None
        self._eyes: ViewCamera | None = None

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[SeenParts, _Info]:
        super().reset(seed=seed)
        drawn, run_seed = self.np_random.integers((len(self.scenarios), 2**53)).tolist()
        scenario = self._named(options) or self.scenarios[drawn]
        self.close()
        setup = RunSetup.of(self._options, suite_hash=self._suite_hash)
        if self._options.seed is None:
            setup = msgspec.structs.replace(setup, seed=run_seed)
        episode = Episode(scenario, self.manifest, self._options, setup=setup)
        self._episode = self._stack.enter_context(episode)
        self._period = Period(scenario, episode.clock.tick_s)
        episode.watch(self._period.watch)
        self.transition = None
        return seen_by(episode.reset(), self._seen_space), self._info(episode, False)

    def step(self, action: NDArray[Any]) -> tuple[SeenParts, float, bool, bool, _Info]:
        episode, period = self._episode, self._period
        if episode is None or period is None:
            raise UsageError(
                "no episode is under way: call reset() first, and again after a crash or close()"
            )
        answer = action_as_answer(action, self._answers)
        try:
            observation = episode.advance(answer)
        except BaseException:
            self.close()
            raise
        self.transition = happened = period.transition()
        reward = float(self._reward(happened))
        info = self._info(episode, observation.reset)
        if episode.over:
            info |= _outcome(episode.result()[0])
        truncated = happened.ended == "timeout"
        return (
            seen_by(observation, self._seen_space),
            reward,
            episode.over and not truncated,
            truncated,
            info,
        )

    def render(self) -> NDArray[np.uint8]:
        """Draw the robot from behind, in its street: (360, 640, 3) uint8. Raises UsageError without
        a render mode."""
        if self.render_mode is None:
            raise UsageError(
                "render() was called, but the environment has no render_mode. Choose one "
                "when it is made: "
                'gymnasium.make("cosim/Reactive-v2", render_mode="rgb_array") or '
                'cosim.make_env("reactive", render_mode="rgb_array")'
            )
        if self._episode is None:
            raise UsageError("nothing to render: no episode is under way, call reset() first")
        if self._eyes is None:
            self._eyes = self._stack.enter_context(self._episode.eyes(_RENDERED))
        now = self._episode.moment
        size = _RENDERED.width, _RENDERED.height
        return self._eyes.picture(
            *eye_behind(now.robot), now.street, now.robot, size, _RENDERED.fov_deg
        ).rgb

    def close(self) -> None:
        """End the engines; a second call does nothing."""
        self._episode = self._period = self._eyes = None
        self._stack.close()

    def _named(self, options: Mapping[str, Any] | None) -> Scenario | None:
        """Return the scenario in the options of a reset."""
        for key in options or {}:
            if key != "scenario":
                raise unknown("option of reset", str(key), ["scenario"])
        if not options:
            return None
        by_id = {scenario.id: scenario for scenario in self.scenarios}
        if (name := str(options["scenario"])) not in by_id:
            raise unknown("scenario", name, by_id)
        return by_id[name]

    def _info(self, episode: Episode, put_back: bool) -> _Info:
        failures = 0 if self.transition is None else len(self.transition.failures)
        return {
            "scenario": episode.scenario.id,
            "time_s": episode.time_s,
            "put_back": put_back,
            "failures": failures,
        }


def _outcome(record: Record) -> _Info:
    """Return the final info of an episode."""
    metrics = {name: value for name, value in record.measures.items() if value is not None}
    published = msgspec.structs.replace(record, clock={})
    return {"record": published, "metrics": metrics, "is_success": metrics.get("success") == 1.0}
