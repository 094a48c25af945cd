"""RunSpecs of made-up runs, and records and specs with changed values, by the keys of their
files."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import msgspec

from cosim.results.record import RECORD_FILE, Record
from cosim.results.run_setup import METRIC_SCHEMA, RunSetup
from cosim.results.run_spec import RUN_FILE, RunSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import Scenario, Suite

_T = TypeVar("_T", Record, RunSpec)


def spec_of(suite: Suite, policy: str = "p", **of_setup: Any) -> RunSpec:
    """Return a run of all scenarios of a suite by a blind policy. of_setup: fields of its
    set-up."""
    given: dict[str, Any] = {
        "suite_hash": suite.content_hash,
        "versions": {"numpy": "2"},
        "metric_schema": METRIC_SCHEMA,
    }
    return RunSpec(
        suite=suite.name,
        robots={"courier": "h"},
        suite_version=suite.version,
        policy=policy,
        manifest=Manifest(policy, camera=None),
        setup=RunSetup(**given | of_setup),
        scenarios=tuple(one.id for one in suite.scenarios),
    )


def record_of(scenario: Scenario, manifest: Manifest, **of_setup: Any) -> Record:
    """Return the record of an episode that has begun. of_setup: fields of its set-up."""
    setup = RunSetup.of(EpisodeOptions(), suite_hash="h")
    return Record.begun(scenario, manifest, msgspec.structs.replace(setup, **of_setup))


def changed(value_object: _T, **keys: Any) -> _T:
    """Return a record or spec with other values at keys of its file."""
    file = RECORD_FILE if isinstance(value_object, Record) else RUN_FILE
    for name, value in keys.items():
        part, _, field = file.keys[name].rpartition(".")
        if part:
            inner = getattr(value_object, part)
            replace = (
                dataclasses.replace if isinstance(inner, Manifest) else msgspec.structs.replace
            )
            value_object = msgspec.structs.replace(
                value_object, **{part: replace(inner, **{field: value})}
            )
        else:
            value_object = msgspec.structs.replace(value_object, **{field: value})
    return value_object
