"""Small graphs with the inputs and outputs of a bundle's manifest, whose answers follow street and
goal a little."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from onnx import NodeProto, TensorProto, helper

from cosim.policies.onnx.inputs import (
    ConstantInput,
    GoalPointInput,
    JoinedInput,
    MaskInput,
    NoiseInput,
    PixelsInput,
    RoutePatchInput,
    StateInput,
    axes_of,
)
from cosim.policies.onnx.manifest import BundleManifest
from cosim.policies.onnx.outputs import WaypointsOutput
from tests.support.graphs import graph_bytes, port

Shapes = dict[str, tuple[int, ...]]
SPEED_MPS = 1.0


def likeness(bundle: BundleManifest, shapes: Shapes) -> bytes:
    """Return a graph with these shapes of inputs and outputs. It turns by the sum of what each
    input indicates for left and right, and drives at 1 m/s. Unused outputs are zeros."""
    nodes: list[NodeProto] = []
    weights: dict[str, np.ndarray[Any, Any]] = {"zero": np.zeros((1,), np.float32)}
    terms = ["zero"]
    ints = {name for name, one in bundle.inputs.items() if isinstance(one, MaskInput)}
    for name, one in bundle.inputs.items():
        source = name
        if name in ints:
            nodes.append(helper.make_node("Cast", [name], [f"{name}.float"], to=TensorProto.FLOAT))
            source = f"{name}.float"
        weight = _weights(one, shapes[name])
        if isinstance(one, PixelsInput | RoutePatchInput):
            rows = next(i for i, axis in enumerate(axes_of(one.layout)) if axis == "H")
            nodes.append(
                helper.make_node("ReduceMean", [source], [f"{name}.rows"], axes=[rows], keepdims=0)
            )
            source = f"{name}.rows"
            weight = weight.mean(axis=rows) * shapes[name][rows]
        place = _point_in(one)
        if place is not None:
            source = _bearing(name, source, place, nodes, weights)
            weight = np.array([0.5], np.float32)
        weights[f"{name}.weight"] = weight.astype(np.float32).reshape(-1, 1)
        weights[f"{name}.flat"] = np.array([1, -1])
        nodes.append(helper.make_node("Reshape", [source, f"{name}.flat"], [f"{name}.row"]))
        nodes.append(
            helper.make_node("MatMul", [f"{name}.row", f"{name}.weight"], [f"{name}.term"])
        )
        terms.append(f"{name}.term")
    nodes.append(helper.make_node("Sum", terms, ["turn"]))
    outputs = [name for name in shapes if name not in bundle.inputs]
    for name in outputs:
        plain, turned = _answer(bundle, name, shapes[name])
        weights |= {
            f"{name}.plain": plain,
            f"{name}.turned": turned,
            f"{name}.shape": np.array(shapes[name]),
        }
        nodes.append(helper.make_node("MatMul", ["turn", f"{name}.turned"], [f"{name}.part"]))
        nodes.append(helper.make_node("Add", [f"{name}.part", f"{name}.plain"], [f"{name}.all"]))
        nodes.append(helper.make_node("Reshape", [f"{name}.all", f"{name}.shape"], [name]))
    kinds = {name: TensorProto.INT64 if name in ints else TensorProto.FLOAT for name in shapes}
    ports = {name: port(name, *shape, kind=kinds[name]) for name, shape in shapes.items()}
    return graph_bytes(
        nodes, [ports[name] for name in bundle.inputs], [ports[name] for name in outputs], weights
    )


def _weights(one: Any, shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """Return the weight of each number of an input for turning left."""
    if isinstance(one, NoiseInput | MaskInput):
        return np.full(shape, 1e-3)
    if isinstance(one, StateInput | ConstantInput) or not isinstance(
        one, PixelsInput | RoutePatchInput
    ):
        return np.zeros(shape)
    channels = 1 if isinstance(one, RoutePatchInput) else one.channels
    sides = (80, 80) if isinstance(one, RoutePatchInput) else one.sides
    ages = np.arange(one.frames)[::-1]
    newer = 0.3 ** np.minimum(ages, 20.0)
    tint = np.ones(channels)
    if channels == 6:
        tint[4:] = 0.0
    gain = (
        -6.0
        / (255.0 if getattr(one, "scale", 255.0) == 1.0 else 1.0)
        * (0.225 if getattr(one, "std", ()) else 1.0)
    )
    gain *= 4.0 if isinstance(one, RoutePatchInput) else 2.0
    across = np.linspace(-0.5, 0.5, sides[1])
    weights = np.einsum("t,c,x->tcx", newer / newer.sum(), tint / tint.sum(), across / sides[1])
    weights = np.repeat(weights[:, :, None], sides[0], axis=2) / sides[0] * gain
    order = {"N": 1, "T": one.frames, "C": channels, "H": sides[0], "W": sides[1]}
    letters = "".join(axes_of(one.layout))
    missing = [letter for letter in "TCHW" if letter not in letters]
    laid = np.einsum(
        f"TCHW->{''.join(letter for letter in letters if letter != 'N')}{''.join(missing)}", weights
    )
    assert all(order[letter] == 1 for letter in missing)
    return laid.reshape(shape)


def _point_in(one: Any) -> tuple[list[int], GoalPointInput] | None:
    """Return the index of the newest point of an input, counted through it."""
    if isinstance(one, GoalPointInput):
        start = (one.frames - 1) * len(one.values)
        return list(range(start, start + len(one.values))), one
    if isinstance(one, JoinedInput):
        start = 0
        for part in one.parts:
            size = len(getattr(part, "values", ())) * getattr(part, "frames", 1)
            if isinstance(part, GoalPointInput):
                return list(range(start, start + size)), part
            start += size
    return None


def _bearing(
    name: str,
    source: str,
    place: tuple[list[int], GoalPointInput],
    nodes: list[NodeProto],
    weights: Any,
) -> str:
    """Return the sine of the direction of a point, to the left."""
    at, point = place
    weights[f"{name}.all"] = np.array([1, -1])
    nodes.append(helper.make_node("Reshape", [source, f"{name}.all"], [f"{name}.values"]))

    def taken(value: str) -> str:
        found = next(
            i for i, called in enumerate(point.values) if called.removeprefix("-") == value
        )
        sign = -1.0 if point.values[found].startswith("-") else 1.0
        weights[f"{name}.{value}.at"] = np.array([at[found]])
        weights[f"{name}.{value}.sign"] = np.array([sign], np.float32)
        nodes.append(
            helper.make_node(
                "Gather", [f"{name}.values", f"{name}.{value}.at"], [f"{name}.{value}.raw"], axis=1
            )
        )
        nodes.append(
            helper.make_node(
                "Mul", [f"{name}.{value}.raw", f"{name}.{value}.sign"], [f"{name}.{value}"]
            )
        )
        return f"{name}.{value}"

    if "sin" in point.values:
        return taken("sin")
    x, y = taken("x"), taken("y")
    weights[f"{name}.least"] = np.array([1e-3], np.float32)
    nodes.append(helper.make_node("Mul", [x, x], [f"{name}.xx"]))
    nodes.append(helper.make_node("Mul", [y, y], [f"{name}.yy"]))
    nodes.append(
        helper.make_node("Sum", [f"{name}.xx", f"{name}.yy", f"{name}.least"], [f"{name}.far2"])
    )
    nodes.append(helper.make_node("Sqrt", [f"{name}.far2"], [f"{name}.far"]))
    nodes.append(helper.make_node("Div", [y, f"{name}.far"], [f"{name}.sine"]))
    return f"{name}.sine"


def _answer(bundle: BundleManifest, name: str, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Return (1, numbers) twice: an output straight ahead, and its change for a turn of 1 rad to
    the left."""
    output = bundle.output
    assert isinstance(output, WaypointsOutput)
    count = math.prod(shape)
    plain, turned = np.zeros(count), np.zeros(count)
    if name == output.scores:
        plain[0] = 1.0
    if name != output.name:
        return plain.astype(np.float32)[None], turned.astype(np.float32)[None]
    points = output.mixture.points if output.mixture else shape[-2]
    width = len(output.columns)
    step_m = SPEED_MPS * output.dt_s / (output.index + 1)
    along = np.full(points, step_m) if output.steps else step_m * np.arange(1, points + 1)
    rows, sides = np.zeros((points, width)), np.zeros((points, width))
    for i, column in enumerate(output.columns):
        sign = -1.0 if column.startswith("-") else 1.0
        bare = column.removeprefix("-")
        if bare in ("x", "y"):
            (rows if bare == "x" else sides)[:, i] = sign * along / output.unit_m
        elif bare in ("cos", "speed"):
            rows[:, i] = 1.0
        elif bare in ("sin", "heading", "turn"):
            sides[:, i] = sign
    if output.offset:
        rows -= output.offset
    if output.scale:
        rows, sides = rows / output.scale, sides / output.scale
    plain[: rows.size], turned[: sides.size] = rows.ravel(), sides.ravel()
    if output.mixture:
        plain[2 * rows.size] = 1.0  # the first mode's score
    return plain.astype(np.float32)[None], turned.astype(np.float32)[None]
