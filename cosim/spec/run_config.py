"""RunConfig: the settings of a run, from which the options of `cosim run` are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_type_hints

from cosim.core.errors import UsageError
from cosim.spec.connection import Connection, connecting, listening

CameraChoice = Literal["auto", "gl", "bullet", "bullet-egl"]
MEASURED = "measured"
"""Value of `--latency` that measures the latency before the run."""
MOST_LATENCY_MS = 10_000.0
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
    panel: heading of its group in the help.
    """

    help: str
    flag: str = ""
    metavar: str | None = None
    least: float | None = None
    most: float | None = None
    default: str = ""
    argument: bool = False
    panel: str = ""


_CHOICE = "Scenarios"
_STREET = "Place and people"
_POLICY = "Policy"
_PICTURES = "Pictures"
_WHERE = "Processes and machines"
_FOLDER = "Run folder"
_NETWORK = "Network"
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
        int | None, Option("Run only the first so many scenarios.", least=1, panel=_CHOICE)
    ] = None
    scenario: Annotated[
        tuple[str, ...], Option("Run only this scenario; may be repeated.", panel=_CHOICE)
    ] = ()
    event: Annotated[
        tuple[str, ...],
        Option(
            "Run only scenarios of this event, or static: of none; may be repeated.", panel=_CHOICE
        ),
    ] = ()
    split: Annotated[
        str | None, Option("Run only scenarios of val, or of test.", panel=_CHOICE)
    ] = None
    policy: Annotated[
        str,
        Option(
            "One of `cosim list`, your own as my.py:Class, a network as onnx:FOLDER, or a "
            "served one as zenoh:NAME.",
            panel=_POLICY,
        ),
    ] = "route"
    robot: Annotated[
        str,
        Option(
            "In place of the scenario's: which robot drives, by its name (`cosim list`).",
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
        bool,
        Option(
            "The policy gets a process of its own and sees observations alone: it cannot "
            "reach into the simulator.",
            panel=_POLICY,
        ),
    ] = False
    shared_renderer: Annotated[
        bool,
        Option(
            "One process draws for all environments and, if the policy has act_batch, asks "
            "it for all of them at once.",
            panel=_WHERE,
        ),
    ] = False
    shard: Annotated[
        str,
        Option(
            "Run only every N-th scenario, from the I-th on; needs --seed. `cosim merge` "
            "makes one run of all N.",
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
            "Draw on this place in place of the suite's: a map, a folder, a net.", panel=_STREET
        ),
    ] = None
    seed: Annotated[
        int | None,
        Option(
            "Of the run: policies' seeds and the names they are told are drawn from it; and the "
            "routes with --map (else 0).",
            least=0,
            default="another one each time",
            panel=_FOLDER,
        ),
    ] = None
    roughness: Annotated[
        float | None,
        Option(
            "Of the ground of --map: from 0, flat, to 1 (raised slabs, roots, potholes).",
            panel=_STREET,
        ),
    ] = None
    crowd: Annotated[
        int | None,
        Option(
            "Street life in place of the suite's own: so many people, and vehicles; marked "
            "in every row.",
            least=0,
            panel=_STREET,
        ),
    ] = None
    residents: Annotated[
        int | None,
        Option(
            "In place of the scenario's: so many people who sit on benches, look into shop "
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
            "What the policy is told of where to go, by its name (`cosim list`), in place of "
            "what its manifest says.",
            panel=_POLICY,
        ),
    ] = ""
    latency: Annotated[
        str,
        Option(
            "Milliseconds from an observation until the command that answers it takes effect, "
            "rounded up to ticks of 50 ms; or 'measured': the median that the policy shows here "
            "in the first episode, driven once before the run.",
            metavar="MS",
            panel=_POLICY,
        ),
    ] = ""
    real_time: Annotated[
        bool,
        Option(
            "Each answer takes effect as late as it came on this machine. One process; does not "
            "come again from its seed.",
            panel=_POLICY,
        ),
    ] = False
    frames: Annotated[
        float, Option("Keep a camera frame every so many seconds.", least=0.0, panel=_PICTURES)
    ] = 0.0
    camera: Annotated[
        CameraChoice,
        Option(
            "What draws the pictures: gl (OpenGL), bullet (slow, bare, anywhere), bullet-egl "
            "(bare, by OpenGL), or auto: gl where it works, else bullet.",
            metavar="CAMERA",
            panel=_PICTURES,
        ),
    ] = "auto"
    own_camera: Annotated[
        bool,
        Option(
            "The policy may see by a camera that the robot does not have; every row is "
            "marked nonstandard.",
            panel=_PICTURES,
        ),
    ] = False
    live: Annotated[
        str | None,
        Option(
            "Be on the air at this endpoint, like tcp/127.0.0.1:7447: see `cosim inject`.",
            panel=_NETWORK,
        ),
    ] = None
    pace: Annotated[
        float,
        Option(
            "Hold it to so many times real time, from 0.1 to 100: with 1 there is time to step in "
            "by hand. The same results.",
            metavar="X",
            default="as fast as possible",
            panel=_NETWORK,
        ),
    ] = 0.0
    director: Annotated[
        str | None,
        Option(
            "Ask the director at this endpoint, a process of its own: see `cosim direct`.",
            panel=_NETWORK,
        ),
    ] = None
    tls: Annotated[
        str,
        Option(
            "Guard tls/... endpoints: see `cosim certs --help`.", metavar="FOLDER", panel=_NETWORK
        ),
    ] = ""
    insecure: Annotated[
        bool,
        Option(
            "Beyond this machine without TLS: open to all who can reach it, unencrypted.",
            panel=_NETWORK,
        ),
    ] = False
    director_wait: Annotated[
        float,
        Option(
            "Seconds to wait for it; then the episode has crashed.",
            least=0.1,
            most=LONGEST_WAIT_S,
            panel=_NETWORK,
        ),
    ] = 60.0
    answer_timeout: Annotated[
        float,
        Option(
            "Seconds a policy may take to answer; then its episode has crashed.",
            least=0.1,
            panel=_POLICY,
        ),
    ] = 60.0
    start_timeout: Annotated[
        float,
        Option(
            "The same for loading it, for its reset, and for the first answer after it.",
            least=0.1,
            panel=_POLICY,
        ),
    ] = 300.0
    rerun: Annotated[
        Path | None,
        Option(
            "Write one episode as a recording for the Rerun viewer (package extra [rerun]): "
            "it is replayed for that.",
            metavar="FILE.rrd",
            panel=_PICTURES,
        ),
    ] = None
    counterfactual: Annotated[
        bool,
        Option("Simulate every street again without the robot: whom it delayed.", panel=_FOLDER),
    ] = False
    on: Annotated[
        str,
        Option(
            "Run by a Ray cluster: ray (of this machine), auto, or ray://HOST:10001. A "
            "policy of yours is sent there.",
            metavar="CLUSTER",
            panel=_WHERE,
        ),
    ] = ""
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
        if self.resume and self.out is None:
            raise UsageError("--resume needs --out: the folder of the run to finish")
        if self.shard and self.latency == MEASURED:
            raise UsageError(
                "--shard with --latency measured: each would measure another: give milliseconds"
            )
        if self.roughness is not None and self.map is None:
            raise UsageError(
                "--roughness goes with --map: a suite says itself how rough the ground of "
                "its places is"
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
        if not 0.0 <= latency_ms <= MOST_LATENCY_MS:
            raise UsageError(
                f"--latency {self.latency}: milliseconds must be from 0 to {MOST_LATENCY_MS:g}"
            )
        return latency_ms

    @property
    def ends(self) -> RunEnds:
        """Network connections of the run. Raises UsageError."""
        return ends_of_run(self.live, self.director, self.policy_at, self.tls, self.insecure)


def help_of(field: str) -> str:
    """Return the help text of a field of `RunConfig`, for other commands with the same option.

    >>> help_of("elderly")
    'Share of the walkers who are elderly: they walk slower.'
    """
    return option_of(RunConfig, field).help


def option_of(config: type, field: str) -> Option:
    """Return the command-line option of a config's field."""
    found: Option = get_type_hints(config, include_extras=True)[field].__metadata__[0]
    return found


class RunEnds(NamedTuple):
    """Network connections of a run.

    live: endpoint on which it listens.
    director: connection to its director.
    servers: connections to the servers of its policy.
    """

    live: Connection | None
    director: Connection | None
    servers: tuple[Connection, ...]

    @property
    def all(self) -> tuple[Connection, ...]:
        """All connections that are configured."""
        return tuple(end for end in (self.live, self.director, *self.servers) if end is not None)


def ends_of_run(
    live: str | None, director: str | None, policies: Sequence[str], tls: str, insecure: bool
) -> RunEnds:
    """Return the connections of a run. `--tls` applies to tls/... endpoints. Raises UsageError."""
    at = {f"--policy-at {end}": end for end in policies}
    given = {
        name: end for name, end in (("--live", live), ("--director", director)) if end is not None
    } | at
    if not given and (tls or insecure):
        raise UsageError(
            f"{'--tls' if tls else '--insecure'} goes with --live, --director or --policy-at"
        )
    guarded = [name for name, end in given.items() if end.startswith("tls/")]
    if tls and not guarded:
        raise UsageError(f"--tls goes with tls/ADDRESS:PORT, not with {', '.join(given.values())}")
    files = {name: tls if name in guarded else "" for name in given}
    return RunEnds(
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
    )
