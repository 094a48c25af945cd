"""Where the policy of a run is asked."""

from __future__ import annotations

from typing import Literal

import msgspec

from cosim.spec.connection import Connection

PolicyRuns = Literal["in-process", "isolated", "remote", "remote, jpeg"]
"""Where a policy ran: in the simulator's process, which it can reach into; in one of its own on the
same machine; or behind Zenoh, where its pictures may have been sent as JPEG."""


class PolicyHost(msgspec.Struct, frozen=True, kw_only=True):
    """Where the policy of a run is. isolated: in a process of its own. servers: where those of a
    remote one are found; run: signs what they are asked, so that none mistakes one run for another.

    >>> PolicyHost(isolated=True).servers
    ()
    """

    isolated: bool = False
    servers: tuple[Connection, ...] = ()
    run: str = ""

    def seen_by(self, worker: Connection) -> PolicyHost:
        """As a worker on another machine reaches it, who has this connection to the run."""
        return msgspec.structs.replace(
            self, servers=tuple(one.seen_by(worker) for one in self.servers)
        )
