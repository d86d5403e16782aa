"""Training: what was killed continues bit by bit, what does not fit is refused, and agents learn."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from powderdsl.experiments.runs import RunFolder, read_run
from powderdsl.rl import evaluate, preset, train
from powderdsl.rl.config import HOW, from_json
from tests.processes import started
from tests.refusals import refusal
from tests.rl.tiny_tasks import PLACE, quick, write_task
from tests.states import logged, same


@pytest.fixture
def task(tmp_path: Path) -> Path:
    return write_task(tmp_path)


def lasting(run: RunFolder) -> dict[str, Any]:
    """The newest state without times of day."""
    state = dict(run.checkpoint().state)
    state["episodes"] = [one[:2] for one in state["episodes"]]
    state["logged"] = {name: one for name, one in state["logged"].items() if not name.startswith("time/")}
    return state


OTHER = {
    "small": {"network": "small"},
    "paper": {"network": "paper"},
    "fcn": {"network": "fcn", "eval_every": 64, "eval_episodes": 3},
    "bfloat16": {"network": "fcn", "precision": "bfloat16"},
    "frames": {"frames": 3, "normalize": "both", "target_kl": 0.01, "eval_every": 1, "eval_episodes": 3},
}


@pytest.mark.parametrize("name", OTHER)
def test_a_run_in_parts_is_a_run_at_once(task: Path, tmp_path: Path, name: str) -> None:
    def stop(step: int, mean: float | None) -> None:
        if step >= 76:
            raise KeyboardInterrupt

    if name == "bfloat16" and not torch.cpu._is_avx512_bf16_supported():
        pytest.skip("the processor has no bfloat16")
    config, folder = quick(task, **OTHER[name]), tmp_path / "parts"
    whole = train(config, tmp_path / "whole")
    train(replace(config, steps=10), folder)
    with pytest.raises(KeyboardInterrupt):
        train(replace(config, checkpoint_minutes=60.0), folder, progress=stop)
    assert read_run(folder).checkpoint().step == 64  # it saves what it has
    parts = train(config, folder)
    path = parts.checkpoint().path
    assert parts.checkpoint().step == whole.checkpoint().step == 96
    assert same(lasting(parts), lasting(whole))
    assert logged(parts) == logged(whole)
    assert [line["step"] for line in logged(whole) if "held_out/return" not in line] == [32, 64, 96]
    held_out = [line["step"] for line in logged(whole) if "held_out/return" in line]
    assert held_out == {"fcn": [0, 64], "frames": [0, 32, 64, 96]}.get(name, [])
    when = path.stat().st_mtime_ns
    assert train(config, folder).checkpoint().path == path  # it is done, and stays as it is
    assert path.stat().st_mtime_ns == when


def test_random_numbers_of_the_caller_stay_and_a_runs_own_follow_its_seed(task: Path, tmp_path: Path) -> None:
    """The last batch of an epoch may be smaller, here one action, and nobody is warned."""
    random.seed(1), np.random.seed(1), torch.manual_seed(1)
    expected = random.random(), np.random.rand(), torch.rand(1).item()
    random.seed(1), np.random.seed(1), torch.manual_seed(1)
    runs = [train(quick(task, steps=32, batch=31, seed=seed), tmp_path / str(seed)) for seed in (0, 1)]
    assert (random.random(), np.random.rand(), torch.rand(1).item()) == expected
    policies = [run.checkpoint().state["policy"] for run in runs]
    assert not same(*policies)
    assert all(one.isfinite().all() for one in policies[0].values())


TRAINING = """
import json, sys
from powderdsl.rl import train
from powderdsl.rl.config import from_json
train(from_json(json.loads(sys.argv[2])), sys.argv[1], progress=lambda step, mean: print(step, flush=True))
"""


@pytest.mark.slow
def test_a_run_that_is_killed_ends_as_if_it_had_not_been(task: Path, tmp_path: Path) -> None:
    config, chance = quick(task, steps=640), random.Random(3)
    folder, gone_on = tmp_path / "killed", []
    command = [sys.executable, "-c", TRAINING, str(folder), json.dumps(config.as_json())]
    for _ in range(3):
        with started(command, stdout=subprocess.PIPE) as child:
            gone_on.append(int(child.stdout.readline()))
            for _ in range(chance.randint(10, 50)):
                child.stdout.readline()
            time.sleep(chance.uniform(0, 0.05))  # in the middle of an update or of saving, now and then
        assert child.returncode == -signal.SIGKILL
    assert gone_on[0] == 4  # worlds
    assert 4 < gone_on[1] < gone_on[2] < 640
    run, whole = train(config, folder), train(config, tmp_path / "whole")
    assert run.checkpoint().step == whole.checkpoint().step == 640
    assert same(lasting(run), lasting(whole))
    assert logged(run) == logged(whole)


@pytest.mark.parametrize("network", ["small", "fcn"])
def test_bfloat16_is_for_processors_that_have_it_and_nearly_as_precise(
    task: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, network: str
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    config = quick(task, steps=32, network=network, precision="bfloat16")
    assert "`precision`" in refusal(train, config, tmp_path / "run")[0].message
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)  # torch computes in it anyway
    runs = [train(one, tmp_path / one.precision) for one in (config, replace(config, precision="float32"))]
    assert "precision" not in runs[1].config  # such as those of before
    states = [run.checkpoint().state["policy"] for run in runs]
    assert {one.dtype for one in states[0].values() if one.is_floating_point()} == {torch.float32}
    assert not same(*states)
    apart = [(one - states[1][name]).abs().max().item() for name, one in states[0].items()]
    assert max(apart) < 0.02


def test_another_configuration_is_refused(task: Path, tmp_path: Path) -> None:
    config = quick(task, steps=32)
    train(config, tmp_path / "run")
    errors = refusal(train, quick(task, steps=32, seed=1, epochs=3), tmp_path / "run")
    assert [one.code for one in errors] == ["PD621"]
    assert [note.split(" ")[0] for note in errors[0].notes] == ["`epochs`", "`seed`"]
    task.write_text(task.read_text().replace("/ 10", "/ 20"))
    assert "task_fingerprint" in refusal(train, config, tmp_path / "run")[0].notes[0]


def test_all_mistakes_are_named() -> None:
    errors = refusal(
        preset, "smal", "dig", batch=1, epochs=0.5, gamma=float("nan"), network="big", envz=3, task_=0
    )
    text = " ".join(one.message for one in errors)
    assert {one.code for one in errors} == {"PD640"}
    for word in ("`smal`", "`batch` must be", "`epochs` must be", "`gamma` must be", "`network`", "`envz`"):
        assert word in text
    assert len(errors) == 7


def test_presets_are_those_of_the_documentation() -> None:
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text(encoding="utf-8")
    presets = [preset(name, "dig") for name in ("paper", "small", "fcn")]
    for label, names in {
        "learning rate, batch, epochs": ("learning_rate", "batch", "epochs"),
        "actions per world and update": ("rollout",),
        "entropy coefficient": ("entropy",),
    }.items():
        cells = [", ".join(f"{getattr(config, name):g}" for name in names) for config in presets]
        assert f"| {label} | {' | '.join(cells)} |" in page


def test_settings_survive_json() -> None:
    config = preset("small", "dig", knobs={"size": 3}, params={"wind.x": "5%"}, network="paper")
    assert config.observation == "compact"
    assert from_json(json.loads(json.dumps(config.as_json()))) == config
    assert not set(HOW) & config.identity.keys()


def test_an_agent_learns(tmp_path: Path) -> None:
    config = quick(write_task(tmp_path, PLACE), steps=1536, envs=16, batch=64, learning_rate=1e-2)
    run = train(config, tmp_path / "run")
    trained, at_random, nothing = evaluate(run, episodes=128).scores
    assert (trained.policy, at_random.policy, nothing.policy) == ("trained", "random", "nothing")
    assert trained.mean > 1.8  # of 2
    assert at_random.mean < 1.2
    mean, half = trained.above["random"]
    assert half is not None
    assert mean - half > 0.5
    assert nothing.mean == 0
