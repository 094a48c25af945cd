"""A policy whose pictures are black, to see how far its answers depend on what it sees.

POLICY=onnx:nets/mine cosim run reactive --policy scenarios/examples/black_pictures.py:Blinded
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

import cosim
from cosim import Command, Manifest, Observation
from cosim.core.errors import UsageError


class Blinded:
    """The policy that the environment variable POLICY names, with black pictures.

    Its name ends with the start of the policy's hash, because runs of two policies must differ.
    """

    def __init__(self) -> None:
        if not (name := os.environ.get("POLICY")):
            raise UsageError("set POLICY, the policy that drives: POLICY=onnx:FOLDER cosim run ...")
        self._policy = cosim.load_policy(name)

    @property
    def manifest(self) -> Manifest:
        seen = self._policy.manifest
        return replace(seen, name=f"{seen.name}-black-{self._policy.source_hash[:8]}")

    def reset(self, episode_id: str, seed: int) -> None:
        self._policy.reset(episode_id, seed)

    def act(self, observation: Observation) -> Command:
        """Answer to a black picture. Further cameras stay as they are."""
        rgb = observation.rgb
        return self._policy.act(
            replace(observation, rgb=None if rgb is None else np.zeros_like(rgb))
        )
