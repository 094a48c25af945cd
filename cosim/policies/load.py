"""Load a policy by name.

A name is bundled, `path/to/file.py:Class`, `package.module:Class`, `onnx:FOLDER`,
`schedule:NAME` or `schedule:FILE.json`.
"""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Protocol, cast

import msgspec

from bridge.policy_server import PolicyFault, policy_call
from cosim.core.clock import Clock
from cosim.core.errors import SpecError, UsageError, unknown
from cosim.episode.interfaces import Policy
from cosim.episode.manifest_checks import fault_of_values, with_goal
from cosim.episode.policy_caller import LOAD_TIMEOUT_S, PolicyCaller, Timer
from cosim.policies import POLICIES
from cosim.policies.onnx.manifest import MANIFEST_FILE, read_bundle_manifest
from cosim.policies.onnx.weights import weights_file
from cosim.policies.published import NETWORK_POLICIES
from cosim.policies.schedule.policy import schedule_policy
from cosim.policies.user_module import (
    importable_name,
    policy_class,
    policy_module,
    remedy_for_missing,
)
from cosim.spec.manifest import Manifest
from cosim.spec.ros2 import ROS2_SCHEME


def shipped_bundles(below: Path = Path(__file__).parent) -> Mapping[str, Path]:
    """Return folders of the bundled ONNX bundles by name: `cosim/policies/*/NAME/manifest.json`."""
    return {
        manifest.parent.name: manifest.parent
        for manifest in sorted(below.glob(f"*/*/{MANIFEST_FILE}"))
    }


def bundle_in_words(folder: Path) -> str:
    """Describe a bundle in one line: location of its weights, or "missing", and origin."""
    bundle = read_bundle_manifest(folder)
    facts = bundle.files.get(bundle.model)
    try:
        user = f"policy '{bundle.name}'"
        found = f"weights {weights_file(user, bundle.model, facts, bundle.source, [folder])}"
    except UsageError:
        found = f"weights missing ({bundle.model})"
    origin = bundle.source.partition(",")[0].partition(";")[0]
    return f"ONNX bundle, {found}" + (f"; from {origin}" if origin else "")


_BUNDLED = "cosim.policies."
"""Start of the names of modules of bundled policies."""
LONGEST_NAME = 100
"""Largest number of characters in a policy's name or version."""
FOLLOW = "follow"
"""Name of the policy in `cosim.policies.follow`; the weights of its networks are not included."""
ONNX_SCHEME = "onnx:"
"""Prefix of the folder of an ONNX bundle (`cosim.policies.onnx`)."""
REMOTE_SCHEME = "zenoh:"
"""Prefix of a policy served by `cosim serve` or `bridge/policy_server.py`."""

SCHEDULE_SCHEME = "schedule:"
"""Prefix of an open-loop schedule, bundled or in a file (`cosim.policies.schedule`)."""

OTHER_NAMES = (
    "path/to/file.py:Class",
    "package.module:Class",
    f"{ONNX_SCHEME}FOLDER",
    f"{SCHEDULE_SCHEME}FILE.json",
    f"{REMOTE_SCHEME}NAME",
    ROS2_SCHEME,
)
"""Forms of policy names that are not listed."""


def load_policy(
    name: str, timer: Timer | None = None, start_s: float = LOAD_TIMEOUT_S
) -> PolicyCaller:
    """Load a new policy and read its manifest.

    timer: Records the pending call while the policy loads and answers, to enforce timeouts.
    start_s: Timeout in seconds for an ONNX graph to load and answer once, used without a timer.
    Raises UsageError if the name is unknown or the class is not a policy.

    >>> load_policy("route").manifest.name
    'route'
    """
    name = importable_name(name)
    within_s = start_s if timer is None else None
    if name.startswith(ONNX_SCHEME):
        return _by_digest(
            name, _bundle(Path(name.removeprefix(ONNX_SCHEME)).expanduser(), within_s), timer
        )
    if name.startswith(SCHEDULE_SCHEME):
        return _by_digest(name, lambda: schedule_policy(name.removeprefix(SCHEDULE_SCHEME)), timer)
    if name.startswith((REMOTE_SCHEME, ROS2_SCHEME)):
        raise UsageError(
            f"policy '{name}' is served elsewhere; here it must be one that this process can load"
        )
    if ":" not in name:
        if name in POLICIES:
            policy = POLICIES[name]()
            return PolicyCaller(policy, source_hash=source_hash(policy), timer=timer)
        bundles = shipped_bundles()
        if name in bundles:
            return _by_digest(name, _bundle(bundles[name], within_s), timer)
        if name in WEIGHTED_POLICIES:
            return _by_digest(name, WEIGHTED_POLICIES[name], timer)
        raise unknown("policy", name, [*POLICIES, *bundles, *WEIGHTED_POLICIES, *OTHER_NAMES])
    home = Path.cwd()
    with policy_call("loading", timer=timer, passes=(BaseException,)):
        try:
            policy = _made(name)
            manifest = _checked(name, policy)
        finally:
            os.chdir(home)  # the user's code may have gone elsewhere
    return PolicyCaller(policy, manifest, source_hash(policy), timer)


class _Digested(Policy, Protocol):
    """Policy that reads files.

    digest: Hash of the files and everything else that determines its commands.
    """

    digest: str


def _bundle(folder: Path, within_s: float | None) -> Callable[[], _Digested]:
    """Return a function that loads the policy of an ONNX bundle.

    within_s: see `OnnxPolicy`.
    """

    def make() -> _Digested:
        from cosim.policies.onnx.policy import onnx_policy  # onnxruntime takes a moment to import

        return onnx_policy(folder, within_s)

    return make


