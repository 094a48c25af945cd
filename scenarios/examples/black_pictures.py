"""A policy whose pictures are black, to see how far its answers depend on what it sees.

POLICY=onnx:nets/mine cosim run reactive --policy scenarios/examples/black_pictures.py:Blinded
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

import cosim
from cosim import Command, Manifest, Observation


class Blinded:
    """The policy that the environment variable POLICY names, with black pictures."""

    def __init__(self) -> None:
        self._policy = cosim.load_policy(os.environ["POLICY"])

    @property
    def manifest(self) -> Manifest:
        return replace(self._policy.manifest, name=f"{self._policy.manifest.name}-black")

    def reset(self, episode_id: str, seed: int) -> None:
        self._policy.reset(episode_id, seed)

    def act(self, observation: Observation) -> Command:
        """Answer to a black picture. Further cameras stay as they are."""
        rgb = observation.rgb
        return self._policy.act(
            replace(observation, rgb=None if rgb is None else np.zeros_like(rgb))
        )
