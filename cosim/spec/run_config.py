"""RunConfig: the settings of a run, from which the options of `cosim run` are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

from cosim.core.errors import UsageError, unknown
from cosim.spec.connection import Connection, checked_endpoint, connecting, listening
from cosim.spec.ros2 import (
    LARGEST_DOMAIN,
    ROS2_LISTEN,
    ROS2_SCHEME,
    Ros2Clock,
    Ros2Dialect,
    Ros2Distro,
    Ros2Imu,
    Ros2Odometry,
    Ros2Settings,
    Ros2Wait,
)
from cosim.spec.weather import WEATHERS

CameraChoice = Literal["auto", "gl", "bullet", "bullet-egl"]
"""Renderers of `--camera`; auto selects gl where it works."""
Appearance = Literal["splats", "mesh"]
"""Appearances of scanned places in the gl camera; splats are drawn where a scan has them."""
DataFormat = Literal["lerobot", "rosbag2", "raw"]
"""Forms of a data set of `cosim collect`; "raw" is only what `cosim dataset pack` reads."""
Isolation = Literal["no", "auto", "namespaces", "landlock", "weak"]
"""Kinds of `--isolated`: "auto" is the strongest sandbox that the kernel offers, "weak" none."""
POLICY_MEMORY_GB = 16.0
"""Default limit of the memory of a process of an isolated policy, in GB."""
MEASURED = "measured"
"""Value of `--latency` that measures the latency before the run."""
MAX_LATENCY_MS = 10_000.0
"""Maximum latency of a command in milliseconds."""
LONGEST_WAIT_S = 240.0
"""Maximum timeout of a director in seconds; processes that are silent for much longer count as
hanging."""


class Option(NamedTuple):
    """Command-line option of a config's field.

    flag: name of the option, "" for the field's name.
    least, most: range of a number.
    default: description of the default, if the value is not enough.
    argument: whether it is a positional argument.
    bare: value of the option without one; another value then needs "=".
    panel: heading of its group in the help.
    """

    help: str
    flag: str = ""
    metavar: str | None = None
    least: float | None = None
    most: float | None = None
    default: str = ""
    argument: bool = False
    bare: str = ""
    panel: str = ""


_CHOICE = "Scenarios"
_STREET = "Place and people"
_POLICY = "Policy"
_PICTURES = "Pictures"
_WHERE = "Processes and machines"
_FOLDER = "Run folder"
_NETWORK = "Network"
_ROS2 = "ROS 2"
_LOG = "Log"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Settings of a run: scenarios, policy, conditions, processes and outputs.

    Raises UsageError for contradictory values.

    >>> RunConfig(suite="reactive", policy="orca", event=("frontal",), latency="200").latency_ms
    200.0
    """

    suite: Annotated[
        str,
        Option("A suite (see `cosim list`) or the path of a suite's .json file.", argument=True),
    ] = ""
    episodes: Annotated[
        int | None,
        Option("Run only the first N scenarios, with their decoys.", least=1, panel=_CHOICE),
    ] = None
    scenario: Annotated[
        tuple[str, ...],
        Option("Run only this scenario, without its decoy; may be repeated.", panel=_CHOICE),
    ] = ()
    event: Annotated[
        tuple[str, ...],
        Option(
            "Run only scenarios with this event, or static for none; may be repeated.",
            panel=_CHOICE,
        ),
    ] = ()
    split: Annotated[
        str | None, Option("Run only scenarios of val, or of test.", panel=_CHOICE)
    ] = None
    no_decoys: Annotated[
        bool,
        Option("Leave out the decoys, and with them `discerned` (D).", panel=_CHOICE),
    ] = False
    policy: Annotated[
        str,
        Option(
            "One of `cosim list`, your own as my.py:Class, a network as onnx:FOLDER, an open-loop "
            "schedule as schedule:FILE.json, a served one as zenoh:NAME, or a ROS 2 node as "
            "ros2:.",
            panel=_POLICY,
        ),
    ] = "route"
    robot: Annotated[
        str,
        Option(
            "Robot in place of the scenario's, by name (`cosim list`).",
            panel=_STREET,
        ),
    ] = ""
    gait: Annotated[
        str,
        Option(
            "Gait of a robot with legs in place of its own: onnx:FILE.onnx, with its manifest "
            "FILE.json in the same folder.",
            metavar="onnx:FILE",
            panel=_STREET,
        ),
    ] = ""
    jobs: Annotated[
        int | None,
        Option(
            "Environment processes; with --on as many as the cluster has CPUs.",
            least=1,
            default="1",
            panel=_WHERE,
        ),
    ] = None
    policy_at: Annotated[
        tuple[str, ...],
        Option(
            "Where `cosim serve` listens, for --policy zenoh:NAME; may be repeated: servers "
            "share the episodes.",
            metavar="ENDPOINT",
            panel=_POLICY,
        ),
    ] = ()
    isolated: Annotated[
        Isolation,
        Option(
            "Run the policy in a sandbox: it gets observations, and reads only its own folder. "
            "Also --isolated=namespaces, =landlock, or =weak: only another process.",
            metavar="[=KIND]",
            default="no",
            bare="auto",
            panel=_POLICY,
        ),
    ] = "no"
    policy_data: Annotated[
        tuple[str, ...],
        Option(
            "File or folder that an --isolated policy may read, in addition to its own folder; "
            "may be repeated.",
            metavar="PATH",
            panel=_POLICY,
        ),
    ] = ()
    policy_memory: Annotated[
        float,
        Option(
            "Memory limit of each process of an --isolated policy, in GB.",
            metavar="GB",
            least=0.5,
            panel=_POLICY,
        ),
    ] = POLICY_MEMORY_GB
    shared_renderer: Annotated[
        bool,
        Option(
            "One process renders for all environments. If the policy has act_batch, it also "
            "queries the policy for all of them at once.",
            panel=_WHERE,
        ),
    ] = False
    shard: Annotated[
        str,
        Option(
            "Run only every N-th scenario, from the I-th, with their decoys; needs --seed. `cosim "
            "merge` joins all N runs.",
            metavar="I/N",
            panel=_WHERE,
        ),
    ] = ""
    out: Annotated[
        Path | None, Option("Run folder; default runs/SUITE-POLICY-TIME.", panel=_FOLDER)
    ] = None
    resume: Annotated[bool, Option("Finish the run in --out.", panel=_FOLDER)] = False
    map: Annotated[
        str | None,
        Option(
            "Draw scenarios on this place instead of the suite's: a map, a folder, a net.",
            panel=_STREET,
        ),
    ] = None
    seed: Annotated[
        int | None,
        Option(
            "Seed of the run, for policy seeds and episode ids, and for the routes with --map "
            "(else 0).",
            least=0,
            default="another one each time",
            panel=_FOLDER,
        ),
    ] = None
    roughness: Annotated[
        float | None,
        Option(
            "Roughness of the ground of --map: from 0, flat, to 1 (raised slabs, roots, potholes).",
            panel=_STREET,
        ),
    ] = None
    weather: Annotated[
        str,
        Option(
            "Weather in place of the scenario's, by name (`cosim list`); marked in every row.",
            panel=_STREET,
        ),
    ] = ""
    crowd: Annotated[
        int | None,
        Option(
            "Number of people in place of the suite's own crowd, with vehicles; marked in every "
            "row.",
            least=0,
            panel=_STREET,
        ),
    ] = None
    residents: Annotated[
        int | None,
        Option(
            "Number of residents in place of the scenario's: they sit on benches, look into shop "
            "windows, wait at stops.",
            least=0,
            panel=_STREET,
        ),
    ] = None
    groups: Annotated[
        float | None,
        Option("Share of the walkers, 0 to 1, who walk in groups of two and three.", panel=_STREET),
    ] = None
    elderly: Annotated[
        float | None,
        Option("Share of the walkers who are elderly: they walk slower.", panel=_STREET),
    ] = None
    children: Annotated[
        float | None,
        Option(
            "Share of the walkers who are children, each in a group with an adult: at most "
            "half of --groups.",
            panel=_STREET,
        ),
    ] = None
    goal: Annotated[
        str,
        Option(
            "Goal protocol in place of the manifest's, by name (`cosim list`).",
            panel=_POLICY,
        ),
    ] = ""
    latency: Annotated[
        str,
        Option(
            "Milliseconds from an observation until its command takes effect, rounded up to ticks"
            " of 50 ms; or 'measured': the policy's median here in the first episode, driven once"
            " before the run.",
            metavar="MS",
            panel=_POLICY,
        ),
    ] = ""
    real_time: Annotated[
        bool,
        Option(
            "Each command takes effect after the policy's response time on this machine. One "
            "process; not repeatable from its seed.",
            panel=_POLICY,
        ),
    ] = False
    frames: Annotated[
        float, Option("Save a camera frame every X seconds.", least=0.0, panel=_PICTURES)
    ] = 0.0
    camera: Annotated[
        CameraChoice,
        Option(
            "Renderer: gl (OpenGL), bullet (slow and plain, works anywhere), bullet-egl (plain, "
            "by OpenGL), or auto: gl where it works, else bullet.",
            metavar="CAMERA",
            panel=_PICTURES,
        ),
    ] = "auto"
    appearance: Annotated[
        Appearance,
        Option(
            "Appearance of scanned places: splats (where the scan has them, with the gl camera) "
            "or mesh.",
            metavar="APPEARANCE",
            panel=_PICTURES,
        ),
    ] = "splats"
    own_camera: Annotated[
        bool,
        Option(
            "Allow a policy's camera that the robot does not have; every row is marked "
            "nonstandard.",
            panel=_PICTURES,
        ),
    ] = False
    live: Annotated[
        str | None,
        Option(
            "Publish the run at this endpoint, like tcp/127.0.0.1:7447: see `cosim inject`.",
            panel=_NETWORK,
        ),
    ] = None
    pace: Annotated[
        float,
        Option(
            "Limit the speed to this multiple of real time, from 0.1 to 100, for interaction by "
            "hand. The results are the same.",
            metavar="X",
            default="as fast as possible",
            panel=_NETWORK,
        ),
    ] = 0.0
    director: Annotated[
        str | None,
        Option(
            "Use the director at this endpoint, a process of its own: see `cosim direct`.",
            panel=_NETWORK,
        ),
    ] = None
    tls: Annotated[
        str,
        Option(
            "Folder of certificates for tls/... endpoints: see `cosim certs --help`.",
            metavar="FOLDER",
            panel=_NETWORK,
        ),
    ] = ""
    insecure: Annotated[
        bool,
        Option(
            "Allow other machines without TLS: open to all who can reach the endpoint, "
            "unencrypted.",
            panel=_NETWORK,
        ),
    ] = False
    director_wait: Annotated[
        float,
        Option(
            "Timeout of the director in seconds; then the episode is invalid.",
            least=0.1,
            most=LONGEST_WAIT_S,
            panel=_NETWORK,
        ),
    ] = 60.0
    answer_timeout: Annotated[
        float,
        Option(
            "Timeout of a policy's answer in seconds; then its episode has crashed.",
            least=0.1,
            panel=_POLICY,
        ),
    ] = 60.0
    start_timeout: Annotated[
        float,
        Option(
            "Timeout in seconds for loading a policy, for its reset, and for the first answer "
            "after it.",
            least=0.1,
            panel=_POLICY,
        ),
    ] = 300.0
    rerun: Annotated[
        Path | None,
        Option(
            "Write one episode as a recording for the Rerun viewer (package extra [rerun]), from "
            "a replay.",
            metavar="FILE.rrd",
            panel=_PICTURES,
        ),
    ] = None
    counterfactual: Annotated[
        bool,
        Option(
            "Simulate every street again without the robot, to measure the delays by it.",
            panel=_FOLDER,
        ),
    ] = False
    on: Annotated[
        str,
        Option(
            "Run on a Ray cluster: ray (on this machine), auto, or ray://HOST:10001. Your own "
            "policy is sent there.",
            metavar="CLUSTER",
            panel=_WHERE,
        ),
    ] = ""
    ros2_listen: Annotated[
        str,
        Option(
            "Where ROS 2 nodes connect, with --policy ros2:. The default is where rmw_zenoh looks "
            "for its router.",
            metavar="ENDPOINT",
            panel=_ROS2,
        ),
    ] = ROS2_LISTEN
    ros2_at: Annotated[
        str,
        Option(
            "Connect to this router in place of listening, such as tcp/127.0.0.1:7447.",
            metavar="ENDPOINT",
            panel=_ROS2,
        ),
    ] = ""
    ros2_wait: Annotated[
        Ros2Wait,
        Option(
            "The command that answers an observation: the next one; the one stamped with its "
            "time; or at most one, of a controller with the rate --ros2-rate.",
            panel=_ROS2,
        ),
    ] = "next"
    ros2_rate: Annotated[
        float,
        Option("Rate of observations and commands in Hz.", metavar="HZ", least=0.1, panel=_ROS2),
    ] = 10.0
    ros2_camera: Annotated[
        str,
        Option(
            "Size of the pictures, and their vertical field of view: 512x288, 512x288@75, none.",
            metavar="WxH[@DEG]",
            panel=_ROS2,
        ),
    ] = "512x288"
    ros2_depth: Annotated[bool, Option("Publish depth, too.", panel=_ROS2)] = False
    ros2_scan: Annotated[
        str,
        Option(
            "Lidar: rays, rings and range in metres, such as 360, 360@20, 1024x16@50.",
            metavar="RAYS[xRINGS][@M]",
            panel=_ROS2,
        ),
    ] = "none"
    ros2_imu: Annotated[Ros2Imu, Option("Inertial sensor.", panel=_ROS2)] = "none"
    ros2_odometry: Annotated[Ros2Odometry, Option("Odometry of /odom and /tf.", panel=_ROS2)] = (
        "wheel"
    )
    ros2_domain: Annotated[
        int,
        Option(
            "ROS_DOMAIN_ID of the node; with --jobs N, N domains from this one, each with a node.",
            least=0,
            most=LARGEST_DOMAIN,
            panel=_ROS2,
        ),
    ] = 0
    ros2_namespace: Annotated[
        str, Option("Prefix of all topics, such as /robot1.", metavar="/NAME", panel=_ROS2)
    ] = ""
    ros2_distro: Annotated[
        Ros2Distro, Option("Distribution of the node; only humble differs.", panel=_ROS2)
    ] = "jazzy"
    ros2_clock: Annotated[
        Ros2Clock, Option("/clock starts again with each episode, or never goes back.", panel=_ROS2)
    ] = "restart"
    ros2_dialect: Annotated[
        Ros2Dialect,
        Option("Keys of rmw_zenoh, or of zenoh-bridge-ros2dds for nodes on DDS.", panel=_ROS2),
    ] = "rmw_zenoh"
    log_level: Annotated[
        str,
        Option(
            "Log on standard error: debug, info, warning or error.", metavar="LEVEL", panel=_LOG
        ),
    ] = ""
    log_json: Annotated[
        Path | None,
        Option("Append the log to this file, a line of JSON each.", metavar="FILE", panel=_LOG),
    ] = None

    def __post_init__(self) -> None:
        _ = self.latency_ms
        if self.weather and self.weather not in WEATHERS:
            raise unknown("weather", self.weather, WEATHERS)
        if self.resume and self.out is None:
            raise UsageError("--resume needs --out: the folder of the run to finish")
        if self.shard and self.latency == MEASURED:
            raise UsageError(
                "--shard with --latency measured: each would measure another: give milliseconds"
            )
        if self.isolated in ("no", "weak") and (self.policy_data or self._limits_memory):
            option = "--policy-data" if self.policy_data else "--policy-memory"
            raise UsageError(
                f"{option} goes with --isolated: another policy may read every file, and has no "
                "limit of memory"
            )
        if self.ros2 is None and (given := self._ros2_given):
            raise UsageError(f"{given} goes with --policy {ROS2_SCHEME}, not with '{self.policy}'")
        for path in self.policy_data:
            if not Path(path).exists():
                raise UsageError(f"--policy-data {path}: there is no such file or folder")
        if self.roughness is not None and self.map is None:
            raise UsageError(
                "--roughness goes with --map: a suite says itself how rough the ground of "
                "its places is"
            )

    @property
    def _limits_memory(self) -> bool:
        return self.policy_memory != POLICY_MEMORY_GB

    @property
    def _ros2_given(self) -> str:
        """First option of ROS 2 that is not at its default, "" if all are."""
        known = self.__dataclass_fields__
        changed = (name for name in ROS2_OPTIONS if getattr(self, name) != known[name].default)
        name = next(changed, "")
        return f"--{name.replace('_', '-')}" if name else ""

    @property
    def ros2(self) -> Ros2Settings | None:
        """Settings of a policy that is a ROS 2 node; None for another policy. Raises UsageError."""
        if not self.policy.startswith(ROS2_SCHEME):
            return None
        if self.ros2_domain + (self.jobs or 1) - 1 > LARGEST_DOMAIN:
            raise UsageError(
                f"--ros2-domain {self.ros2_domain} with {self.jobs} jobs: each job has a domain, "
                f"and the last is {LARGEST_DOMAIN}"
            )
        if self.ros2_dialect == "ros2dds" and (self.jobs or 1) > 1:
            raise UsageError("--ros2-dialect ros2dds has no domains: take one job")
        if self.ros2_at and self.ros2_listen != ROS2_LISTEN:
            raise UsageError("--ros2-listen or --ros2-at: a run listens or connects, not both")
        at = self.ros2_at or self.ros2_listen
        tls = self.tls if at.startswith("tls/") else ""
        insecure = self.insecure and not tls
        if self.ros2_at:
            end = connecting("coordinator", "--ros2-at", at, tls, insecure)
        else:
            end = Connection(
                role="coordinator",
                listen=checked_endpoint(at, "--ros2-listen"),
                tls=tls,
                insecure=insecure,
                guests=("ros2",),
            )
        return Ros2Settings(
            connection=end,
            domain=self.ros2_domain,
            namespace=self.ros2_namespace,
            wait=self.ros2_wait,
            distro=self.ros2_distro,
            clock=self.ros2_clock,
            dialect=self.ros2_dialect,
            rate_hz=self.ros2_rate,
            camera=self.ros2_camera,
            depth=self.ros2_depth,
            scan=self.ros2_scan,
            imu=self.ros2_imu,
            odometry=self.ros2_odometry,
            answer_s=self.answer_timeout,
            start_s=self.start_timeout,
        )

    @property
    def latency_ms(self) -> float | None:
        """Latency of commands; None if it is measured before the run. Raises UsageError."""
        if self.real_time and self.latency:
            raise UsageError(
                "--real-time measures the latency of every answer: leave --latency out"
            )
        if self.latency == MEASURED:
            return None
        try:
            latency_ms = float(self.latency or "0")
        except ValueError:
            raise UsageError(
                f"--latency '{self.latency}': give milliseconds, like 200, or 'measured'"
            ) from None
        if not 0.0 <= latency_ms <= MAX_LATENCY_MS:
            raise UsageError(
                f"--latency {self.latency}: milliseconds must be from 0 to {MAX_LATENCY_MS:g}"
            )
        return latency_ms

    @property
    def ends(self) -> RunConnections:
        """Network connections of the run. Raises UsageError."""
        ros2 = None if self.ros2 is None else self.ros2.connection
        return run_connections(
            self.live, self.director, self.policy_at, self.tls, self.insecure, ros2
        )


