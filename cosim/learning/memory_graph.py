"""ONNX graph of one step of the network with a memory, which is carried as an input and output."""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.core.packed_demos import FREE_RAYS
from cosim.learning.graph import PLAN, GraphWriter
from cosim.learning.memory_network import (
    AUXILIARY,
    DETAIL,
    DOINGS,
    EVENTS,
    HALVED,
    MEMORY,
    NEAR,
    NEAR_VALUES,
    PICTURES,
    SIGNALS,
    SIZE_PX,
    STAGES,
    STRIDES,
    is_block,
)
from cosim.learning.network import WAYPOINTS, Parameters

MEMORY_INPUTS: Final = {
    "pictures": (1, 3 * PICTURES, *reversed(SIZE_PX)),
    "goal": (1, 2),
    "speeds": (1, 2),
    "memory": (1, MEMORY),
}
NEXT: Final = "memory_next"
"""Output that is the memory of the next step."""
MEMORY_OUTPUTS: Final = {
    PLAN: (1, WAYPOINTS, 4),
    NEXT: (1, MEMORY),
    "near": (1, NEAR, NEAR_VALUES),
    "free": (1, FREE_RAYS),
    "signal": (1, SIGNALS),
    "event": (1, EVENTS),
    "doing": (1, NEAR, DOINGS),
}


def build_memory_graph(parameters: Parameters, carries: bool = True) -> bytes:
    """Build the graph of a step, equal to `memory_network.forward_steps` and `network.plan`.

    carries: whether the memory is carried; else the output is 0.
    """
    g = GraphWriter(parameters, STRIDES)
    grey, contrast = g.constant("grey", 0.5), g.constant("contrast", 4.0)
    shown = g.add("Mul", [g.add("Sub", ["pictures", grey]), contrast])
    sides = [HALVED, HALVED]
    whole = g.add("AveragePool", [shown], kernel_shape=sides, strides=sides)
    starts = g.constant("detail.starts", [one.start for one in DETAIL], np.int64)
    stops = g.constant("detail.stops", [one.stop for one in DETAIL], np.int64)
    axes = g.constant("detail.axes", [2, 3], np.int64)
    detail = g.add("Slice", [shown, starts, stops, axes])
    seen = [
        g.linear(g.add("Flatten", [_convolved(g, x)]), name)
        for name, x in (("seen", whole), ("upper", detail))
    ]
    image = g.relu(g.add("Add", seen))
    inputs = g.relu(g.linear(g.add("Concat", ["goal", "speeds"], axis=1), "inputs"))
    joined = g.relu(g.linear(g.add("Concat", [image, inputs], axis=1), "joined"))
    after = _remembered(g, joined)
    g.add("Mul", [after, g.constant("carries", float(carries))], NEXT)
    known = g.relu(g.linear(g.add("Concat", [joined, after], axis=1), "known"))
    g.plan(known)
    for name in AUXILIARY:
        shape = g.constant(f"{name}.shape", MEMORY_OUTPUTS[name], np.int64)
        g.add("Reshape", [g.linear(known, name), shape], name)
    return g.finished("sidewalk", MEMORY_INPUTS, MEMORY_OUTPUTS)


def _convolved(g: GraphWriter, x: str) -> str:
    for stage in STAGES:
        if is_block(stage):
            x = g.relu(g.add("Add", [x, g.conv(g.relu(g.conv(x, stage[0])), stage[1])]))
        else:
            for name in stage:
                x = g.relu(g.conv(x, name, {"stem": 5, "narrow": 1}.get(name, 3)))
    return x


def _remembered(g: GraphWriter, joined: str) -> str:
    """Add the gated recurrent unit; return the memory after the step."""
    sides = g.constant("gates", [MEMORY] * 3, np.int64)
    names = [[f"{kind}{k}" for k in range(3)] for kind in ("arriving", "recurrent")]
    g.split(g.linear(joined, "arriving"), sides, names[0])
    g.split(g.linear("memory", "recurrent"), sides, names[1])
    (reset_in, update_in, new_in), (reset_was, update_was, new_was) = names
    reset = g.add("Sigmoid", [g.add("Add", [reset_in, reset_was])])
    update = g.add("Sigmoid", [g.add("Add", [update_in, update_was])])
    new = g.add("Tanh", [g.add("Add", [new_in, g.add("Mul", [reset, new_was])])])
    rest = g.add("Sub", [g.constant("one", 1.0), update])
    return g.add("Add", [g.add("Mul", [update, "memory"]), g.add("Mul", [rest, new])])
