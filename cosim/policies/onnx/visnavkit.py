"""Read exports of visnavkit: `X.onnx` with `X.metadata.json` and `X.inputs.npz`.

Two types of graph are known. A window of frames: `vision`, `route_patch`, `goal`, `ego`,
`action_bounds` to `modes` and `probs`. Single frames with a feature buffer: `vision`,
`feature_buffer`, `goal`, `ego` to `plan` and `feat_out`. Missing values are that project's
defaults: 20 Hz for a window, 10 Hz for frames.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import SpecError, UsageError
from cosim.core.npz import read_npz
from cosim.policies.onnx.inputs import (
    ConstantInput,
    GoalPictureInput,
    GoalPointInput,
    GraphInput,
    NoiseInput,
    PictureInput,
    RoutePatchInput,
    SpeedsInput,
    StateInput,
)
from cosim.policies.onnx.manifest import MAX_EXAMPLE_BYTES, BundleCamera, BundleManifest
from cosim.policies.onnx.outputs import Mixture, WaypointsOutput
from cosim.policies.onnx.weights import read_file
from cosim.spec.goal import GoalProtocol

METADATA: Final = ".metadata.json"
EXAMPLE: Final = ".inputs.npz"
_FOV_DEG: Final = 60.0
"""Field of view in degrees assumed for the camera."""
_WINDOW_HZ = 20.0
"""Default rate in Hz of a graph that takes a window of frames."""
_FRAME_HZ = 10.0
"""Default rate in Hz of a graph that takes single frames."""
_MAX_METADATA_BYTES: Final = 16 << 20
"""Largest size of a metadata file in bytes."""
_REACHED_S: Final = 0.5
"""Time in seconds of the waypoint to follow: the first at or after it."""
_AHEAD: Final = (20.0, 1.0, 0.0)
"""Distance, cosine and sine of a goal straight ahead, used if a run has no goal point."""
_POINT: Final = ("distance", "cos", "sin")
"""Values of a goal point."""


class _Metadata(msgspec.Struct):
    """Fields of a metadata file; shapes by the names of inputs and outputs."""

    input_shapes: dict[str, tuple[int, ...]]
    output_shapes: dict[str, tuple[int, ...]]
    config: dict[str, Any] = {}
    exp_name: str | None = None
    onnx_sha256: str = ""


def manifest_of_export(graph: Path) -> BundleManifest:
    """Return the manifest of an exported graph.

    Raises UsageError if the metadata is unreadable, belongs to another graph, or has unknown inputs
    or outputs.
    """
    path = graph.with_suffix(METADATA)
    try:
        metadata = msgspec.json.decode(read_file(path, _MAX_METADATA_BYTES), type=_Metadata)
    except (msgspec.DecodeError, RecursionError) as error:
        raise UsageError(f"{path}: cannot be read: {error}") from error
    found = hashlib.sha256(read_file(graph)).hexdigest()
    if metadata.onnx_sha256 not in ("", found):
        raise UsageError(
            f"{graph}: is another file than {path.name} says: onnx_sha256 is "
            f"{metadata.onnx_sha256[:16]}... there, {found[:16]}... found"
        )
    vision = metadata.input_shapes.get("vision", ())
    if len(vision) not in (4, 5):
        shapes = ", ".join(f"{name} {list(shape)}" for name, shape in metadata.input_shapes.items())
        raise UsageError(f"{path}: input_shapes has no vision of 4 or 5 axes: {shapes}")
    window = len(vision) == 5
    inputs = {
        name: _input(graph, name, shape, metadata, window)
        for name, shape in metadata.input_shapes.items()
    }
    try:
        return BundleManifest(
            format=1,
            name=re.sub(r"[^A-Za-z0-9_-]+", "-", metadata.exp_name or graph.stem).strip("-.")
            or "visnavkit",
            source="exported by visnavkit",
            model=graph.name,
            rate_hz=_rate_hz(metadata, window),
            goal=_protocol(inputs),
            camera=BundleCamera(width=vision[-1], height=vision[-2], fov_deg=_FOV_DEG),
            inputs=inputs,
            output=_window_output(path, metadata) if window else _frame_output(path, metadata),
        )
    except SpecError as error:
        raise UsageError(f"{path}: {error}") from error


def find_exports(folder: Path) -> list[Path]:
    """Return the graphs in a folder that have visnavkit metadata."""
    found = (
        path.with_name(path.name.removesuffix(METADATA) + ".onnx")
        for path in sorted(folder.glob(f"*{METADATA}"))
    )
    return [graph for graph in found if graph.is_file()]


def _input(
    graph: Path, name: str, shape: tuple[int, ...], metadata: _Metadata, window: bool
) -> GraphInput:
    """Return the manifest's description of an input."""
    frames = shape[1] if window and len(shape) > 2 else 1
    if name == "vision":
        size = shape[-1], shape[-2]
        return PictureInput(size=size, frames=frames, layout="NTCHW" if window else "NCHW")
    if name == "route_patch":
        return RoutePatchInput(frames=frames, layout="NTHW", missing=0.0)
    if name == "ego":
        return SpeedsInput(frames=frames, values=tuple(_ego(graph, shape[-1], metadata)))
    if name == "noise":
        return NoiseInput()
    if name == "feature_buffer":
        return StateInput(output="feat_out", append=True)
    if name == "action_bounds":
        return ConstantInput(value=_example(graph, name))
    if name == "goal" and shape[-1] == 3 and len(shape) <= 3:
        return GoalPointInput(values=_POINT, frames=frames, missing=_AHEAD)
    if name == "goal" and len(shape) == 2 and shape[-1] == 2:
        return GoalPointInput(values=("x", "y"), missing=(_AHEAD[0], 0.0))
    if name == "goal" and len(shape) == 4:
        return GoalPictureInput(size=(shape[-1], shape[-2]), layout="NCHW")
    raise UsageError(
        f"{graph.with_suffix(METADATA)}: nothing is known of input '{name}' of shape "
        f"{list(shape)}: write a manifest.json"
    )


