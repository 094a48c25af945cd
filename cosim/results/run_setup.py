"""RunSetup: the facts that all episodes of a run share, beside the policy's manifest."""

from __future__ import annotations

import msgspec

from cosim.core.versions import versions
from cosim.spec.options import EpisodeOptions, PolicyRuns

METRIC_SCHEMA = 3
"""Raised whenever a definition of `cosim.results.metrics` comes or changes; other schemas are not
compared with it."""
NO_RENDERER = "none"
"""The renderer of an episode whose policy has no camera."""


class RunSetup(msgspec.Struct, frozen=True, kw_only=True):
    """How a run is set up: embedded in its `RunSpec` and in the `Record` of each of its episodes.

    A field that is added here is a key of record.json and run.json and a column of results.csv.
    Runs in which it differs are not the same. It needs a default, which is that of older runs.

    suite_hash: of the suite that the scenarios are of. seed: of the run, from which the names and
    seeds of episodes are drawn that a policy gets. policy_source: hash of the file that the policy
    is written in (`cosim.policies.load.source_hash`). policy_runs: where the policy runs.
    latency_ms: of commands, as requested; in a record of real time the median of the measured ones.
    real_time: whether the latency of each answer is measured; such an episode is replayed, not made
    again. renderer: what draws the pictures for the policy. metric_schema: METRIC_SCHEMA of the
    version that computes the measures, 0 where that is not known.
    """

    suite_hash: str
    seed: int = 0
    policy_source: str = ""
    policy_runs: PolicyRuns = "in-process"
    latency_ms: float = 0.0
    real_time: bool = False
    renderer: str = NO_RENDERER
    versions: dict[str, str]
    metric_schema: int = 0

    @classmethod
    def of(
        cls,
        options: EpisodeOptions,
        *,
        suite_hash: str = "",
        policy_source: str = "",
        policy_runs: PolicyRuns = "in-process",
    ) -> RunSetup:
        """The set-up that options request, with the versions that are installed here."""
        return cls(
            suite_hash=suite_hash,
            seed=options.seed or 0,
            policy_source=policy_source,
            policy_runs=policy_runs,
            latency_ms=options.latency_ms,
            real_time=options.real_time,
            versions=versions(),
            metric_schema=METRIC_SCHEMA,
        )
