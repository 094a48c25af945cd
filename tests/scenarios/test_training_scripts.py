"""The training script of the recurrent policy, with stub commands that only write files."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from cosim.core.errors import UsageError
from scenarios.examples.black_pictures import Blinded
from scenarios.suites.user_scenarios.read import read_own
from tests.conftest import wait_until

SCRIPT = Path(__file__).parents[2] / "scenarios/examples/sidewalk_policy.sh"
COMMAND = """#!/usr/bin/env bash
echo "$(basename "$0") $*" >> "$CALLS"
[ -z "${NAP:-}" ] || { echo $$ >> "$CALLS.pids"; exec sleep "$NAP"; }
while [ $# -gt 0 ]; do
  case $1 in
    collect) command=$1 ;;
    compare) command=$1 ;;
    -o | --out) out=$2; outs+=("$2") ;;
  esac
  shift
done
case ${command:-} in
  collect) [ -n "$EMPTY" ] || { mkdir -p "$out/runs/00/episodes/a"; touch "$out/runs/00/episodes/a/demonstration.npz"; }
    exit "$CODE" ;;
  compare) for out in "${outs[@]}"; do
      case $out in *.csv) echo "$TABLE" > "$out" ;; *.png) [ -z "${NO_PICTURE:-}" ] || exit 2 ;; *) echo "a table" > "$out" ;; esac
    done ;;
  *) case $out in *.npz) touch "${out%.npz}-000.npz" ;; *) mkdir -p "$out"; touch "$out/run.json" ;; esac ;;
esac
"""


def _heed_signals() -> None:
    """Reset signals that the tests' own parent ignores, as `nohup` does."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def begin_script(folder: Path, code: int = 4, **settings: str) -> subprocess.Popen[str]:
    """Start the script with these settings and this exit code of `cosim collect`."""
    for name in ("cosim", "python"):
        (folder / name).write_text(COMMAND)
        (folder / name).chmod(0o755)
    calls = folder / "calls.txt"
    calls.write_text("")
    return subprocess.Popen(
        ["bash", str(SCRIPT), str(folder / "work")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_heed_signals,
        env=os.environ
        | {"COSIM": str(folder / "cosim"), "PYTHON": str(folder / "python"), "CALLS": str(calls)}
        | {
            "CODE": str(code),
            "TABLE": "",
            "EMPTY": "",
            "JOBS": "1",
            "ROUNDS": "1",
            "ROBOTS": "",
            "SEEDS": "0",
            "VALUES": "",
            "SUITES": "unit",
        }
        | settings,
    )


def run_script(
    folder: Path, code: int = 4, **settings: str
) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """Run the script; return the process and its commands."""
    with begin_script(folder, code, **settings) as process:
        out, errors = process.communicate()
    done = subprocess.CompletedProcess(process.args, process.returncode, out, errors)
    return done, (folder / "calls.txt").read_text().splitlines()


@pytest.mark.parametrize(
    ("sent", "code"),
    [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129), (signal.SIGKILL, -9)],
)
def test_a_killed_script_leaves_no_second_training_in_its_folder(
    tmp_path: Path, sent: signal.Signals, code: int
) -> None:
    """Ctrl-C, SIGTERM and a closed terminal end its collections. After SIGKILL the next call is
    refused, until they have ended."""
    pids = tmp_path / "calls.txt.pids"
    with begin_script(tmp_path, NAP="600") as process:
        wait_until(lambda: pids.exists() and len(pids.read_text().splitlines()) == 5)
        process.send_signal(sent)
        assert process.wait() == code
        if sent == signal.SIGKILL:
            done, calls = run_script(tmp_path)
            assert done.returncode == 1 and "is in use" in done.stdout and not calls
            for pid in pids.read_text().splitlines():
                os.kill(int(pid), signal.SIGTERM)
    wait_until(lambda: run_script(tmp_path)[0].stdout.endswith("all done\n"))