def _ego(graph: Path, width: int, metadata: _Metadata) -> Iterator[Literal["v", "w"]]:
    """Yield the names of the robot's speeds."""
    features = (
        _looked_up(metadata.config, "common", "ego_features") or ["speed", "yaw_rate"][:width]
    )
    names: dict[str, Literal["v", "w"]] = {"speed": "v", "yaw_rate": "w"}
    for feature in features:
        if feature not in names:
            path = graph.with_suffix(METADATA)
            raise UsageError(
                f"{path}: nothing is known of ego feature {feature!r}: write a manifest.json"
            )
        yield names[feature]


def _example(graph: Path, name: str) -> tuple[float, ...]:
    """Return the numbers of a constant input from the exported example."""
    path = graph.with_suffix(EXAMPLE)
    try:
        array = read_npz(path, [name], MAX_EXAMPLE_BYTES)[name]
        return tuple(array.astype(float).ravel().tolist())
    except (OSError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: has no {name}, which the graph wants: {error}") from error


def _protocol(inputs: dict[str, GraphInput]) -> GoalProtocol:
    """Return the default goal protocol."""
    goal = inputs.get("goal")
    if isinstance(goal, GoalPictureInput):
        return "image"
    if "route_patch" in inputs:
        return "route_patch"
    return "none" if goal is None else "route_point"


def _rate_hz(metadata: _Metadata, window: bool) -> float:
    rate = _looked_up(metadata.config, "dataset", "train_loader", "hz")
    return (
        float(rate)
        if isinstance(rate, int | float) and rate > 0
        else (_WINDOW_HZ if window else _FRAME_HZ)
    )


def _window_output(path: Path, metadata: _Metadata) -> WaypointsOutput:
    """Describe the output: the plan with the highest probability, driven by its first speeds."""
    shape = metadata.output_shapes.get("modes", ())
    if len(shape) != 4 or shape[-1] != 5 or "probs" not in metadata.output_shapes:
        raise UsageError(
            f"{path}: output_shapes has no probs, or no modes of (1, k, steps, 5): "
            f"{metadata.output_shapes}"
        )
    seconds = _looked_up(metadata.config, "plan_len_seconds") or 0.05 * shape[2]
    return WaypointsOutput(
        name="modes",
        scores="probs",
        columns=("x", "y", "heading", "speed", "turn"),
        index=0,
        dt_s=seconds / shape[2],
        follow="speeds",
    )


def _frame_output(path: Path, metadata: _Metadata) -> WaypointsOutput:
    """Describe the output: the mode with the highest score, and one of its points."""
    common = _looked_up(metadata.config, "common") or {}
    points = common.get("plan_len_points", 0)
    seconds = float(common.get("plan_len_seconds", 0.0))
    width = 3 if common.get("use_full_pose", True) else 2
    shape = metadata.output_shapes.get("plan", ())
    each = points * 2 * width + 1
    if len(shape) != 2 or points < 1 or seconds <= 0.0 or shape[1] % each:
        raise UsageError(
            f"{path}: output plan {list(shape)} is no whole number of modes of {points} points of "
            f"{width} values; config.common has plan_len_points, plan_len_seconds, use_full_pose"
        )
    times = _times_s(points, seconds, common)
    index = int(np.argmax(times >= min(_REACHED_S, times[-1])))
    return WaypointsOutput(
        name="plan",
        columns=("x", "y", "speed") if width == 3 else ("x", "y"),
        index=index,
        dt_s=float(times[index]),
        mixture=Mixture(modes=shape[1] // each, points=points),
    )


def _times_s(points: int, seconds: float, common: dict[str, Any]) -> NDArray[np.floating]:
    """Return the time of each point: evenly spaced or quadratic."""
    if common.get("uniform_t_anchors", False):
        return np.arange(1, points + 1) * (seconds / points)
    if common.get("offset_t_anchors", False):
        return seconds * (np.arange(1, points + 1) / points) ** 2
    return seconds * (np.arange(points) / max(points - 1, 1)) ** 2


def _looked_up(config: Any, *names: str) -> Any:
    """Return a nested field of a config; None if missing."""
    for name in names:
        config = config.get(name) if isinstance(config, dict) else None
    return config
