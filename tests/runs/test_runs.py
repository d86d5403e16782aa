"""Run folders: what is written is whole, what is damaged is passed over, and two runs never mix."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs import Metrics, find_run, lock_folder, open_run, read_metrics, read_run
from tests.processes import waited
from tests.refusals import refusal, refused_codes


def state_of(step: int) -> dict[str, object]:
    return {
        "weights": {"layer": torch.full((3,), float(step))},
        "numbers": [step, 0.5, None, "text"],
        "pair": (1, 2),
    }


def test_the_newest_checkpoint_comes_back_and_one_more_is_kept(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", "toy", {"seed": 1})
    assert run.latest_checkpoint() is None
    for step in (1, 20, 300):
        path = run.save_checkpoint(step, state_of(step))
    assert len(list(path.parent.iterdir())) == 2
    found = run.latest_checkpoint()
    assert (found.step, found.path) == (300, path)
    assert found.state["numbers"] == [300, 0.5, None, "text"]
    assert found.state["pair"] == (1, 2)
    assert torch.equal(found.state["weights"]["layer"], torch.full((3,), 300.0))
    with pytest.raises(TypeError):
        run.save_checkpoint(400, {"code": print})
    assert run.checkpoint().step == 300
    run.save_checkpoint(3, state_of(3))  # a run that went back
    assert run.checkpoint().step == 3


@pytest.mark.parametrize("damage", ["cut", "changed", "emptied"])
def test_a_damaged_checkpoint_is_passed_over(tmp_path: Path, damage: str) -> None:
    run = open_run(tmp_path / "run", "toy", {})
    run.save_checkpoint(1, state_of(1))
    path = run.save_checkpoint(2, state_of(2))
    data = bytearray(path.read_bytes())
    if damage == "changed":
        data[len(data) // 2] ^= 1
    path.write_bytes({"cut": data[:-7], "changed": data, "emptied": b""}[damage])
    found = run.latest_checkpoint()
    assert found.step == 1
    # A run that goes back and comes to the same step again is not stopped by what lies there.
    run.save_checkpoint(2, state_of(2))
    assert run.checkpoint().step == 2


def test_the_same_settings_come_back_and_others_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = open_run(folder, "toy", {"seed": 1, "data": {"sizes": (1, 2), "task": "dig"}}, note={"of": "x"})
    assert open_run(folder, "toy", {"seed": 1, "data": {"sizes": [1, 2], "task": "dig"}}) == first
    assert first.about["of"] == "x"
    assert {"python", "torch", "powderdsl"} <= first.about["versions"].keys()
    other = {"seed": 2, "data": {"sizes": [1, 3], "task": "dig"}, "lines": 5}
    (error,) = refusal(open_run, folder, "toy", other)
    assert error.code == "PD621"
    assert error.notes == (
        "`data.sizes` is [1, 2] there, [1, 3] here",
        "`lines` is not set there, 5 here",
        "`seed` is 1 there, 2 here",
    )
    (error,) = refusal(open_run, folder, "other", {"seed": 1})
    assert '`kind` is "toy" there, "other" here' in error.notes
    (tmp_path / "thesis.tex").write_text("…", encoding="utf-8")  # other people's files are left alone
    assert refused_codes(open_run, tmp_path, "toy", {}) == ["PD621"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "thesis.tex"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "damaged"),
        ("[1, 2]", "damaged"),
        ('{"kind": "toy"}', "damaged"),
        ('{"kind": "other", "config": {}}', "of the kind `other`"),
        ("[" * 100_000, "damaged"),
    ],
)
def test_a_damaged_run_is_refused_with_a_reason(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "run.json").write_text(text, encoding="utf-8")
    (error,) = refusal(read_run, tmp_path, "toy")
    assert error.code == "PD620"
    assert why in " ".join(error.notes)


def test_a_checkpoint_is_not_called_damaged_for_want_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run(tmp_path / "run", "toy", {})
    run.save_checkpoint(1, state_of(1))
    monkeypatch.setitem(sys.modules, "safetensors.torch", None)
    with pytest.raises(ModuleNotFoundError, match="safetensors"):
        run.latest_checkpoint()


def test_a_run_is_found_by_its_name(folder: Path) -> None:
    made = open_run("runs/dunes", "toy", {})
    assert find_run("dunes") == made
    assert refusal(find_run, "dune")[0].helps == ("did you mean `dunes`?",)


def test_metrics_after_the_last_checkpoint_are_written_once(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", "toy", {})
    with Metrics(run.path) as metrics:
        for step in range(1, 6):
            metrics.write(step, {"loss": 1 / step, "gap": float("nan")})
    with (run.path / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"step": 6, "lo')  # killed while it wrote
    with Metrics(run.path, 3) as metrics:
        metrics.write(4, {"loss": 0.0})
    lines = list(read_metrics(run.path))
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert lines[-1] == {"step": 4, "loss": 0.0}
    assert list((run.path / "tensorboard").iterdir())


def test_metrics_on_a_full_disk_are_told_with_their_path(tmp_path: Path) -> None:
    metrics = Metrics(tmp_path)
    with Path("/dev/full").open("a") as full:
        os.dup2(full.fileno(), metrics._file.fileno())
    with pytest.raises(CompileError, match=r"PD613.* cannot write .*metrics\.jsonl"), metrics:
        metrics.write(1, {"loss": 0.5})


SAVING = """
import sys, torch
from powderdsl.experiments.runs import lock_folder, open_run
run = open_run(sys.argv[1], "toy", {})
found = run.latest_checkpoint()
step = found.step if found else 0
with lock_folder(run.path):
    while True:
        step += 1
        run.save_checkpoint(step, {"step": step, "weights": torch.full((20_000,), step)})
        print(step, flush=True)
"""


@pytest.mark.slow
def test_no_kill_leaves_an_unreadable_checkpoint(tmp_path: Path) -> None:
    chance, last = random.Random(5), 0
    for _ in range(4):
        child = subprocess.Popen(
            [sys.executable, "-c", SAVING, str(tmp_path / "run")], stdout=subprocess.PIPE, text=True
        )
        said = 0
        for _ in range(chance.randint(2, 20)):
            said = int(child.stdout.readline())
        os.kill(child.pid, signal.SIGKILL)
        rest = child.communicate()[0].split("\n")
        said = max([said, *(int(line) for line in rest[:-1])])
        found = read_run(tmp_path / "run").checkpoint()
        assert found.step >= said > last
        assert found.state["step"] == found.step
        assert torch.equal(found.state["weights"], torch.full((20_000,), found.step))
        last = found.step
    assert json.loads((tmp_path / "run" / "run.json").read_text())["kind"] == "toy"


def test_one_process_at_a_time(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", "toy", {})
    child = subprocess.Popen([sys.executable, "-c", SAVING, str(run.path)], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "1\n"
        with pytest.raises(CompileError, match="PD622"), lock_folder(run.path):
            pass
    finally:
        child.kill()
        child.communicate()

    def free() -> bool:
        with suppress(CompileError), lock_folder(run.path):
            return True
        return False

    assert waited(free)
