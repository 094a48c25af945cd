"""Reference run of netconvert and SUMO on a fixed crossroads, to compare their results between
machines."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from sumo_nets import engine
from sumo_nets.engine import sumo
from sumo_nets.net.netconvert import netconvert
from sumo_nets.net.raw_file import net_content_hash

_SECONDS: Final = 60
_NODES: Final = """<nodes>
<node id="m" x="0" y="0" type="traffic_light"/>
<node id="e" x="120" y="7"/><node id="n" x="-11" y="130"/>
<node id="w" x="-140" y="0"/><node id="s" x="5" y="-125"/>
</nodes>"""
_EDGES: Final = "<edges>{}</edges>".format(
    "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="1" speed="11" sidewalkWidth="2.6"/>'
        for end in "ensw"
        for a, b in ((end, "m"), ("m", end))
    )
)
_DEMAND: Final = "<routes>{}</routes>".format(
    "".join(
        f'<person id="p{i}" depart="{i}"><walk from="{a}m" to="m{b}" '
        f'departPos="{40 + 3 * i}"/></person><trip id="v{i}" depart="{i}" from="{b}m" to="m{a}"/>'
        for i, (a, b) in enumerate(map(tuple, ("en", "ew", "ns", "sw", "we", "se", "nw", "wn")))
    )
)


def reference_hashes() -> dict[str, str]:
    """Return hashes of netconvert's net and of SUMO's traffic on the fixed crossroads.

    No other SUMO may run in this process.
    """
    with tempfile.TemporaryDirectory() as folder:
        parts = {name: Path(folder) / f"c.{name}.xml" for name in ("nod", "edg", "rou", "net")}
        for name, text in (("nod", _NODES), ("edg", _EDGES), ("rou", _DEMAND)):
            parts[name].write_text(text)
        arguments = [
            "-n",
            str(parts["nod"]),
            "-e",
            str(parts["edg"]),
            "--crossings.guess",
            "--no-turnarounds",
        ]
        netconvert(arguments, parts["net"])
        net = net_content_hash(parts["net"])
        seen = hashlib.blake2b(digest_size=8)
        arguments = [
            "-n",
            str(parts["net"]),
            "-r",
            str(parts["rou"]),
            "--step-length",
            "0.5",
            "--no-warnings",
        ]
        engine.start([*arguments, "--seed", "7", "--no-step-log"])
        try:
            reader = engine.NearReader(_WALKERS)
            for _ in range(2 * _SECONDS):
                sumo.simulationStep()
                persons, vehicles = reader.near(0.0, 0.0, 1e3, 1e3)
                for one in (vehicles, persons):
                    seen.update(
                        "".join(one.names).encode() + np.column_stack([one.xy, one.mps]).tobytes()
                    )
        finally:
            engine.close()
    return {"netconvert": net, "SUMO": seen.hexdigest()}


_WALKERS: Final = frozenset(f"p{i}" for i in range(8))
