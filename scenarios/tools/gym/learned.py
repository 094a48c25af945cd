"""Run a policy that was learned in an environment in the benchmark."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.manifest import Manifest
from cosim.spec.robot import COURIER, Robot
from scenarios.tools.gym.make_env import LEARNER
from scenarios.tools.gym.spaces import (
    Actions,
    SeenParts,
    action_as_answer,
    action_space_of,
    seen_by,
    seen_space,
)


class LearnedPolicy:
    """Policy that calls `predict` for each action.

    Observations are those of the environment with the same manifest, actions and robot.

    >>> ahead = LearnedPolicy(lambda seen: np.float32([1.0, 0.0]), Manifest("ahead", camera=None))
    >>> ahead.manifest.name
    'ahead'
    """

    def __init__(
        self,
        predict: Callable[[SeenParts], NDArray[np.floating[Any]]],
        manifest: Manifest = LEARNER,
        actions: Actions = "command",
        robot: Robot = COURIER,
    ) -> None:
        self.manifest = manifest
        self._predict = predict
        self._seen_space = seen_space(manifest, [robot])
        self._answers = action_space_of(actions, manifest, [robot])

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: answers depend only on the present observation."""

    def act(self, observation: Observation) -> Command | NDArray[np.floating[Any]]:
        return action_as_answer(
            self._predict(seen_by(observation, self._seen_space)), self._answers
        )
