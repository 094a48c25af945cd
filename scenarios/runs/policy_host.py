"""Callers of a run's policy: in this process, in an isolated one, behind Zenoh, as a ROS 2 node, or
in the shared renderer."""

from __future__ import annotations

from pathlib import Path
from secrets import token_hex

import msgspec

from bridge.policy_server import ActRequest, EndRequest, PackedArray, ResetRequest, pack_array
from cosim.core.errors import UsageError
from cosim.episode.policy_caller import LOAD_TIMEOUT_S, PolicyCaller, Timer, call_in_words
from cosim.policies.load import REMOTE_SCHEME, load_policy
from cosim.policies.user_module import importable_name
from cosim.spec.connection import Connection
from cosim.spec.manifest import Manifest
from cosim.spec.options import PolicyHost, RendererAddress
from cosim.spec.ros2 import ROS2_SCHEME
from cosim.spec.run_config import RunConfig
from scenarios.ipc.observation_codec import Arrays
from scenarios.ipc.render_link import RendererLink, link_to
from scenarios.runs.hosted_policy import HostedCaller, HostedPolicy
from scenarios.runs.isolated_policy import isolated_caller, isolation_of


def policy_caller(
    name: str,
    host: PolicyHost,
    timer: Timer | None = None,
    expected: Manifest | None = None,
    start_s: float = LOAD_TIMEOUT_S,
) -> PolicyCaller:
    """Load a policy by its name.

    expected: its manifest in the run; None if only its manifest is needed.
    start_s: timeout of loading in seconds, used without a timer.
    Raises UsageError.

    >>> policy_caller("route", PolicyHost()).manifest.name
    'route'
    """
    name = importable_name(name)
    if name.startswith(REMOTE_SCHEME):
        # Imported only where needed: it loads Zenoh and OpenCV.
        from scenarios.runs.remote_policy import remote_caller

        if host.isolated != "no":
            raise UsageError(f"policy '{name}' is elsewhere anyway: leave --isolated out")
        return remote_caller(name, host, timer)
    if name.startswith(ROS2_SCHEME):
        from scenarios.runs.ros2_policy import ros2_caller

        if host.isolated != "no":
            raise UsageError(f"policy '{name}' is elsewhere anyway: leave --isolated out")
        return ros2_caller(name, host, timer)
    if host.servers:
        raise UsageError(f"--policy-at goes with --policy {REMOTE_SCHEME}NAME, not with '{name}'")
    if host.isolated != "no":
        return isolated_caller(name, timer, expected, host, start_s)
    return load_policy(name, timer, start_s)


def host_of(config: RunConfig, servers: tuple[Connection, ...] = ()) -> PolicyHost:
    """Return where the policy of a run or check is queried. servers: of a remote policy."""
    return PolicyHost(
        isolated=config.isolated,
        data=tuple(str(Path(path).absolute()) for path in config.policy_data),
        memory_gb=config.policy_memory,
        hidden=() if config.out is None else (str(config.out.absolute()),),
        servers=servers,
        ros2=config.ros2,
        run=token_hex(8),
    )


def settled_host(host: PolicyHost, caller: PolicyCaller) -> PolicyHost:
    """Return a host with the kind of sandbox that a policy has, which every process of its run then
    uses."""
    kind = isolation_of(caller.runs)
    return host if kind is None else msgspec.structs.replace(host, isolated=kind)


def inspected_caller(
    name: str, host: PolicyHost, jobs: int = 1, start_s: float = LOAD_TIMEOUT_S
) -> PolicyCaller:
    """Load a policy to inspect it before a run; connections and processes of its own are closed.

    Raises UsageError if its servers answer for fewer episodes at a time than there are jobs.
    """
    caller = policy_caller(name, host, start_s=start_s)
    caller.close()
    if 0 < caller.at_once < jobs:
        raise UsageError(
            f"policy '{name}' answers for {caller.at_once} episodes at a time, and there are "
            f"{jobs} jobs: serve its class in place of an object, more servers, or take fewer jobs"
        )
    return caller


class _RendererCarrier:
    """Carrier of requests to the shared renderer, which has the picture already."""

    can_lose_episodes = False

    def __init__(self, address: str) -> None:
        self._address = address
        self._link: RendererLink | None = None

    def pack(self, arrays: Arrays) -> dict[str, PackedArray]:
        link = self._linked()
        return {
            name: link.location_of(name, array) or pack_array(array)
            for name, array in arrays.items()
        }

    def exchange(self, request: ResetRequest | ActRequest) -> bytes:
        if isinstance(request, ActRequest):
            return self._linked().exchange(request, call_in_words("act", request.tick))
        self._link = link_to(self._address)
        return self._link.exchange(request, "reset")

    def report_ended(self, request: EndRequest) -> None:
        self._linked().send(request)

    def close(self) -> None:
        """Nothing to release: the connection lasts as long as the process."""

    def _linked(self) -> RendererLink:
        """Return the connection of this episode, which is not replaced when it is lost."""
        assert self._link is not None, "reset comes first"
        return self._link


def shared_caller(
    manifest: Manifest, source_hash: str, renderer: RendererAddress, run: str
) -> HostedCaller:
    """Return the caller of a policy in the shared renderer, where the run enforces its timeouts."""
    policy = HostedPolicy(manifest, _RendererCarrier(renderer.address), run)
    return HostedCaller(policy, "in-process", source_hash)
