"""A planned city becomes a street net: plain XML, netconvert, signal programs of our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cosim.spec.scenario import City
from sumo_nets.city.blocks import CLASSES, Point
from sumo_nets.city.city import plan_city
from sumo_nets.city.plan import CityPlan, Edge
from sumo_nets.city.signals import with_programs
from sumo_nets.net.net_hash import without_comments
from sumo_nets.net.netconvert import netconvert

_CROSSING_M = 3.2
_NETCONVERT = (
    "--walkingareas",
    "--no-turnarounds.except-deadend",
    "--junctions.corner-detail=8",
    "--junctions.internal-link-detail=8",
    "--offset.disable-normalization",
    f"--default.crossing-width={_CROSSING_M}",
    "--default.sidewalk-width=3.2",
)


def city_as_net(city: City, folder: Path) -> bytes:
    """The net of a city; folder: for what is written on the way."""
    plan = plan_city(city.seed, city.size_m, city.style)
    return with_programs(without_comments(_converted(plan, folder).read_bytes()), plan.signal_rng)


def _converted(plan: CityPlan, folder: Path) -> Path:
    nodes, edges, crossings = folder / "c.nod.xml", folder / "c.edg.xml", folder / "c.con.xml"
    rows = []
    for node in plan.nodes:
        kind = "traffic_light" if node.signalised else "priority"
        shape = f' shape="{_shape(node.outline)}"' if node.outline else ""
        rows.append(f'<node id={quoteattr(node.id)} x="{node.at[0]:.2f}" y="{node.at[1]:.2f}" type="{kind}"{shape}/>')
    nodes.write_text("<nodes>\n" + "\n".join(rows) + "\n</nodes>\n")
    rings = [f'<roundabout nodes="{" ".join(r.nodes)}" edges="{" ".join(r.edges)}"/>' for r in plan.rings]
    edges.write_text("<edges>\n" + "\n".join([*map(_edge, plan.edges), *rings]) + "\n</edges>\n")
    zebras = [
        f'<crossing node="{z.node}" edges="{" ".join(z.edges)}" width="{z.width_m}" priority="true"/>'
        for z in plan.zebras
    ]
    crossings.write_text("<connections>\n" + "\n".join(zebras) + "\n</connections>\n")
    return netconvert(
        ["-n", str(nodes), "-e", str(edges), "-x", str(crossings), *_NETCONVERT], folder / "built.net.xml"
    )


def _edge(edge: Edge) -> str:
    """An edge with its sidewalk as lane 0, the verge next to it, the lanes that are driven on, half of the island."""
    made, section = CLASSES[edge.street_class], edge.section
    lanes = [
        f'allow="pedestrian" width="{section.sidewalk_m}"',
        f'disallow="all" width="{section.verge_m}" type="green_verge"',
        *[f'disallow="pedestrian" width="{section.lane_m}"'] * section.lanes,
    ]
    if section.median_m:
        lanes.append(f'disallow="all" width="{section.median_m}" type="median"')
    numbered = "".join(f'<lane index="{i}" {lane}/>' for i, lane in enumerate(lanes))
    params = {
        "street_class": edge.street_class,
        "frontage_m": section.frontage_m,
        "verge_m": section.verge_m,
        "curb_m": section.curb_m,
        "gutter_m": section.gutter_m,
    }
    if edge.driveways:
        params["driveways"] = _shape(edge.driveways)
    zones = "".join(f'<param key="{key}" value="{value}"/>' for key, value in params.items())
    return (
        f'<edge id={quoteattr(edge.id)} from="{edge.tail}" to="{edge.head}" numLanes="{len(lanes)}" '
        f'speed="{made.speed_mps}" priority="{made.priority}" type="{edge.street_class}" spreadType="right" '
        f'shape="{_shape(edge.line)}">{numbered}{zones}</edge>'
    )


def _shape(line: Sequence[Point]) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in line)
