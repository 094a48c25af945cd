"""Street nets of generated cities: built once by netconvert, kept in a cache folder, found again by name."""

from __future__ import annotations

import hashlib
import tempfile
from importlib.metadata import version
from pathlib import Path

import msgspec

from cosim.core.cache import cache_folder, make_room, use_entry
from cosim.core.errors import MapError, unwritable
from cosim.spec.scenario import City
from sumo_nets.net.net_hash import net_content_hash

GENERATOR = 4
"""Version of the generator: another one for every change that changes a net."""
NET_NAME = "city.net.xml"
ABOUT_NAME = "city.json"
MADE_WITH = ("sidewalk-cosim", "eclipse-sumo", "numpy")
"""Packages that a net depends on."""
SEAL = b"<!-- sha256 "


def city_net(city: City) -> Path:
    """The city's street net, built when the cache has none, or a damaged one.

    Raises MapError when `city.net_hash` is set and the net is another one.
    """
    path = cache_folder() / f"{city.name}-g{GENERATOR}.net.xml"
    use_entry(path)
    if not is_whole(path):
        try:
            make_room()
            build_city(city, path)
        except OSError as error:
            raise unwritable(path, error, "set COSIM_CACHE to another folder") from error
    if city.net_hash and (found := net_content_hash(path)) != city.net_hash:
        raise MapError(
            f"{path}: the net's hash is {found}, but the scenario was made on {city.net_hash}: "
            "delete the file to build it again; if the hash stays, the scenario is of another version of the "
            "generator or of SUMO: make the suite anew, or install the version it was made with"
        )
    return path


def is_whole(path: Path) -> bool:
    """Whether a net that was built here is still what was written: its last line holds the hash of all the others."""
    try:
        body, _, seal = path.read_bytes().rpartition(SEAL)
    except OSError:
        return False
    return bool(body) and seal == _seal(body)


def _seal(body: bytes) -> bytes:
    return f"{hashlib.sha256(body).hexdigest()} -->\n".encode()


def write_city(city: City, folder: Path) -> City:
    """Write a city as a folder: its net, and city.json with what it was made from. Equal to the byte when made again.

    Returns the city with the hash of its net. Raises MapError when the folder holds something else already.
    """
    known = {NET_NAME, ABOUT_NAME}
    try:
        if folder.exists() and not {p.name for p in folder.iterdir() if not p.name.startswith(".building-")} <= known:
            raise MapError(f"{folder}: is not a city's folder, and not empty: choose a new one")
        net = folder / NET_NAME
        build_city(city, net)
        made = City(seed=city.seed, size_m=city.size_m, style=city.style, net_hash=net_content_hash(net))
        about = {"city": made, "generator": GENERATOR, "versions": {name: version(name) for name in MADE_WITH}}
        (folder / ABOUT_NAME).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=2) + b"\n")
    except OSError as error:
        raise unwritable(folder, error) from error
    return made


def build_city(city: City, path: Path) -> None:
    """Build a city's net at `path`, in one move: several processes may build the same city at once. OSError passes."""
    from sumo_nets.city.built_net import city_as_net  # with all that plans a city: most were built before

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".building-", dir=path.parent) as folder:
        body = city_as_net(city, Path(folder))
        finished = Path(folder) / path.name
        finished.write_bytes(body + SEAL + _seal(body))
        finished.replace(path)
