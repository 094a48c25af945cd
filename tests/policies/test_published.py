"""Published networks: their manifests, and their answers to pictures of this street."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.core.errors import UsageError
from cosim.core.state import Command
from cosim.policies.load import bundle_in_words, load_policy, shipped_bundles
from cosim.policies.onnx.manifest import read_bundle_manifest
from cosim.policies.onnx.policy import OnnxPolicy, example_observation
from cosim.spec.goal import Instruction

PICTURES = Path(__file__).parent / "pictures"
WEIGHTS = Path(os.environ.get("COSIM_WEIGHTS") or Path(__file__).parents[3] / "shared" / "weights")
PUBLISHED = ("dronet", "openbot")


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the networks' files, which are not in this repository."""
    names = [read_bundle_manifest(shipped_bundles()[name]).model for name in PUBLISHED]
    if missing := [name for name in names if not (WEIGHTS / name).is_file()]:
        pytest.skip(
            f"the published weights {', '.join(missing)} are not in {WEIGHTS} (COSIM_WEIGHTS)"
        )
    monkeypatch.setenv("COSIM_WEIGHTS", str(WEIGHTS))
    return WEIGHTS


@pytest.mark.parametrize("name", PUBLISHED)
def test_missing_weights_are_reported_with_their_source(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message has file, size, hash, source, the command that makes it, and the searched
    folders; the list marks it as missing."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    bundle = read_bundle_manifest(shipped_bundles()[name])
    facts = bundle.files[bundle.model]
    with pytest.raises(UsageError) as caught:
        load_policy(name)
    message = str(caught.value)
    assert (
        f"{bundle.model} is missing, {facts.bytes} bytes, BLAKE2b {facts.blake2b}: from "
        f"{bundle.source}" in message
    )
    assert (
        f"`python -m cosim.policies.published.{name} " in message and "pip install onnx" in message
    )
    assert str(tmp_path) in message and "\n" not in message
    assert f"weights missing ({bundle.model})" in bundle_in_words(shipped_bundles()[name])


@pytest.mark.parametrize("name", PUBLISHED)
def test_another_file_of_the_same_name_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that only has the name of the weights is refused."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    (tmp_path / read_bundle_manifest(shipped_bundles()[name]).model).write_bytes(b"\x3a\x00")
    with pytest.raises(
        UsageError,
        match=r"is another file than the manifest of '\w+' says: files\..*\.bytes is \d+",
    ):
        load_policy(name)


def _picture(name: str) -> NDArray[np.uint8]:
    return np.ascontiguousarray(cv2.imread(str(PICTURES / f"{name}.jpg"))[..., ::-1])


def test_dronet_turns_back_to_the_way_and_a_mirrored_street_mirrors_its_turn(weights: Path) -> None:
    """A robot that has turned 30 degrees away from an empty sidewalk turns back, mirrored to the
    other side."""
    policy = OnnxPolicy(shipped_bundles()["dronet"])
    seen = example_observation(policy.manifest)

    def command(picture: NDArray[np.uint8]) -> Command:
        policy.reset("street", 0)
        answer = policy.act(replace(seen, rgb=np.ascontiguousarray(picture)))
        assert isinstance(answer, Command)
        return answer

    for turned, sign in (("left", -1.0), ("right", 1.0)):
        street = _picture(f"mast_{turned}")
        back = sign * command(street).w_radps
        mirrored = sign * command(street[:, ::-1]).w_radps
        assert back > 0.05 > 0.0 > mirrored
        assert command(street).v_mps == pytest.approx(1.5 * 0.7, abs=0.05), (
            "paths are free: 7 tenths of its speed"
        )


def test_openbot_turns_to_where_the_instruction_says(weights: Path) -> None:
    """With an instruction to turn left it turns more to the left than without, and to the right
    likewise."""
    policy = OnnxPolicy(shipped_bundles()["openbot"])
    seen = example_observation(policy.manifest)

    def turn(text: str) -> float:
        answer = policy.act(replace(seen, goal=Instruction(text)))
        assert isinstance(answer, Command) and 0.0 < answer.v_mps < 2.5
        return answer.w_radps

    assert (
        turn("Turn right.")
        < turn("Follow the sidewalk. In 12 m, turn left.")
        == turn("Follow the sidewalk.")
        < turn("In 4 m, turn left.")
    )
