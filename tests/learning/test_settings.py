"""The parts of training that need no PyTorch: settings, continuation, output, curve, missing
packages."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from cosim.cli import train
from cosim.core.errors import RunError, UsageError
from cosim.learning.curve import draw_curve, write_curve
from cosim.learning.settings import (
    StepsReached,
    Training,
    is_evaluated,
    outcome_in_words,
    planned_steps,
    rate_share,
    refuse_another,
    state_in_words,
)
from tests.conftest import Cosim
from tests.support.drawn_text import clipped_texts

HERE = Path("small/checkpoint.pt")


def test_without_pytorch_the_cpu_build_is_recommended_first(
    tmp_path: Path, cosim: Cosim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 3 and one message name PyTorch's index of CPU builds before the extra of 7 GB."""
    monkeypatch.setattr(
        train, "find_spec", lambda name: None if name == "torch" else find_spec(name)
    )
    done = cosim("train", "no.npz", "-o", "small", cwd=tmp_path)
    assert done.returncode == 3 and not list(tmp_path.iterdir())
    first = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
    second = "-e '.[train]' in the checkout"
    assert (
        0
        < done.stderr.index("torch cannot be imported: ")
        < done.stderr.index(first)
        < done.stderr.index(second)
    )
    assert first in " ".join(cosim("train", "--help").stdout.split())


def test_a_training_continues_to_its_planned_end_or_to_another() -> None:
    """Without --steps it runs to the planned end, with a larger number to that, and never to a
    smaller one."""
    assert planned_steps(HERE, None, planned=300, done=300) == 300
    assert planned_steps(HERE, 900, planned=300, done=300) == 900
    assert planned_steps(HERE, 200, planned=300, done=118) == 200
    with pytest.raises(
        RunError,
        match=r"pt: 118 steps are done, and --steps asks for 100 in all: give more than 118",
    ):
        planned_steps(HERE, 100, planned=300, done=118)


def test_a_training_with_other_settings_is_not_continued() -> None:
    """Seed, batch and rate must be equal, steps need not, and the differences are named."""
    was = Training(steps=300).spec
    refuse_another(HERE, was, Training(steps=900).spec)
    with pytest.raises(
        RunError,
        match="of another training: seed 0, not 1, batch 256, not 64: continue it as it was",
    ):
        refuse_another(HERE, was, Training(seed=1, batch=64).spec)


@pytest.mark.parametrize("field", ["steps", "batch", "rate", "minutes"])
def test_settings_must_be_above_zero(field: str) -> None:
    """The option is named."""
    with pytest.raises(UsageError, match=f"--{field} must be above 0, not 0"):
        Training(**{field: 0})


def test_the_learning_rate_rises_and_falls_to_zero() -> None:
    """It reaches its maximum within 3 % of the steps and then falls to 0, however many steps there
    are."""
    for steps in (60, 20_000):
        shares = [rate_share(step, steps) for step in range(steps + 1)]
        assert shares[0] > 0.0 and shares[-1] == 0.0 and max(shares) > 0.98
        assert shares.index(max(shares)) <= 0.03 * steps + 1
        assert shares[shares.index(max(shares)) :] == sorted(
            shares[shares.index(max(shares)) :], reverse=True
        )
    assert [step for step in range(1, 701) if is_evaluated(step, 700)] == [200, 400, 600, 700]


def test_the_end_of_a_training_is_summarised() -> None:
    """The summary has the bundle, the last step, and how to continue to the same or another end."""
    stopped, finished = (
        outcome_in_words(Path("small"), StepsReached(step, 300)) for step in (118, 300)
    )
    assert (
        "a bundle: --policy onnx:small, stopped at step 118 of 300. Continue with --resume"
        in stopped
    )
    assert "--resume --steps N, at least 119" in stopped and finished.endswith(
        "more steps: --resume --steps 600"
    )
    assert state_in_words(20, [10, 40, 80]) == "; step 20 of 80"


@pytest.mark.parametrize("rows", [1, 20])
def test_the_curve_is_drawn_with_nothing_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    """With small errors over many steps no title or tick label leaves the picture or overlaps
    another."""
    names = [
        "speed_loss",
        "turn_loss",
        "stop_loss",
        "way_loss",
        "held_out_loss",
        "speed_error_mps",
        "turn_error_radps",
    ]
    names += ["way_error_m", "stops_found", "stops_right"]
    curve = [
        {"step": 1000.0 * (k + 1)} | dict.fromkeys(names, 0.0001 / (k + 1)) for k in range(rows)
    ]
    write_curve(tmp_path, curve)
    found = clipped_texts(monkeypatch, lambda: draw_curve(tmp_path))
    assert found == [] and (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
