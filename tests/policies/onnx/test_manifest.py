"""The manifest of an ONNX bundle: read completely, or refused with every fault, its place, and the
valid values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import SpecError
from cosim.policies.onnx.inputs import PictureInput
from cosim.policies.onnx.manifest import read_bundle_manifest
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import WaypointRule

PICTURE = {"what": "picture", "frames": 6, "size": [85, 64], "layout": "N(TC)HW"}
GNM: dict[str, Any] = {
    "format": 1,
    "name": "gnm",
    "goal": "image",
    "camera": {"width": 512, "height": 288, "fov_deg": 60, "crop": [0, 88, 512, 288]},
    "inputs": {"obs": PICTURE, "goal": {"what": "goal_picture", "size": [85, 64]}},
    "output": {
        "what": "waypoints",
        "name": "action",
        "columns": ["x", "y", "cos", "sin"],
        "unit_m": 0.25,
    },
}
POINT = {"what": "goal_point"}
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no-output": ({"output": None}, "Expected `object`, got `null` - at `$.output`"),
    "word": (
        {"inputs": {"obs": {**PICTURE, "hue": 1}}},
        "unknown field `hue` - at `$.inputs.obs`. Valid choices: fr",
    ),
    "kind": (
        {"inputs": {"obs": {"what": "film"}}},
        "'film' - at `$.inputs.obs`. Valid choices: picture, goal_picture",
    ),
    "side": (
        {"inputs": {"obs": {**PICTURE, "size": [85]}}},
        "`array` of length 2, got 1 - at `$.inputs.obs.size`",
    ),
    "sides": (
        {"inputs": {"obs": {**PICTURE, "size": [0, 9]}}},
        "two sides of [1, 4096] pixels, not [0, 9]",
    ),
    "axes": (
        {"inputs": {"obs": {**PICTURE, "layout": "NCHW"}}},
        "layout 'NCHW' has no axis for T of 6 - at `$.inputs",
    ),
    "letters": (
        {"inputs": {"obs": {**PICTURE, "layout": "N(TCHW"}}},
        "such as N(TC)HW: not 'N(TCHW'",
    ),
    "shares": (
        {"inputs": {"obs": {**PICTURE, "crop": [0, 0, 85, 64]}}},
        "crop must be shares [x0, y0, x1, y1]",
    ),
    "std": (
        {"inputs": {"obs": {**PICTURE, "std": [1, 1]}}},
        "std must hold 3 numbers or none, not 2",
    ),
    "flat": (
        {"inputs": {"obs": {**PICTURE, "std": [0, 1, 1]}}},
        "std must hold finite numbers, not 0",
    ),
    "goal": (
        {"goal": "route_point"},
        "goal must be one of image, random_image, of which the inputs are made",
    ),
    "goals": (
        {"inputs": {"a": GNM["inputs"]["goal"], "b": POINT}},
        "inputs a, b need goals that no run can give at o",
    ),
    "blind": ({"camera": None}, "inputs.obs is a picture, and camera is null or missing"),
    "camera": (
        {"inputs": {"obs": {**PICTURE, "camera": "wide"}}},
        "is a picture, and cameras has no 'wide'",
    ),
    "past": (
        {"inputs": {"past": {"what": "past_positions"}}, "goal": "none"},
        "odometry is 'none': say exact or wheel",
    ),
    "no-lidar": ({"inputs": {"a": {"what": "scan"}}, "goal": "none"}, "scan is null or missing"),
    "sectors": (
        {"inputs": {"a": {"what": "scan", "sectors": 7}}, "goal": "none", "scan": {}},
        "inputs.a has 7 sectors, which do not divide the 360 rays of the scan",
    ),
    "lidar": ({"scan": {"rays": 3}}, "scan rays must be in [8, 4096], not 3"),
    "no-imu": ({"inputs": {"a": {"what": "imu"}}, "goal": "none"}, "imu is 'none': say exact or"),
    "no-people": (
        {"inputs": {"a": {"what": "people", "rows": 5}}, "goal": "none"},
        "people is 'none': say seen",
    ),
    "columns": (
        {"output": {**GNM["output"], "columns": ["x", "cos"]}},
        "columns lack y: ['x', 'cos']; waypoints",
    ),
    "now": (
        {"output": {**GNM["output"], "dt_s": 0}},
        "waypoints dt_s must be in (0, 1e+09], not 0.0 - at `$.output`",
    ),
    "no-hash": (
        {"files": {"model.onnx": {"bytes": 1}}},
        "blake2b or sha256 must be given - at `$.files.mod",
    ),
    "hash": (
        {"files": {"model.onnx": {"bytes": 1, "blake2b": "?"}}},
        "64 hexadecimal digits, not '?' - at `$.files.mod",
    ),
    "next-format": ({"format": 2}, "Invalid enum value 2 - at `$.format`. Valid choices: 1"),
    "elsewhere": ({"model": "../model.onnx"}, "model '../model.onnx' cannot name a file"),
}


def test_a_manifest_has_the_facts_that_a_run_needs(tmp_path: Path) -> None:
    """They are the camera, the rule of waypoints, and the goals of its inputs."""
    (tmp_path / "manifest.json").write_text(json.dumps(GNM))
    bundle = read_bundle_manifest(tmp_path)
    assert bundle.policy.camera == CameraSpec(512, 288, 60.0, crop=(0, 88, 512, 288))
    assert bundle.policy.waypoints == WaypointRule(2, 0.25, 0.25, "shipped")
    assert (bundle.policy.goal, bundle.policy.goals) == ("image", ("image", "random_image"))
    assert isinstance(bundle.inputs["obs"], PictureInput) and bundle.inputs["obs"].frames == 6


@pytest.mark.parametrize("name", FAULTS)
def test_a_manifest_with_a_fault_is_refused_with_its_place(tmp_path: Path, name: str) -> None:
    """The message has file, place, what was found and the valid values."""
    change, expected = FAULTS[name]
    (tmp_path / "manifest.json").write_text(json.dumps(GNM | change))
    with pytest.raises(SpecError) as caught:
        read_bundle_manifest(tmp_path)
    assert str(tmp_path / "manifest.json") in str(caught.value) and expected in str(caught.value)


def test_all_faults_of_a_manifest_are_reported(tmp_path: Path) -> None:
    """One message has the faults of several inputs and of the output."""
    inputs = {"obs": {**PICTURE, "size": "large"}, "goal": {"what": "goal_point", "unit_m": -1}}
    (tmp_path / "manifest.json").write_text(
        json.dumps({**GNM, "inputs": inputs, "output": {"what": "wheels"}})
    )
    with pytest.raises(SpecError, match="4 faults") as caught:
        read_bundle_manifest(tmp_path)
    assert all(
        f"`$.{place}`" in str(caught.value)
        for place in ("inputs.obs.size", "inputs.goal", "output")
    )
