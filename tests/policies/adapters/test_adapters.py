"""Manifests of published networks: small graphs with their inputs and outputs pass `cosim policy
check`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import UsageError
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.load import load_policy
from cosim.policies.onnx.manifest import BundleManifest, read_bundle_manifest
from cosim.policies.onnx.policy import OnnxPolicy
from physics.cameras.choice import camera_of_choice
from scenarios.tools.policy_check.checks import checked_policy
from scenarios.tools.policy_check.drives import shown_drives
from tests.conftest import Cosim
from tests.support.stand_in_graphs import Shapes, likeness

ADAPTERS = Path(__file__).parents[3] / "cosim" / "policies" / "adapters"
GNM: Shapes = {
    "obs_img": (1, 18, 64, 85),
    "goal_img": (1, 3, 64, 85),
    "dist_pred": (1, 1),
    "action_pred": (1, 5, 4),
}
SHAPES: dict[str, Shapes] = {
    "gnm": GNM,
    "vint": GNM,
    "nomad": {
        "obs_img": (1, 12, 96, 96),
        "goal_img": (1, 3, 96, 96),
        "goal_mask": (1,),
        "noise": (11, 8, 2),
        "actions": (1, 8, 2),
    },
    "mbra": {"obs_img": (1, 18, 96, 96), "goal_pose": (1, 4), "action_pred": (1, 8, 4)},
    "citywalker": {
        "obs": (1, 5, 3, 350, 630),
        "cord": (1, 6, 2),
        "wp_pred": (1, 5, 2),
        "arrive_pred": (1, 1),
    },
    "s2e": {
        "obs": (1, 11, 3, 256, 256),
        "goal": (1, 3),
        "wp_pred": (1, 64, 10, 2),
        "wp_pred_score": (1, 64),
    },
    "mimic": {"obs": (1, 16, 3, 288, 512), "output": (1, 15, 2)},
    "flowpilot": {
        "vision": (1, 20, 3, 216, 384),
        "route_patch": (1, 20, 80, 80),
        "goal": (1, 20, 3),
        "ego": (1, 20, 2),
        "action_bounds": (1, 2, 5),
        "modes": (1, 6, 80, 5),
        "probs": (1, 6),
        "speed": (1, 1),
    },
    "openpilot": {
        "input_imgs": (1, 12, 128, 256),
        "big_input_imgs": (1, 12, 128, 256),
        "desire": (1, 100, 8),
        "traffic_convention": (1, 2),
        "features_buffer": (1, 99, 512),
        "plan": (1, 4955),
        "hidden_state": (1, 512),
    },
}
"""Input and output shapes, guessed where they are not public: see README.md of the manifests."""
SAMPLE = ("nomad", "s2e")


def bundle_of(name: str, folder: Path, **changes: object) -> Path:
    """A folder with an adapter's manifest, without its files, and a small graph; `changes` are of
    the output."""
    manifest = json.loads((ADAPTERS / name / "manifest.json").read_text())
    bundle: BundleManifest = read_bundle_manifest(ADAPTERS / name)
    (folder / bundle.model).write_bytes(likeness(bundle, SHAPES[name]))
    manifest.pop("files", None)
    manifest["output"] |= changes
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.mark.parametrize("name", list(SHAPES))
def test_an_adapter_accepts_a_graph_of_the_networks_shapes(name: str, tmp_path: Path) -> None:
    """All inputs are built and outputs read in two queries in a grey street when it is loaded."""
    policy = OnnxPolicy(bundle_of(name, tmp_path))
    assert policy.manifest.name == name and set(policy.graph.inputs) == set(policy.bundle.inputs)


@pytest.mark.engine
@pytest.mark.parametrize("name", list(SHAPES))
def test_an_adapter_passes_the_check(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """A graph that follows street and goal, with the network's inputs and outputs, passes every
    check."""
    if name not in SAMPLE and not request.config.getoption("--whole"):
        pytest.skip("a sample is tested without --whole")
    policy = OnnxPolicy(bundle_of(name, tmp_path))
    drives = shown_drives(policy.manifest, 3, camera_of_choice("auto"))
    found = checked_policy(PolicyCaller(policy), policy.manifest, drives)
    assert {check: one for check, one in found.outcomes.items() if one.outcome == "failed"} == {}
    assert found.outcomes["picture_ignored"].outcome == found.outcomes["unit"].outcome == "passed"
    assert found.count("passed") >= 11


@pytest.mark.engine
def test_an_adapter_with_the_wrong_side_or_unit_fails_the_check(tmp_path: Path) -> None:
    """The same graph under a manifest with a typical mistake does not pass."""
    for changes, check in (({"columns": ["y", "x"]}, "goal_mirrored"), ({"unit_m": 11.0}, "unit")):
        policy = OnnxPolicy(bundle_of("citywalker", tmp_path, **changes))
        drives = shown_drives(policy.manifest, 2, camera_of_choice("auto"))
        outcome, words = checked_policy(PolicyCaller(policy), policy.manifest, drives).outcomes[
            check
        ]
        assert outcome == "failed", words


def test_every_adapter_says_where_its_weights_are(
    cosim: Cosim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is a policy by name; without weights a run names file, source, size and hash where these
    are known."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert sorted(SHAPES) == sorted(path.parent.name for path in ADAPTERS.glob("*/manifest.json"))
    for name in SHAPES:
        bundle = read_bundle_manifest(ADAPTERS / name)
        with pytest.raises(UsageError) as refused:
            load_policy(name)
        message = str(refused.value)
        assert (
            f"{bundle.model} is missing" in message and bundle.source in message and bundle.licence
        )
        if bundle.model in bundle.files:
            facts = bundle.files[bundle.model]
            assert f"{facts.bytes} bytes, SHA-256 {facts.sha256}" in message
        else:
            assert (
                "unknown" in bundle.source
                or "not published" in bundle.source
                or "vary" in bundle.source
            )


AGENT = """
import numpy as np
from types import SimpleNamespace