def test_a_collection_that_crashed_is_not_done(tmp_path: Path) -> None:
    """An uncaught exception (exit code 1) stops the script, and so does an unfinished collection.
    The next call collects for the remaining time."""
    done, calls = run_script(tmp_path, code=1)
    assert done.returncode == 1 and "stopped in collect-0-unit: call again" in done.stdout
    assert not [*tmp_path.glob("work/log/*.done")] and calls
    assert all("collect" in call for call in calls)
    (tmp_path / "work/log/collect-0-unit.seconds").write_text("360")
    done, calls = run_script(tmp_path, MINUTES="5", COLLECT="4.5")
    assert done.returncode == 1 and "stopped in collect-0-long: call again" in done.stdout
    assert [path.name for path in tmp_path.glob("work/log/*.done")] == ["collect-0-unit.done"]
    minutes = {call.split()[2]: float(call.split("--minutes ")[1].split()[0]) for call in calls}
    assert minutes["unit"] < 0.1 and 3.0 < minutes["long-horizon"] <= 3.5


def test_a_round_has_gestures_and_ways_over_signals(tmp_path: Path) -> None:
    """Each round collects `gesturing` with its decoys, and short ways over crossings with signals
    in each of its cities."""
    _, calls = run_script(tmp_path, code=1, CITIES="2")
    ways = tmp_path / "work/signals-0.toml"
    assert sum("--event gesturing" in call and "--decoys" in call for call in calls) == 1
    assert sum(f"collect {ways}" in call for call in calls) == 1
    variants = read_own(ways).variants
    cities = [city for one in variants if (city := one.own.place.city) is not None]
    assert sorted({*cities}) == [900, 901] and len(cities) > 2
    assert all(one.own.way.signals == "with" for one in variants)


def test_a_collection_without_episodes_is_not_done(tmp_path: Path) -> None:
    """If its time was too short for an episode, the next call collects again for as long."""
    done, calls = run_script(tmp_path, EMPTY="1")
    assert done.returncode == 1 and "no episode in COLLECT minutes" in done.stdout
    assert not [*tmp_path.glob("work/log/*.done")]
    assert calls and not any("pack" in call for call in calls)
    done, _ = run_script(tmp_path)
    assert done.stdout.endswith("all done\n")


@pytest.mark.parametrize(
    ("settings", "tables", "names"),
    [
        ({"SUITES": "reactive"}, 1, ["sidewalk-0"]),
        ({"SEEDS": ""}, 0, []),
        ({"SEEDS": "0 1"}, 1, ["sidewalk-0", "sidewalk-1"]),
        ({"SEEDS": "1", "ABLATIONS": "1"}, 2, ["sidewalk-1", "sidewalk-share-0.01"]),
    ],
    ids=["black", "no seed", "seeds", "ablations"],
)
def test_the_script_ends_with_a_table(
    tmp_path: Path, settings: dict[str, str], tables: int, names: list[str]
) -> None:
    """Each policy has its own name, and all are compared; without a seed none is."""
    done, calls = run_script(tmp_path, **settings)
    assert done.returncode == 0 and done.stdout.endswith("all done\n"), done
    assert done.stdout.count("a table") == tables
    trained = [call.split("--name ")[1].split()[0] for call in calls if "--name" in call]
    assert trained[: len(names)] == names and len(trained) == len(set(trained))
    assert sum("compare" in call for call in calls) == tables


@pytest.mark.parametrize(
    ("settings", "control"),
    [({}, "sidewalk-0"), ({"SEEDS": "1"}, "whole"), ({"FIRST": "1", "FROM": "old"}, "whole")],
    ids=["seed 0", "another seed", "from a bundle"],
)
def test_ablations_are_compared_with_seed_0_from_new_parameters(
    tmp_path: Path, settings: dict[str, str], control: str
) -> None:
    """The control is trained without FROM on all data, and is the first of their table alone."""
    done, calls = run_script(tmp_path, ABLATIONS="1", **settings)
    assert done.returncode == 0, done
    (call,) = [call for call in calls if "unit-ablations.md" in call]
    first, *others = call.split(" -o ")[0].split()[2:]
    assert first == str(tmp_path / f"work/runs/unit-{control}")
    assert len(others) == 8 and not any("sidewalk" in name or name == first for name in others)
    named = f"--name sidewalk-{control.removeprefix('sidewalk-')} "
    (trained,) = [call for call in calls if named in call]
    assert "--from" not in trained and "--seed 0" in trained


