"""Manifest of an ONNX bundle, `manifest.json`: inputs and output of the graph, and its origin.

{"format": 1, "name": "mine", "rate_hz": 5, "goal": "route_point", "camera": {"width": 160,
 "height": 90}, "inputs": {"pictures": {"what": "picture", "frames": 4, "size": [160, 90], "layout":
 "N(TC)HW"}, "goal": {"what": "goal_point", "unit_m": 10}},
 "output": {"what": "waypoints", "name": "waypoints", "index": 2, "dt_s": 0.6}}
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec

from cosim.core.errors import SpecError
from cosim.policies.onnx.inputs import (
    GraphInput,
    ImuInput,
    JoinedInput,
    PastPositionsInput,
    PeopleInput,
    PictureInput,
    ScanInput,
    common_goals,
)
from cosim.policies.onnx.outputs import GraphOutput, WaypointsOutput
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import GoalProtocol
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.odometry import OdometryKind
from cosim.spec.sensors import ImuKind, PeopleKind, ScanSpec
from cosim.spec.spec_file import read_spec_file
from cosim.spec.validation import PathName, Ranged, Text, Within, shown

MANIFEST_FILE: Final = "manifest.json"
EXAMPLE_FILE: Final = "example.npz"
"""File with an array of each input's name, and `expected.<name>` of each output."""
MAX_EXAMPLE_BYTES: Final = 512 << 20
"""Largest size of an example in bytes, packed and unpacked."""

_MAX_NAME_BYTES: Final = 255
"""Longest file name in bytes."""
_HASH: Final = re.compile(r"[0-9a-f]{64}")


def file_name_fault(name: str) -> str:
    """Return the fault of a file name in a bundle's folder; "" if valid.

    >>> file_name_fault("model.onnx.data"), file_name_fault("../model.onnx")[:17]
    ('', "'../model.onnx' i")
    """
    if (
        name.isprintable()
        and name not in ("", ".", "..")
        and "/" not in name
        and len(name.encode()) <= _MAX_NAME_BYTES
    ):
        return ""
    return (
        f"{shown(name)} is no name of a file in the bundle's folder: use a name without '/', "
        f"such as model.onnx.data"
    )


_HASHES: Final = {"blake2b": "BLAKE2b", "sha256": "SHA-256"}
"""Hashes of `FileFacts` in words."""


class FileFacts(Ranged, frozen=True, kw_only=True):
    """Size of a file and hexadecimal hashes: BLAKE2b of 32 bytes, SHA-256, or both."""

    bytes: Annotated[int, Within(0, 10**12)]
    blake2b: str = ""
    sha256: str = ""

    def contradictions(self) -> Iterator[str]:
        for name, digits in self.hashes.items():
            if digits and not _HASH.fullmatch(digits):
                yield f"{name} must be 64 hexadecimal digits, not {digits[:80]!r}"
        if not any(self.hashes.values()):
            yield "blake2b or sha256 must be given"

    @property
    def hashes(self) -> dict[str, str]:
        """Hashes by name; "" for a missing one."""
        return {"blake2b": self.blake2b, "sha256": self.sha256}

    def differences(self, found: FileFacts) -> list[str]:
        """Return which of size and hashes given here differ from those found, in words."""
        size = [] if self.bytes == found.bytes else ["size"]
        return size + [
            _HASHES[name]
            for name, digits in self.hashes.items()
            if digits not in ("", found.hashes[name])
        ]

    @property
    def in_words(self) -> str:
        """Size and hashes as text for error messages."""
        known = (f"{_HASHES[name]} {digits}" for name, digits in self.hashes.items() if digits)
        return ", ".join([f"{self.bytes} bytes", *known])


def file_facts(data: bytes) -> FileFacts:
    """Return size and hashes of data.

    >>> file_facts(b"graph").bytes
    5
    """
    blake2b = hashlib.blake2b(data, digest_size=32).hexdigest()
    return FileFacts(bytes=len(data), blake2b=blake2b, sha256=hashlib.sha256(data).hexdigest())


class BundleCamera(Ranged, frozen=True, kw_only=True):
    """Camera as in `cosim.spec.camera.CameraSpec`, at one of the robot's mounts."""

    width: Annotated[int, Within(1, 4096)]
    height: Annotated[int, Within(1, 4096)]
    fov_deg: Annotated[float, Within(0, 180, above=True)] = 75.0
    mount: Annotated[str, PathName("a mount")] = "front"
    crop: tuple[int, int, int, int] | None = None

    def contradictions(self) -> Iterator[str]:
        try:
            _ = self.spec
        except SpecError as error:
            yield str(error)

    @property
    def spec(self) -> CameraSpec:
        return CameraSpec(self.width, self.height, self.fov_deg, self.mount, crop=self.crop)