class InternVLAN1AsyncAgent:
    def __init__(self, args):
        assert (args.resize_w, args.resize_h, args.model_path) == (384, 384, "checkpoint")

    def reset(self):
        self.seen = 0

    def step(self, rgb, depth, pose, words, intrinsic, look_down=False):
        assert rgb.shape == (384, 384, 3) and depth.shape == (384, 384) and intrinsic.shape == (4, 4)
        if not look_down and self.seen == 0:
            self.seen = 1
            return SimpleNamespace(output_action=[5], output_trajectory=None)
        grey = rgb[:192].mean(axis=2)
        turn = -4.0 * float((grey * np.linspace(-0.5, 0.5, 384)).mean() / (grey.mean() + 1e-3))
        turn += 0.3 * ("left" in words) - 0.3 * ("right" in words)
        far = np.linspace(0.0, 2.0, 9)[:, None]
        return SimpleNamespace(output_action=None, output_trajectory=far * np.array([np.cos(turn), np.sin(turn)]))
"""


@pytest.mark.engine
def test_internvla_is_queried_as_by_its_authors(
    cosim: Cosim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A substitute agent with the same interface, imported from the path, passes the check through
    the served policy's code."""
    folder = tmp_path / "internnav" / "agent"
    folder.mkdir(parents=True)
    (folder / "internvla_n1_agent_realworld.py").write_text(AGENT)
    for package in (folder, folder.parent):
        (package / "__init__.py").touch()
    name = f"{ADAPTERS.parents[2]}/docs/examples/internvla_n1.py:InternVlaN1"
    without = cosim("policy", "check", name)
    assert without.returncode == 2 and "github.com/InternRobotics/InternNav" in without.stderr
    monkeypatch.setenv("COSIM_INTERNVLA", "checkpoint")
    done = cosim("policy", "check", name, "--frames", "3", "--json", cwd=tmp_path)
    report = json.loads(done.stdout)
    assert done.returncode == 0, report
    assert (
        report["checks"]["goal_mirrored"]["outcome"]
        == report["checks"]["side"]["outcome"]
        == "passed"
    )
    assert np.isfinite(report["answer_ms"])
