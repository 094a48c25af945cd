"""A coordinator, two workers and a viewer on hosts of their own, TLS between them, and a link that
goes down."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.across import faults_of_run, prepare, run_across, viewer_output
from tests.support.namespaces import NotPermitted, network

pytestmark = pytest.mark.engine


def test_a_run_across_hosts_loses_nothing_when_a_link_goes_down(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Every episode has one result though a worker's link is down for 6 s; a viewer on another host
    cannot finish any job."""
    if not request.config.getoption("--whole"):
        pytest.skip("with --whole, or as a command: python -m tests.support.across")
    seen: list[str] = []
    try:
        with network("hub", "one", "two", "viewer") as net:
            prepare(tmp_path, net, 4, 1.0)
            code = run_across(
                tmp_path,
                net,
                ["link of worker one down"],
                1,
                lambda _: seen.append(viewer_output(tmp_path, net)),
            )
    except NotPermitted as error:
        pytest.skip(str(error))
    assert faults_of_run(tmp_path, 4) == [] and code == 0
    assert seen == ["status 0 answers about its jobs\n"]
