"""Live access to a running episode over Zenoh (`cosim run --live`): injections and telemetry."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from bridge import keys
from bridge.live import serve_injections
from bridge.session import open_session
from cosim.core.clock import Clock
from cosim.core.state import Age, PersonKind
from cosim.episode.loop import Step
from cosim.results.referee import Verdict
from cosim.spec.injection import LiveAddress
from cosim.spec.scenario import Scenario
from scenarios.episodes.injected import InjectedPeople, RobotOnRoute


class LiveEpisode:
    """Publisher of an episode's telemetry, and server of injections, status, log and camera.

    Use it in a `with` block.
    """

    def __init__(self, live: LiveAddress, scenario: Scenario, injected: InjectedPeople) -> None:
        self._live = live
        self._scenario = scenario
        self._injected = injected
        self._prefix = keys.env(live.run, keys.chunk(scenario.id))
        self._step: Step | None = None
        self._happened: list[tuple[int, str]] = []
        self._acting: set[str] = set()
        self._rgb: NDArray[np.uint8] | None = None

    def __enter__(self) -> Self:
        self._session = open_session(self._live.connection)
        serve_injections(self._session, f"{self._prefix}/inject", self._injected.offer)
        self._session.serve(f"{self._prefix}/status", lambda _: self._status(), found=True)
        self._session.serve(f"{self._prefix}/log", lambda _: self._log())
        self._session.serve(f"{self._prefix}/camera", lambda _: self._camera())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._session.close()

    def publish(self, step: Step, verdict: Verdict) -> None:
        """Publish the telemetry of a tick."""
        self._step = step
        pose = step.motion.robot.pose
        route_s_m = step.route_s_after_m
        if verdict.reset is not None:
            pose, route_s_m = verdict.reset.pose, verdict.reset.route_s_m
        self._injected.set_robot(RobotOnRoute(step.tick + 1, pose, route_s_m))
        if step.frame is not None:
            self._rgb = step.frame.rgb
        topics = _telemetry(step)
        if news := self._news(step, verdict):
            topics["events"] = news
        for topic, content in topics.items():
            self._session.publish_lossy(f"{self._prefix}/{topic}", msgspec.json.encode(content))

    def _news(self, step: Step, verdict: Verdict) -> list[str]:
        """Return the failures, begun events and the end of a tick in words, and log them."""
        news = [f"{failure.kind} {failure.other}".strip() for failure in verdict.failures]
        news += [f"{contact.suffered} by {contact.other}" for contact in verdict.walked_into]
        for event, state in zip(self._scenario.events, step.events.states, strict=True):
            if state.phase == "acting" and event.id not in self._acting:
                self._acting.add(event.id)
                news.append(f"event {event.id} {event.kind}")
        if verdict.ended is not None:
            news.append(f"ended: {verdict.ended}")
        self._happened += [(step.tick, words) for words in news]
        return news

    def _status(self) -> bytes:
        tick = -1 if self._step is None else self._step.tick
        return msgspec.json.encode(
            {"scenario": self._scenario.id, "tick": tick, "time_s": Clock().time_s(max(tick, 0))}
        )

    def _log(self) -> bytes:
        """Return the tick, the injections, and the events and failures with their ticks, as
        JSON."""
        tick = -1 if self._step is None else self._step.tick
        return msgspec.json.encode(
            {"tick": tick, "injections": self._injected.log, "happened": self._happened}
        )

    def _camera(self) -> bytes:
        """Return the last picture of the policy as PNG. Raises LookupError before the first one."""
        if self._rgb is None:
            raise LookupError("the policy has had no picture yet")
        done, data = cv2.imencode(".png", self._rgb[..., ::-1])
        assert done
        return bytes(data)


def _telemetry(step: Step) -> dict[str, object]:
    """Return the contents of the topics of a tick, as JSON values."""
    street = step.street_after
    robot = step.motion.robot
    x_m, y_m, heading_rad = robot.pose
    crowd = [
        {
            "id": name,
            "x_m": x,
            "y_m": y,
            "heading_rad": heading,
            "speed_mps": speed,
            "doing": doing,
            "kind": PersonKind(kind).name.lower(),
            "age": Age(age).name.lower(),
        }
        for name, (x, y), heading, speed, doing, kind, age in zip(
            street.people.ids,
            street.people.xy.tolist(),
            street.people.heading.tolist(),
            street.people.speed.tolist(),
            street.people.doing,
            street.people.kind.tolist(),
            street.people.age.tolist(),
            strict=True,
        )
    ]
    return {
        "clock": {"tick": step.tick, "time_s": Clock().time_s(step.tick)},
        "robot": {
            "x_m": x_m,
            "y_m": y_m,
            "heading_rad": heading_rad,
            "v_mps": robot.v_mps,
            "w_radps": robot.w_radps,
            "z_m": robot.z_m,
            "route_s_m": step.route_s_after_m,
        },
        "crowd": crowd,
        "signals": {name: signal.walk for name, signal in street.signals.items()},
    }
