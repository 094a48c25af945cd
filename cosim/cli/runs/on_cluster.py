"""What `cosim run --on` does in place of starting processes on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

from cosim.cli.terminal.consoles import err
from cosim.core.errors import UsageError

if TYPE_CHECKING:
    from cosim.records.run_folder import RunFolder
    from cosim.spec.scenario import Scenario
    from scenarios.execution.asked import Patience
    from scenarios.execution.messages import Hear, Hello
    from scenarios.execution.transport import Transport

_ALONE = ("shared_renderer", "real_time", "live", "rerun")


def carried_by_ray(on: str, jobs: int | None, asked: Mapping[str, Any]) -> Callable[..., AbstractContextManager[Any]]:
    """The carrier of a run by a Ray cluster. Raises UsageError without Ray, and for options of local processes."""
    from scenarios.many.on_ray import RayWorkers, check_ray, ray_cluster

    check_ray(on)
    for name in _ALONE:
        if asked[name]:
            raise UsageError(f"--{name.replace('_', '-')} is of processes of this machine: leave it, or --on, out")

    @contextmanager
    def carried(
        held: RunFolder, todo: Sequence[Scenario], picked: Sequence[Scenario], hello: Hello, patience: Patience,
        tell: Hear,
    ) -> Iterator[tuple[Transport, Hear]]:  # fmt: skip
        with ray_cluster(on, hello.policy, _say):
            workers = RayWorkers(held.spec, held.path / "logs", jobs, len(todo), _say)
            _say(f"{workers.wanted} workers on Ray")
            yield workers, tell

    return carried


def _say(words: str) -> None:
    err.print(words, soft_wrap=True, highlight=False, markup=False)