ROS2_OPTIONS = tuple(name for name in RunConfig.__dataclass_fields__ if name.startswith("ros2_"))
"""Fields of a policy that is a ROS 2 node."""


def help_of(field: str) -> str:
    """Return the help text of a field of `RunConfig`, for other commands with the same option.

    >>> help_of("elderly")
    'Share of the walkers who are elderly: they walk slower.'
    """
    return option_of(RunConfig, field).help


def option_of(config: type, field: str) -> Option:
    """Return the command-line option of a config's field."""
    found: Option = annotations_of(config)[field].__metadata__[0]
    return found


@cache
def annotations_of(config: type) -> Mapping[str, Any]:
    """Return the resolved annotations of a config's fields, computed once per config."""
    return MappingProxyType(get_type_hints(config, include_extras=True))


class RunConnections(NamedTuple):
    """Network connections of a run.

    live: endpoint on which it listens.
    director: connection to its director.
    servers: connections to the servers of its policy.
    ros2: where it meets ROS 2 nodes.
    """

    live: Connection | None
    director: Connection | None
    servers: tuple[Connection, ...]
    ros2: Connection | None = None

    @property
    def all(self) -> tuple[Connection, ...]:
        """All connections that are configured."""
        ends = self.live, self.director, *self.servers, self.ros2
        return tuple(end for end in ends if end is not None)


