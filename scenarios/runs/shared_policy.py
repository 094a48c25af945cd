"""A policy in the shared renderer, which queries it for all episodes together."""

from __future__ import annotations

from bridge.policy_server import AskAct, AskEnded, AskReset, PackedArray, packed
from cosim.episode.policy_caller import when
from cosim.spec.manifest import Manifest
from cosim.spec.options import RendererAt
from scenarios.ipc.observation_codec import Arrays
from scenarios.ipc.render_link import RendererLink, link_to
from scenarios.runs.hosted_policy import HostedDriver, HostedPolicy


class _RendererCarrier:
    """Carries requests to the renderer, which has the picture already."""

    loses = False

    def __init__(self, address: str) -> None:
        self._address = address
        self._link: RendererLink | None = None

    def lay(self, arrays: Arrays) -> dict[str, PackedArray]:
        link = self._linked()
        return {name: link.laid(name, array) or packed(array) for name, array in arrays.items()}

    def ask(self, question: AskReset | AskAct) -> bytes:
        if isinstance(question, AskAct):
            return self._linked().exchange(question, when("act", question.tick))
        self._link = link_to(self._address)
        return self._link.exchange(question, "reset")

    def tell_ended(self, question: AskEnded) -> None:
        self._linked().tell(question)

    def close(self) -> None:
        """Nothing to release: the connection lasts as long as the process."""

    def _linked(self) -> RendererLink:
        """Return the connection of this episode, which is not replaced when it is lost."""
        assert self._link is not None, "reset comes first"
        return self._link


def shared_driver(
    manifest: Manifest, source_hash: str, renderer: RendererAt, run: str
) -> HostedDriver:
    """Return the driver of the policy in a shared renderer, whose deadlines the run enforces
    there."""
    policy = HostedPolicy(manifest, _RendererCarrier(renderer.address), run)
    return HostedDriver(policy, "in-process", source_hash)
