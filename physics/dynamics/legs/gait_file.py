"""Load a gait: its manifest, and the network in the same folder or in a folder of weights."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Final

from cosim.core.errors import SpecError, UsageError
from cosim.core.network import Network, network_of
from cosim.core.npz import read_open_npz
from cosim.policies.onnx.weights import NetworkFile, read_file, weights_file
from cosim.spec.options import ONNX_GAIT
from cosim.spec.robot import ROBOTS, Legs, Robot
from physics.dynamics.legs.gait_graph import network_of_graph
from physics.dynamics.legs.gait_manifest import GaitManifest, read_gait_manifest
from physics.dynamics.legs.network_gait import NetworkGait, NetworkSetup
from physics.robots import gait_path
from physics.robots.make_urdf import MODELS

_MAX_BYTES: Final = 64 << 20
"""Largest size of a gait's network in bytes."""


def user_gait(name: str, robot: Robot, substep_s: float) -> NetworkSetup:
    """Load the gait `onnx:FILE.onnx` with the manifest FILE.json in the same folder.

    Raises UsageError or SpecError for a missing, invalid or unsuitable file.
    """
    robot_legs(robot, name)
    path = Path(name.removeprefix(ONNX_GAIT))
    if not name.startswith(ONNX_GAIT) or path.suffix != ".onnx":
        raise UsageError(
            f"gait '{name}': use onnx:FILE.onnx, with its manifest FILE.json in the same folder"
        )
    if not path.is_file():
        raise UsageError(f"gait '{name}': {path} does not exist")
    manifest_path = path.with_suffix(".json")
    setup = _load(manifest_path, robot, substep_s)
    if setup.manifest.model != path.name:
        raise SpecError(f"{manifest_path}: model is {setup.manifest.model!r}, not {path.name!r}")
    return setup


def robot_legs(robot: Robot, gait: str) -> Legs:
    """Return the legs of a robot. Raises UsageError for wheels."""
    if isinstance(robot.drive, Legs):
        return robot.drive
    walking = ", ".join(name for name, one in ROBOTS.items() if isinstance(one.drive, Legs))
    raise UsageError(f"gait '{gait}': robot '{robot.name}' has wheels; with legs are {walking}")


def published_gait(robot: Robot, legs: Legs, dt_s: float) -> NetworkGait:
    """Return the gait of a robot's own manifest."""
    return network_gait(robot, legs, dt_s, _load(gait_path(robot), robot, dt_s))


def weights_in_words(robot: Robot) -> str:
    """Describe where the weights of a robot's own gait are, or that they are missing.

    The text begins with a comma, and is empty for a robot without weights.
    """
    if not isinstance(robot.drive, Legs) or robot.drive.gait != "network":
        return ""
    manifest_path = gait_path(robot)
    manifest = read_gait_manifest(manifest_path)
    try:
        return f", weights {_model_path(manifest_path, manifest)}"
    except UsageError:
        return f", weights missing ({manifest.model})"


def network_gait(robot: Robot, legs: Legs, dt_s: float, setup: NetworkSetup) -> NetworkGait:
    """Return a gait for a robot.

    dt_s: duration of a substep.
    """
    return NetworkGait(robot, legs, dt_s, setup, MODELS[robot.name])


def _load(manifest_path: Path, robot: Robot, substep_s: float) -> NetworkSetup:
    manifest = read_gait_manifest(manifest_path)
    try:
        manifest.check_robot(robot, substep_s)
    except SpecError as error:
        raise SpecError(f"{manifest_path}: {error}") from error
    facts = manifest.files.get(manifest.model)
    path = _model_path(manifest_path, manifest)
    data = read_file(path, _MAX_BYTES)
    NetworkFile(manifest.model, manifest.source, facts).check(path, data)
    try:
        network = _network(path, data)
        _check_sizes(manifest, network)
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{path}: {error}") from error
    digest = hashlib.blake2b(manifest_path.read_bytes() + data, digest_size=16).hexdigest()
    return NetworkSetup(manifest, network, digest)


def _model_path(manifest_path: Path, manifest: GaitManifest) -> Path:
    """Return the path of a gait's network. Raises UsageError if it is missing."""
    facts = manifest.files.get(manifest.model)
    user = f"gait '{manifest.name}' of robot '{manifest.robot}'"
    folders = [manifest_path.parent] if manifest.model.endswith(".onnx") else []
    return weights_file(user, manifest.model, facts, manifest.source, folders)


def _network(path: Path, data: bytes) -> Network:
    if path.suffix == ".onnx":
        return network_of_graph(data)
    return network_of(read_open_npz(io.BytesIO(data), max_bytes=_MAX_BYTES))


def _check_sizes(manifest: GaitManifest, network: Network) -> None:
    """Raise ValueError unless inputs and outputs of the network are those of its manifest."""
    inputs, outputs = manifest.sizes
    if network.sizes[0] != inputs:
        parts = ", ".join(
            f"{term.__struct_config__.tag} {term.count(len(manifest.joints))}"
            for term in manifest.observation
        )
        raise ValueError(
            f"takes {network.sizes[0]} numbers, and the observation of its manifest has {inputs}: "
            f"{parts}"
        )
    if network.sizes[1] != outputs:
        raise ValueError(f"has {network.sizes[1]} outputs, and its manifest {outputs} joints")
