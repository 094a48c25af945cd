"""Settings that all episodes of a run share, in addition to the policy's manifest."""

from __future__ import annotations

from pathlib import Path

import msgspec

from cosim.core.versions import versions
from cosim.spec.options import EpisodeOptions, PolicyProcess, absolute_gait
from cosim.spec.run_config import Appearance

METRIC_SCHEMA = 6
"""Version of the metric definitions; results of other schemas are not compared."""
NO_RENDERER = "none"
"""Renderer name of an episode whose policy has no camera."""
MESH_LOOK = ", mesh"
"""End of a renderer's name with the mesh's look of scanned places."""


def appearance_of(renderer: str) -> Appearance:
    """Return the appearance of scanned places in pictures, by the renderer's name in a record."""
    return "mesh" if renderer.endswith(MESH_LOOK) else "splats"


def gait_in_words(gait: str, gait_hash: str) -> str:
    """Return the file name and the short hash of a gait in place of the robot's own.

    >>> gait_in_words("onnx:/gaits/walk.onnx", "0123456789abcdef")
    'gait walk.onnx (01234567)'
    """
    return f"gait {Path(gait).name} ({gait_hash[:8]})"


class RunSetup(msgspec.Struct, frozen=True, kw_only=True):
    """Set-up of a run, embedded in its `RunSpec` and in each `Record`.

    A new field is a key of record.json and run.json and a column of results.csv. Runs that differ
    in it are different runs. It needs the default of older runs.

    suite_hash: hash of the suite
    seed: seed of the run; episode ids and seeds for the policy are drawn from it
    policy_source: hash of the policy's source file (`cosim.policies.load.source_hash`)
    policy_runs: where the policy runs
    latency_ms: requested latency of commands; in a real-time record the median of the measured ones
    real_time: whether the latency of each answer is measured; such an episode can only be replayed
    renderer: renderer of the policy's pictures
    gait, gait_hash: gait in place of the robot's own, and the hash of its files; "" without one
    metric_schema: METRIC_SCHEMA of the version that computes the measures, 0 if unknown
    """

    suite_hash: str
    seed: int = 0
    policy_source: str = ""
    policy_runs: PolicyProcess = "in-process"
    latency_ms: float = 0.0
    real_time: bool = False
    renderer: str = NO_RENDERER
    gait: str = ""
    gait_hash: str = ""
    versions: dict[str, str]
    metric_schema: int = 0

    @classmethod
    def of(
        cls,
        options: EpisodeOptions,
        *,
        suite_hash: str = "",
        policy_source: str = "",
        policy_runs: PolicyProcess = "in-process",
        gait_hash: str = "",
    ) -> RunSetup:
        """Build the set-up that options request, with the installed versions."""
        return cls(
            suite_hash=suite_hash,
            seed=options.seed or 0,
            policy_source=policy_source,
            policy_runs=policy_runs,
            latency_ms=options.latency_ms,
            real_time=options.real_time,
            gait=absolute_gait(options.gait),
            gait_hash=gait_hash,
            versions=versions(),
            metric_schema=METRIC_SCHEMA,
        )
