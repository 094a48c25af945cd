"""`cosim policy check`: correct policies pass, and each planted fault fails its check."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from cosim.episode.interfaces import Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.onnx.policy import OnnxPolicy
from cosim.policies.privileged.route import Route
from physics.cameras.choice import camera_of_choice
from scenarios.tools.policy_check.answer_checks import example
from scenarios.tools.policy_check.checks import POLICY_CHECKS, CheckedPolicy, checked_policy
from scenarios.tools.policy_check.drives import SceneName, ShownDrive, shown_drives
from scenarios.tools.policy_check.query import PolicyQuery
from tests.conftest import Cosim
from tests.support import faulty_policies
from tests.support.graphs import bundle, tiny_graph

Drives = Mapping[SceneName, ShownDrive]


@pytest.fixture(scope="module")
def drives() -> Drives:
    return shown_drives(faulty_policies.Right.manifest, 6, camera_of_choice("auto"))


def outcomes_of(policy: Policy, drives: Drives) -> CheckedPolicy:
    driver = PolicyCaller(policy)
    return checked_policy(driver, driver.manifest, drives)


@pytest.mark.engine
def test_a_correct_policy_passes_every_check(drives: Drives) -> None:
    """A policy with camera, goals and a memory of pictures passes, and every check applies to
    it."""
    found = outcomes_of(faulty_policies.Right(), drives)
    assert {
        name: one for name, one in found.outcomes.items() if one.outcome != "passed"
    }.keys() == {"example"}
    assert (
        {*faulty_policies.FAULTS, *faulty_policies.DOUBTS, "example"}
        == set(POLICY_CHECKS)
        == set(found.outcomes)
    )


@pytest.mark.engine
@pytest.mark.parametrize(
    ("check", "fault"),
    [(check, one) for check, faults in faulty_policies.FAULTS.items() for one in faults],
)
def test_a_planted_fault_fails_its_check(check: str, fault: type[Policy], drives: Drives) -> None:
    """The check fails with a reason."""
    driver = PolicyCaller(fault())
    outcome, words = checked_policy(driver, driver.manifest, drives, only=(check,)).outcomes[check]
    assert outcome == "failed", words
    assert len(words) > 10


@pytest.mark.engine
@pytest.mark.parametrize("check", list(faulty_policies.DOUBTS))
def test_a_questionable_policy_gets_a_warning(check: str, drives: Drives) -> None:
    """A policy that may be right gets a warning with the reason, and no failure."""
    found = outcomes_of(faulty_policies.DOUBTS[check](), drives)
    assert found.outcomes[check].outcome == "warning" and "right" in found.outcomes[check].words
    assert found.count("failed") == 0


@pytest.mark.engine
def test_a_privileged_policy_passes() -> None:
    """Nothing fails, and checks that do not apply say why."""
    found = outcomes_of(Route(), shown_drives(Route.manifest, 4, camera_of_choice("auto")))
    assert found.count("failed") == 0 and found.count("passed") >= 7
    assert "needs no picture" in found.outcomes["mirror"].words


@pytest.mark.engine
def test_the_command_prints_and_draws_its_findings(cosim: Cosim, tmp_path: Path) -> None:
    """It prints a table or JSON, writes a picture with the waypoints, and exits with 1 after a
    failure."""
    source = Path(faulty_policies.__file__).read_text()
    (tmp_path / "faulty_policies.py").write_text(source)
    words = ("--frames", "4", "-o", "check.png")
    right = cosim("policy", "check", "faulty_policies:Right", *words, cwd=tmp_path)
    assert (
        right.returncode == 0 and "0 failed" in right.stdout and "colour_order" in right.stdout
    ), right.stderr
    picture = cv2.imread(str(tmp_path / "check.png"))
    assert picture is not None and picture.shape[:2] == (4 * 320, 2 * 480)
    assert (
        np.abs(picture.astype(int) - (60, 70, 255)).max(axis=2) < 8
    ).sum() > 100  # the waypoint that is followed
    wrong = cosim(
        "policy", "check", "faulty_policies:BlueForRed", "--frames", "4", "--json", cwd=tmp_path
    )
    report = json.loads(wrong.stdout)
    assert wrong.returncode == 1 and report["checks"]["colour_order"]["outcome"] == "failed"
    assert (
        report["goal"] == "route_point"
        and report["answer_ms"] > 0.0
        and len(report["checks"]) == len(POLICY_CHECKS)
    )


def test_an_example_needs_expected_outputs(tmp_path: Path) -> None:
    """The outputs of the graph pass, others fail, and inputs alone, as some exporters write, give a
    warning."""
    driver = PolicyCaller(OnnxPolicy(bundle(tmp_path, tiny_graph())))
    inputs = {"obs": np.zeros((1, 6, 4, 8), np.float32), "goal": np.ones((1, 2), np.float32)}
    action = np.arange(1, 6)[None, :, None] / 5 * np.ones(2)
    for expected, outcome in (
        ({}, "warning"),
        ({"action": action}, "passed"),
        ({"action": -action}, "failed"),
    ):
        np.savez(
            tmp_path / "example.npz",
            **inputs,
            **{f"expected.{name}": one for name, one in expected.items()},
        )
        assert example(PolicyQuery(driver, driver.manifest, {})).outcome == outcome


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nobody",), "unknown policy 'nobody'"),
        (("route", "-o", "check.jpg"), "use a name that ends in .png"),
        (("orca", "--goal", "image"), "has no camera"),
        (("orca", "--only", "mirrors"), "Did you mean mirror?"),
    ],
)
def test_wrong_use_is_refused_before_anything_is_drawn(
    words: tuple[str, ...], message: str, cosim: Cosim
) -> None:
    """An unknown policy, picture format, goal or check gives one line and exit code 2."""
    done = cosim("policy", "check", *words)
    assert done.returncode == 2 and message in done.stderr and "drawing" not in done.stderr