class BundleManifest(Ranged, frozen=True, kw_only=True):
    """Manifest of a bundle.

    inputs: By the names of the graph's inputs.
    model: File name of the graph in the bundle's folder or a folder of weights
        (`cosim.policies.onnx.weights`).
    files: Size and hashes of the graph and other files.
    licence, source: Licence and origin of the weights as text.
    """

    format: Literal[1]
    name: Annotated[str, PathName("a policy")]
    version: Annotated[str, PathName("a version")] = "1"
    licence: Annotated[str, Text(400)] = ""
    source: Annotated[str, Text(400)] = ""
    model: Annotated[str, PathName("a file")] = "model.onnx"
    files: dict[str, FileFacts] = msgspec.field(default_factory=dict)
    rate_hz: Annotated[float, Within(0, 20, above=True)] = 4.0
    goal: GoalProtocol = "none"
    odometry: OdometryKind = "none"
    scan: ScanSpec | None = None
    imu: ImuKind = "none"
    people: PeopleKind = "none"
    camera: BundleCamera | None = None
    cameras: dict[str, BundleCamera] = msgspec.field(default_factory=dict)
    inputs: dict[str, GraphInput]
    output: GraphOutput

    @property
    def prefix(self) -> str:
        return ""

    @property
    def goals(self) -> tuple[GoalProtocol, ...]:
        """Goals that all inputs can use; () if they need none."""
        return common_goals(self.inputs.values())

    @property
    def policy(self) -> Manifest:
        """Manifest of the policy in a run."""
        waypoints = (
            self.output.waypoint_rule
            if isinstance(self.output, WaypointsOutput)
            else WaypointRule()
        )
        return Manifest(
            name=self.name,
            version=self.version,
            rate_hz=self.rate_hz,
            camera=None if self.camera is None else self.camera.spec,
            waypoints=waypoints,
            goal=self.goal,
            odometry=self.odometry,
            scan=self.scan,
            imu=self.imu,
            people=self.people,
            cameras={name: one.spec for name, one in self.cameras.items()},
            goals=self.goals,
        )

    def contradictions(self) -> Iterator[str]:
        yield from (f"files: {refusal}" for refusal in map(file_name_fault, self.files) if refusal)
        needs = {name: one.needs for name, one in self.inputs.items() if one.needs}
        if needs and not self.goals:
            yield (
                f"inputs {', '.join(needs)} need goals that no run can give at once: give one of "
                f"them `missing`"
            )
        elif self.goals and self.goal not in self.goals:
            yield (
                f"goal must be one of {', '.join(self.goals)}, of which the inputs are made, not "
                f"{self.goal!r}"
            )
        for name, one in self.inputs.items():
            if isinstance(one, PictureInput):
                cameras: Mapping[str, BundleCamera | None] = {"": self.camera, **self.cameras}
                if cameras.get(one.camera) is None:
                    which = (
                        f"cameras has no {one.camera!r}"
                        if one.camera
                        else "camera is null or missing"
                    )
                    yield f"inputs.{name} is a picture, and {which}"
            parts = one.parts if isinstance(one, JoinedInput) else (one,)
            yield from (self._sensor_fault(name, part) for part in parts)
            if self.odometry in ("none", "gps") and any(
                isinstance(part, PastPositionsInput) for part in parts
            ):
                yield (
                    f"inputs.{name} holds past positions, and odometry is {self.odometry!r}: say "
                    f"exact or wheel"
                )

    def _sensor_fault(self, name: str, one: object) -> str:
        """Return why an input cannot be made of the sensors; "" if it can."""
        if isinstance(one, ScanInput):
            if self.scan is None:
                return f"inputs.{name} is a scan, and scan is null or missing: say which lidar"
            if one.sectors and self.scan.rays % one.sectors:
                return (
                    f"inputs.{name} has {one.sectors} sectors, which do not divide the "
                    f"{self.scan.rays} rays of the scan"
                )
        if isinstance(one, ImuInput) and self.imu == "none":
            return f"inputs.{name} is of an inertial sensor, and imu is 'none': say exact or noisy"
        if isinstance(one, PeopleInput) and self.people == "none":
            return f"inputs.{name} is of tracked people, and people is 'none': say seen"
        return ""


def read_bundle_manifest(folder: Path) -> BundleManifest:
    """Read the manifest of a bundle's folder.

    Raises SpecError with every fault and the valid choices.
    """
    return read_spec_file(folder / MANIFEST_FILE, BundleManifest)
