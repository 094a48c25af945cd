"""`cosim policy check`: right policies pass, and each planted fault is told by its check."""

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
from scenarios.tools.policy_check.drives import Drive, SceneName, drives_for
from scenarios.tools.policy_check.query import PolicyQuery
from tests.conftest import Cosim
from tests.support import faulty_policies
from tests.support.graphs import bundle, tiny_graph

Drives = Mapping[SceneName, Drive]


@pytest.fixture(scope="module")
def drives() -> Drives:
    return drives_for(faulty_policies.Right.manifest, 6, camera_of_choice("auto"))


def outcomes_of(policy: Policy, drives: Drives) -> CheckedPolicy:
    driver = PolicyCaller(policy)
    return checked_policy(driver, driver.manifest, drives)


@pytest.mark.engine
def test_a_right_policy_passes_every_check(drives: Drives) -> None:
    """A policy that sees, takes goals and remembers pictures passes, and every check applies to
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
def test_a_planted_fault_is_told(check: str, fault: type[Policy], drives: Drives) -> None:
    """The check that a fault was planted for fails, and says why."""
    driver = PolicyCaller(fault())
    outcome, words = checked_policy(driver, driver.manifest, drives, only=(check,)).outcomes[check]
    assert outcome == "failed", words
    assert len(words) > 10


@pytest.mark.engine
@pytest.mark.parametrize("check", list(faulty_policies.DOUBTS))
def test_what_may_be_right_is_doubted_only(check: str, drives: Drives) -> None:
    """A policy that may be right is doubted, with the reason why it may be, and has not failed."""
    found = outcomes_of(faulty_policies.DOUBTS[check](), drives)
    assert found.outcomes[check].outcome == "warning" and "right" in found.outcomes[check].words
    assert found.count("failed") == 0


@pytest.mark.engine
def test_a_policy_that_is_told_the_street_passes() -> None:
    """It has failed in nothing, and what it is not asked says why."""
    found = outcomes_of(Route(), drives_for(Route.manifest, 4, camera_of_choice("auto")))
    assert found.count("failed") == 0 and found.count("passed") >= 7
    assert "needs no picture" in found.outcomes["mirror"].words


@pytest.mark.engine
def test_the_command_says_what_it_found(cosim: Cosim, tmp_path: Path) -> None:
    """A table, or JSON, a picture with the way in it, and exit code 1 where something has
    failed."""
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
    told = json.loads(wrong.stdout)
    assert wrong.returncode == 1 and told["checks"]["colour_order"]["outcome"] == "failed"
    assert (
        told["goal"] == "route_point"
        and told["answer_ms"] > 0.0
        and len(told["checks"]) == len(POLICY_CHECKS)
    )


def test_an_example_is_right_only_where_it_says_what_is_to_come_out(tmp_path: Path) -> None:
    """The outputs that the graph has pass, others fail, and inputs alone, as some exporters write,
    prove nothing."""
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
    ("words", "said"),
    [
        (("nobody",), "unknown policy 'nobody'"),
        (("route", "-o", "check.jpg"), "use a name that ends in .png"),
        (("orca", "--goal", "image"), "has no camera"),
        (("orca", "--only", "mirrors"), "Did you mean mirror?"),
    ],
)
def test_wrong_use_is_refused_before_anything_is_drawn(
    words: tuple[str, ...], said: str, cosim: Cosim
) -> None:
    """A policy, a picture or a goal that there is not is one line and exit code 2."""
    done = cosim("policy", "check", *words)
    assert done.returncode == 2 and said in done.stderr and "drawing" not in done.stderr
