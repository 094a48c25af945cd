"""Build the nets of generated cities with netconvert, and cache them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from xml.sax.saxutils import quoteattr

import msgspec

from cosim.core.cache import BUILDING_PREFIX, cache_folder, clean_up_if_due, use_entry
from cosim.core.errors import MapError, unwritable
from cosim.core.files import temp_folder, write_atomic
from cosim.spec.scenario import City
from sumo_nets.city.blocks import CLASSES, Point
from sumo_nets.city.city import plan_city
from sumo_nets.city.plan import CityPlan, Edge
from sumo_nets.city.signals import with_signal_programs
from sumo_nets.net.netconvert import netconvert
from sumo_nets.net.raw_file import net_content_hash, without_comments

_CROSSING_M = 3.2
"""Default width of crossings, metres."""
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
    """Return the net of a city.

    folder: for temporary files.
    """
    plan = plan_city(city.seed, city.size_m, city.style)
    return with_signal_programs(
        without_comments(_converted(plan, folder).read_bytes()), plan.signal_rng
    )


def _converted(plan: CityPlan, folder: Path) -> Path:
    nodes, edges, crossings = folder / "c.nod.xml", folder / "c.edg.xml", folder / "c.con.xml"
    rows = []
    for node in plan.nodes:
        kind = "traffic_light" if node.signalised else "priority"
        shape = f' shape="{_shape(node.outline)}"' if node.outline else ""
        rows.append(
            f'<node id={quoteattr(node.id)} x="{node.at[0]:.2f}" y="{node.at[1]:.2f}" '
            f'type="{kind}"{shape}/>'
        )
    nodes.write_text("<nodes>\n" + "\n".join(rows) + "\n</nodes>\n")
    rings = [
        f'<roundabout nodes="{" ".join(r.nodes)}" edges="{" ".join(r.edges)}"/>' for r in plan.rings
    ]
    edges.write_text("<edges>\n" + "\n".join([*map(_edge, plan.edges), *rings]) + "\n</edges>\n")
    zebras = [
        f'<crossing node="{z.node}" edges="{" ".join(z.edges)}" width="{z.width_m}" '
        f'priority="true"/>'
        for z in plan.zebras
    ]
    crossings.write_text("<connections>\n" + "\n".join(zebras) + "\n</connections>\n")
    return netconvert(
        ["-n", str(nodes), "-e", str(edges), "-x", str(crossings), *_NETCONVERT],
        folder / "built.net.xml",
    )


def _edge(edge: Edge) -> str:
    """Return the XML of an edge: sidewalk as lane 0, then the verge, the road lanes, half of the
    median."""
    kind = CLASSES[edge.street_class]
    section = edge.section
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
        f'<edge id={quoteattr(edge.id)} from="{edge.tail}" to="{edge.head}" '
        f'numLanes="{len(lanes)}" speed="{kind.speed_mps}" priority="{kind.priority}" '
        f'type="{edge.street_class}" spreadType="right" '
        f'shape="{_shape(edge.line)}">{numbered}{zones}</edge>'
    )


def _shape(line: Sequence[Point]) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in line)


VAL_SEEDS = tuple(range(1, 81))
TEST_SEEDS = tuple(range(7001, 7021))
"""Seeds of held-out cities: no test, measurement or example uses them."""
SEEDS = (*VAL_SEEDS, *TEST_SEEDS)


def shipped_cities(
    count: int = len(SEEDS), size_m: float = 2000.0, style: str = "mixed"
) -> tuple[City, ...]:
    """Return the first `count` of the shipped cities."""
    return tuple(City(seed=seed, size_m=size_m, style=style) for seed in SEEDS[:count])


GENERATOR = 4
"""Version of the generator, incremented with every change of its nets."""
NET_NAME = "city.net.xml"
ABOUT_NAME = "city.json"
MADE_WITH = ("sidewalk-cosim", "eclipse-sumo", "numpy")
"""Packages that determine a net."""
SEAL = b"<!-- sha256 "
"""Start of the last line of a cached net, which holds the hash of the lines before it."""


def city_net(city: City) -> Path:
    """Return the city's street net, and build it if the cached one is missing or damaged.

    Raises MapError when `city.net_hash` is set and differs from the net's hash.
    """
    path = cache_folder() / f"{city.name}-g{GENERATOR}.net.xml"
    use_entry(path)
    if not is_undamaged(path):
        try:
            clean_up_if_due()
            build_city(city, path)
        except OSError as error:
            raise unwritable(path, error, "set COSIM_CACHE to another folder") from error
    if city.net_hash and (found := net_content_hash(path)) != city.net_hash:
        raise MapError(
            f"{path}: the net's hash is {found}, but the scenario was made on {city.net_hash}: "
            "delete the file to build it again; if the hash stays, the scenario is of "
            "another version of the "
            "generator or of SUMO: build the suite again, or install the version it was made with"
        )
    return path


def is_undamaged(path: Path) -> bool:
    """Return whether a cached net is undamaged, by the hash in its last line."""
    try:
        body, _, seal = path.read_bytes().rpartition(SEAL)
    except OSError:
        return False
    return bool(body) and seal == _seal(body)


def _seal(body: bytes) -> bytes:
    return f"{hashlib.sha256(body).hexdigest()} -->\n".encode()


def write_city(city: City, folder: Path) -> City:
    """Write a city as a folder with its net and city.json. The result is reproducible to the byte.

    Returns the city with the hash of its net. Raises MapError when the folder holds other files.
    """
    known = {NET_NAME, ABOUT_NAME}
    try:
        if (
            folder.exists()
            and not {p.name for p in folder.iterdir() if not p.name.startswith(BUILDING_PREFIX)}
            <= known
        ):
            raise MapError(f"{folder}: is not a city's folder, and not empty: choose a new one")
        net = folder / NET_NAME
        build_city(city, net)
        made = City(
            seed=city.seed, size_m=city.size_m, style=city.style, net_hash=net_content_hash(net)
        )
        about = {
            "city": made,
            "generator": GENERATOR,
            "versions": {name: version(name) for name in MADE_WITH},
        }
        (folder / ABOUT_NAME).write_bytes(
            msgspec.json.format(msgspec.json.encode(about), indent=2) + b"\n"
        )
    except OSError as error:
        raise unwritable(folder, error) from error
    return made


def build_city(city: City, path: Path) -> None:
    """Build a city's net at `path` atomically, so that several processes may build the same
    city. Raises OSError."""

    with temp_folder(BUILDING_PREFIX, path.parent) as folder:
        body = city_as_net(city, folder)
    write_atomic(path, body + SEAL + _seal(body), shared=True)
