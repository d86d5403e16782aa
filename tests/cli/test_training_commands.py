"""`train`, `evaluate` and `watch` as people type them."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

from tests.cli.commands import powderdsl as run
from tests.rl.tiny_tasks import write_task

QUICK = shlex.split("--envs 4 --rollout 8 --batch 16 --epochs 1 --features 8")


def test_train_evaluate_and_go_on(folder: Path) -> None:
    write_task(folder)
    trained = run(
        "train", "task.yaml", *QUICK, "--backend", "wasm", "--steps", "0.4e2", "--knob", "size=3", exits=0
    )
    assert "runs/task-seed0: 64 interactions" in trained.output
    assert re.search(r"^[\d,]+ a second: env \d+%, policy \d+%, update \d+%$", trained.output, re.MULTILINE)
    about = json.loads(Path("runs/task-seed0/run.json").read_text())
    assert about["config"]["knobs"] == {"size": 3}
    assert about["config"]["network"] == "small"
    more = json.loads(run("train", "--resume", "task-seed0", "--steps", "1e2", "--json").stdout)
    assert (more["run"], more["step"], more["speed"]["interactions"]) == ("runs/task-seed0", 128, 64)
    parts = [more["speed"].pop(part) for part in ("env", "policy", "update")]
    assert 0 < min(parts) < sum(parts) < more["speed"]["seconds"]
    table = run("evaluate", "task-seed0", "--episodes", "4", "--split", "test").output
    assert "after 128 interactions" in table
    assert [line.split()[1] for line in table.splitlines()[-3:]] == ["trained", "random", "nothing"]
    other = run("evaluate", "task.yaml", "--episodes", "4", "--json")
    splits = json.loads(other.output)["splits"]
    assert {name: list(scores) for name, scores in splits.items()} == {
        name: ["random", "nothing"] for name in ("train", "test")
    }