def test_without_a_picture_there_is_a_table(tmp_path: Path) -> None:
    """If `cosim compare` cannot draw, as without matplotlib, the script ends with its table."""
    done, calls = run_script(tmp_path, SEEDS="0 1", NO_PICTURE="1")
    assert done.returncode == 0 and done.stdout.endswith("all done\n"), done
    assert f"no picture {tmp_path}/work/unit.png\nunit:\na table\n" in done.stdout
    assert [call.count(" -o ") for call in calls if "compare" in call] == [2, 1]


def test_networks_share_gpus(tmp_path: Path) -> None:
    """With two networks on each of two GPUs, five seeds are trained, each once."""
    done, calls = run_script(tmp_path, SEEDS="0 1 2 3 4", GPUS="2", PER_GPU="2", CITIES="4")
    assert done.returncode == 0 and done.stdout.endswith("all done\n"), done
    trained = sorted(call.split("--name ")[1].split()[0] for call in calls if "--name" in call)
    assert trained == [f"sidewalk-{seed}" for seed in range(5)]


def test_networks_that_are_scored_at_a_time_share_the_processes(tmp_path: Path) -> None:
    """With three at a time, each of five networks is scored once, with a third of the processes."""
    done, calls = run_script(tmp_path, SEEDS="0 1 2 3 4", JOBS="7", AT_ONCE="3")
    assert done.returncode == 0 and done.stdout.endswith("all done\n"), done
    scored = sorted(call for call in calls if call.startswith("cosim run unit"))
    assert len(scored) == 5 and all("--jobs 2 " in call for call in scored)
    assert all(f"nets/sidewalk-{seed} " in " ".join(scored) for seed in range(5))


HEAD = "by,metric,value_before,value_after,verdict\n"


@pytest.mark.parametrize(
    ("rows", "kept"),
    [
        ("suite,success,0.5,0.6,better\nsuite,discerned,0.5,0.5,within noise", "values"),
        ("suite,success,0.5,0.6,better\nsuite,discerned,0.5,0.4,within noise", "sidewalk-0"),
        ("suite,success,0.5,0.5,within noise\nevent,success,0.5,0.6,better", "sidewalk-0"),
    ],
    ids=["one rises", "one falls", "none rises"],
)
def test_fine_tuning_is_kept_if_val_improves(tmp_path: Path, rows: str, kept: str) -> None:
    """The learner explores, its episodes are weighted, and the better policy also drives with black
    pictures. Questions train on one event, and scores use random goals."""
    settings = {"VALUES": "0.5", "QUESTIONS": "1", "SUITES": "reactive", "SPLIT": "test"}
    done, calls = run_script(tmp_path, **settings, TABLE=HEAD + rows)
    assert done.returncode == 0 and f"kept: {kept}\n" in done.stdout, done
    net = tmp_path / "work/nets/sidewalk-0"
    explored = [call for call in calls if f"--learner onnx:{net} --explore 0.3" in call]
    assert len(explored) == 5 and not any("--noise" in call for call in explored)
    (tuned,) = [call for call in calls if "--values 0.5" in call]
    assert f"--from {net}" in tuned and "values-reactive-0-000.npz" in tuned
    assert sum("--split val" in call for call in calls) == 2
    (one,) = [call for call in calls if "--event gesturing" in call and "demos/event" in call]
    assert f"--learner onnx:{net}" in one and "--decoys" in one
    (run,) = [call for call in calls if "--goal random_point" in call]
    assert "--split test" in run and f"--policy onnx:{net} " in run
    names = [call.split("--name ")[1].split()[0] for call in calls if "--name" in call]
    assert names == ["sidewalk-0", "sidewalk-values", "sidewalk-event"]


def test_a_collection_must_fit_in_a_piece(tmp_path: Path) -> None:
    """A COLLECT of MINUTES or more is refused, with both values."""
    done, calls = run_script(tmp_path, COLLECT="9")
    assert (done.returncode, calls) == (2, [])
    assert done.stdout == "COLLECT=9 must be less than MINUTES=9\n"


def test_black_pictures_have_the_name_and_hash_of_their_policy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another policy is another run, and without a policy the message says how to set one."""
    names = set()
    for policy in ("small", "small-reactive"):
        monkeypatch.setenv("POLICY", policy)
        names.add(Blinded().manifest.name.removeprefix(f"{policy}-black-"))
    assert [len(name) for name in names] == [8, 8]
    monkeypatch.delenv("POLICY")
    with pytest.raises(UsageError, match="set POLICY, the policy that drives"):
        Blinded()