def run_connections(
    live: str | None,
    director: str | None,
    policies: Sequence[str],
    tls: str,
    insecure: bool,
    ros2: Connection | None = None,
) -> RunConnections:
    """Return the connections of a run. `--tls` applies to tls/... endpoints. Raises UsageError.

    ros2: connection to ROS 2 nodes.
    """
    at = {f"--policy-at {end}": end for end in policies}
    given = {
        name: end for name, end in (("--live", live), ("--director", director)) if end is not None
    } | at
    if not given and ros2 is None and (tls or insecure):
        raise UsageError(
            f"{'--tls' if tls else '--insecure'} goes with --live, --director, --policy-at or "
            f"--policy {ROS2_SCHEME}"
        )
    guarded = [name for name, end in given.items() if end.startswith("tls/")]
    if tls and not guarded and not (ros2 is not None and ros2.tls):
        shown = ", ".join([*given.values(), *([] if ros2 is None else [ros2.endpoint])])
        raise UsageError(f"--tls goes with tls/ADDRESS:PORT, not with {shown}")
    files = {name: tls if name in guarded else "" for name in given}
    return RunConnections(
        None
        if live is None
        else listening("coordinator", "--live", live, files["--live"], insecure),
        None
        if director is None
        else connecting("coordinator", "--director", director, files["--director"], insecure),
        tuple(
            connecting("coordinator", "--policy-at", end, files[name], insecure)
            for name, end in at.items()
        ),
        ros2,
    )