def _follow() -> _Digested:
    from cosim.policies.follow.policy import Follow

    return Follow()


WEIGHTED_POLICIES: Mapping[str, Callable[[], _Digested]] = MappingProxyType(
    {FOLLOW: _follow, **NETWORK_POLICIES}
)
"""Constructors of the bundled Python policies that read weights, by name."""


def _by_digest(name: str, make: Callable[[], _Digested], timer: Timer | None) -> PolicyCaller:
    """Load a policy that reads files. Raises UsageError if one is missing or invalid."""
    try:
        with policy_call("loading", timer=timer, passes=(BaseException,)):
            policy = make()
            manifest = checked_manifest(name, msgspec.to_builtins(policy.manifest))
    except (UsageError, SpecError) as error:
        said = str(error).removeprefix(f"policy '{name}': ")
        raise UsageError(f"policy '{name}': {said}") from error
    digest = hashlib.blake2b(f"{source_hash(policy)}{policy.digest}".encode(), digest_size=8)
    return PolicyCaller(policy, manifest, digest.hexdigest(), timer)


def source_hash(policy: Policy) -> str:
    """Return a hash of the files that define the policy's class and base classes; "" if unreadable.

    Of a bundled class, all modules in its folder are included. Other imported modules and weight
    files are not; the manifest's version identifies those.
    """
    digest = hashlib.blake2b(digest_size=8)
    read = False
    for one in type(policy).__mro__:
        try:
            file = Path(inspect.getfile(one))
            folder = file.parent.glob("*.py") if one.__module__.startswith(_BUNDLED) else ()
            sources = [(path.name, path.read_bytes()) for path in (file, *sorted(folder))]
        except (OSError, TypeError):  # built in, or made without a file
            continue
        for name, source in sources:
            digest.update(f"{one.__module__}\0{name}\0{len(source)}\0".encode() + source)
        read = True
    return digest.hexdigest() if read else ""


def _made(name: str) -> Policy:
    """Import and construct `package.module:Class`."""
    try:
        with _in_words(f"policy '{name}': module '{name.partition(':')[0]}' cannot be imported:"):
            module, class_name = policy_module(name)
    except UsageError as error:
        if not isinstance(error.__cause__, ModuleNotFoundError):
            raise
        raise UsageError(
            f"{error}. {remedy_for_missing(name, error.__cause__.name or '')}"
        ) from error
    if getattr(module, "__file__", None) is None:  # a folder without __init__.py, such as a run's
        words = f"'{module.__name__}' is a folder without code here"
        raise UsageError(f"policy '{name}': {words}. {remedy_for_missing(name, module.__name__)}")
    make = policy_class(module, class_name)
    with _in_words(f"policy '{name}' cannot be made:"):
        return cast(Policy, make())


def _checked(name: str, policy: Policy) -> Manifest:
    """Return a checked copy of the policy's manifest.

    Raises UsageError if the manifest or a method is missing.
    """
    with _in_words(f"policy '{name}': its manifest:"):
        manifest = getattr(policy, "manifest", None)
        lacking = [
            method for method in ("reset", "act") if not callable(getattr(policy, method, None))
        ]
    if not isinstance(manifest, Manifest):
        raise UsageError(
            f"policy '{name}' has no attribute 'manifest' that is a cosim.spec.manifest.Manifest"
        )
    if lacking:
        raise UsageError(
            f"policy '{name}' has no method '{lacking[0]}'; see cosim.episode.interfaces.Policy"
        )
    try:
        with_goal(manifest, None)
        fields = msgspec.to_builtins(manifest)
    except (UsageError, TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"policy '{name}': its manifest: {error}") from error
    return checked_manifest(name, fields)


def checked_manifest(name: str, fields: object) -> Manifest:
    """Convert a manifest from another process and validate it. Raises UsageError with the fault.

    fields: The manifest as builtins.
    """
    try:
        manifest = msgspec.convert(fields, Manifest)
        _refuse_unknown_fields(fields, msgspec.to_builtins(manifest))
        with_goal(manifest, None)
        Clock.for_rate(manifest.rate_hz)
        wrong = _wrong(manifest)
    except (
        msgspec.ValidationError,
        SpecError,
        UsageError,
        TypeError,
        ValueError,
        OverflowError,
    ) as error:
        raise UsageError(f"policy '{name}': its manifest: {error}") from error
    if wrong:
        raise UsageError(f"policy '{name}': its manifest's {wrong}")
    return manifest


def _refuse_unknown_fields(fields: object, known: object, place: str = "") -> None:
    """Raise UsageError for an unknown field of a manifest or of its cameras."""
    if not (isinstance(fields, dict) and isinstance(known, dict)):
        return
    for name in fields:
        if name not in known:
            raise unknown(f"field{f' of {place}' if place else ''}", str(name), known)
        _refuse_unknown_fields(fields[name], known[name], f"{place}.{name}" if place else str(name))


def _wrong(manifest: Manifest) -> str:
    """Return the first fault in a manifest's values; "" if valid."""
    for field, text in (("name", manifest.name), ("version", manifest.version)):
        if (
            not 0 < len(text) <= LONGEST_NAME
            or not text.isprintable()
            or "/" in text
            or text.startswith(".")
        ):
            return (
                f"{field} must be a text of 1 to {LONGEST_NAME} printable characters, without "
                f"'/', not {text!r:.80}"
            )
    return fault_of_values(manifest)


@contextmanager
def _in_words(what: str) -> Iterator[None]:
    """Convert exceptions of the user's code, including SystemExit, to UsageError; Ctrl-C passes."""
    try:
        with policy_call("loading"):
            yield
    except PolicyFault as fault:
        raise UsageError(f"{what} {fault.words.removeprefix('raised ')}") from fault.__cause__
