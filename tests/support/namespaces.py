"""Several machines on one: network namespaces with separate addresses around a router, whose links
can be cut."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_NOBODY = "02:00:00:00:00:99"
"""An address of no network card: packets to it are lost silently."""


class NotPermitted(Exception):
    """This machine has no network namespaces, or does not permit them."""


class Network:
    """Hosts by name, each a namespace with a link to the router's."""

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = list(hosts)
        self._router = f"cosim{os.getpid()}-router"

    def on(self, host: str, *words: str) -> list[str]:
        """Return the command that runs a command on a host."""
        return ["ip", "netns", "exec", self._space(host), *words]

    def address(self, host: str) -> str:
        return f"10.77.{self._hosts.index(host)}.2"

    def cut(self, host: str) -> None:
        """Take a host's link down, which both ends notice."""
        _ip("-n", self._router, "link", "set", self._link(host), "down")

    def lose(self, host: str, *, sent: bool) -> None:
        """Drop silently all packets that a host sends, or all that are sent to it."""
        if sent:
            _ip(
                "-n",
                self._space(host),
                "neigh",
                "replace",
                self._gate(host),
                "lladdr",
                _NOBODY,
                "dev",
                "eth0",
            )
        else:
            link = self._link(host)
            _ip(
                "-n",
                self._router,
                "neigh",
                "replace",
                self.address(host),
                "lladdr",
                _NOBODY,
                "dev",
                link,
            )

    def mend(self, host: str) -> None:
        """Restore a host's link."""
        _ip("-n", self._router, "link", "set", self._link(host), "up")
        for space, neighbour, link in (
            (self._space(host), self._gate(host), "eth0"),
            (self._router, self.address(host), self._link(host)),
        ):
            _ip(
                "-n",
                space,
                "neigh",
                "replace",
                neighbour,
                "lladdr",
                _NOBODY,
                "dev",
                link,
                "nud",
                "stale",
            )
            _ip("-n", space, "neigh", "del", neighbour, "dev", link)

    def build(self) -> None:
        """Make the namespaces. Raises CalledProcessError where this machine does not permit one."""
        _ip("netns", "add", self._router)
        subprocess.run(
            [
                "ip",
                "netns",
                "exec",
                self._router,
                "sh",
                "-c",
                "echo 1 > /proc/sys/net/ipv4/ip_forward",
            ],
            check=True,
        )
        for host in self._hosts:
            space, link = self._space(host), self._link(host)
            _ip("netns", "add", space)
            _ip(
                "-n",
                self._router,
                "link",
                "add",
                link,
                "type",
                "veth",
                "peer",
                "name",
                "eth0",
                "netns",
                space,
            )
            _ip("-n", self._router, "addr", "add", f"{self._gate(host)}/30", "dev", link)
            _ip("-n", space, "addr", "add", f"{self.address(host)}/30", "dev", "eth0")
            for end, of in ((link, self._router), ("eth0", space), ("lo", space)):
                _ip("-n", of, "link", "set", end, "up")
            _ip("-n", space, "route", "add", "default", "via", self._gate(host))

    def remove(self) -> None:
        for space in (*map(self._space, self._hosts), self._router):
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)

    def _space(self, host: str) -> str:
        return f"cosim{os.getpid()}-{host}"

    def _link(self, host: str) -> str:
        return f"to{self._hosts.index(host)}"

    def _gate(self, host: str) -> str:
        return f"10.77.{self._hosts.index(host)}.1"


@contextmanager
def network(*hosts: str) -> Iterator[Network]:
    """Yield hosts that reach each other by `Network.address`. Raises NotPermitted, with the
    reason."""
    if shutil.which("ip") is None:
        raise NotPermitted("network namespaces need `ip`: on Debian, apt-get install iproute2")
    built = Network(hosts)
    try:
        try:
            built.build()
        except subprocess.CalledProcessError as error:
            errors = (error.stderr or b"").decode().strip()
            raise NotPermitted(f"no network namespaces here: {errors}") from error
        yield built
    finally:
        built.remove()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
