"""PPO of Stable-Baselines3 learns to go straight on: pip install -e '.[gym]' stable-baselines3

    python scenarios/examples/learn_straight_on.py --minutes 30 --processes 2 --out learned

It sees 48 x 48 pixels, its speeds and the next sub-goal; the streets are those of `static` of
`reactive` without pedestrians. At first it stops on average, and turns at random.
FOLDER/curve.csv tells how it goes on, FOLDER/curve.png shows it, FOLDER/model.zip is what was
learned; then it is scored as any policy is, in places that it has never seen.
"""

from __future__ import annotations

import cosim  # isort: split

import argparse
import csv
import os
import time
from collections import deque
from pathlib import Path

import stable_baselines3 as sb3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from scenarios.tools.gym.learned import LearnedPolicy

SEES = cosim.Manifest("ppo", rate_hz=4.0, camera=cosim.CameraSpec(48, 48), goal="route_point")
_COLUMNS = ("steps", "cpu_s", "episodes", "return", "success")
_LATEST = 50
"""Episodes over which return and success are told."""


def static_streets(split: str) -> list[str]:
    """Return the ids of the scenarios without pedestrians."""
    whole = cosim.load_suite("reactive").scenarios
    return [one.id for one in whole if (one.structure, one.split) == ("static", split)]


def static_env() -> Monitor:
    """An environment of those to learn in."""
    env = cosim.make_env("reactive", SEES, scenarios=static_streets("val"))
    return Monitor(env, info_keywords=("is_success",))


class Curve(BaseCallback):  # type: ignore[misc]
    """Writes a row after every rollout: steps, CPU time of all processes, the latest episodes.
    until_s: of `time.monotonic`, when the learning ends."""

    def __init__(self, path: Path, pids: list[int], until_s: float) -> None:
        super().__init__()
        self._file = path.open("w", newline="")
        self._rows = csv.writer(self._file)
        self._rows.writerow(_COLUMNS)
        self._pids = pids
        self._count = 0
        self._until_s = until_s
        self._latest: deque[tuple[float, bool]] = deque(maxlen=_LATEST)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self._latest.append((info["episode"]["r"], info["is_success"]))
                self._count += 1
        return time.monotonic() < self._until_s

    def _on_rollout_end(self) -> None:
        if self._latest:
            returns, successes = (
                sum(column) / len(self._latest) for column in zip(*self._latest, strict=True)
            )
            cpu_s = time.process_time() + sum(map(cpu_s_of, self._pids))
            self._rows.writerow(
                [
                    self.num_timesteps,
                    f"{cpu_s:.1f}",
                    self._count,
                    f"{returns:.2f}",
                    f"{successes:.3f}",
                ]
            )
            self._file.flush()

    def _on_training_end(self) -> None:
        self._file.close()


def cpu_s_of(pid: int) -> float:
    """CPU time of a process that runs."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _drawn_curve(curve: Path, output: Path) -> None:
    """Return and success over steps, and the CPU time that they took."""
    import matplotlib.pyplot as plt

    with curve.open() as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    steps = [row["steps"] for row in rows]
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(6.4, 4.4), sharex=True, layout="constrained"
    )
    above.plot(steps, [row["success"] for row in rows], color="tab:green")
    above.set(
        ylabel="success",
        ylim=(-0.03, 1.03),
        title=f"PPO, static streets: the latest {_LATEST} episodes",
    )
    below.plot(steps, [row["return"] for row in rows])
    below.set(
        ylabel="return",
        xlabel=f"steps of 0.25 s ({rows[-1]['cpu_s'] / 60:.0f} minutes of CPU in all)",
    )
    for axes in (above, below):
        axes.grid(alpha=0.3)
    figure.savefig(output, dpi=100)


def learn(
    minutes: float, processes: int, out: Path, seed: int, steps: int = 10**9, rollout: int = 256
) -> LearnedPolicy:
    """Train for a time or a number of steps, whichever ends first.

    Writes the curve to `out`, and returns the policy.
    """
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    envs = SubprocVecEnv([static_env] * processes, start_method="spawn")
    try:
        pids = [process.pid for process in envs.processes]
        normal = VecNormalize(envs, norm_obs_keys=["goal", "speeds"], gamma=0.98)
        settings = {
            "n_steps": rollout,
            "batch_size": 128,
            "n_epochs": 5,
            "gamma": 0.98,
            "learning_rate": 5e-4,
        }
        model = sb3.PPO("MultiInputPolicy", normal, seed=seed, device="cpu", **settings)
        model.learn(
            steps, callback=Curve(out / "curve.csv", pids, time.monotonic() + 60.0 * minutes)
        )
    finally:
        envs.close()
    model.save(out / "model.zip")
    normal.save(out / "normal.pkl")
    return LearnedPolicy(
        lambda seen: model.predict(normal.normalize_obs(seen), deterministic=True)[0], SEES
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--steps", type=int, default=10**9, help="at most")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("learned"))
    given = parser.parse_args()
    policy = learn(given.minutes, given.processes, given.out, given.seed, given.steps)
    _drawn_curve(given.out / "curve.csv", given.out / "curve.png")
    table = cosim.run("reactive", policy, scenarios=static_streets("test"))
    print(table[["scenario", "success", "route_completion"]].to_string())
    print(f"success in {len(table)} streets that it has never seen: {table['success'].mean():.2f}")
