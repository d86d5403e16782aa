"""A small task, compiled once for all tests of environments."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.tasks.episodes import TaskProgram, compile_task

SMALL = """
task: small
rules: core+sand+water+wind
size: [16, 16]
fill: empty
knobs:
  disks: {default: 3, range: 1..8, about: up to how many disks there are}
regions:
  pit: box rows 11:15 columns 1:15
generate:
  - repeat 1..disks:
      - disk (sand, water, ice) at (2..13, 2..13) radius 2..4
  - box ice rows 3:6 columns 3:6
  - frame wall
agent: {may: [sand, blow], speed: 5, bins: 4, brush: 4, actions: 6, steps_per_action: 2}
reward: {each: count(sand in pit) / 10 - painted / 100}
end: {success: count(sand in pit) > 14, failure: count(water in pit) > 24}
splits:
  test:
    about: No disks.
    generate:
      - frame wall
"""


@pytest.fixture(scope="session")
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """16×16 cells, six actions; some episodes end early."""
    path = tmp_path_factory.mktemp("tasks") / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def small(task_file: Path) -> TaskProgram:
    """The small task on the backend `wasm`."""
    import torch

    torch.set_num_threads(1)
    return compile_task(str(task_file), backend="wasm")
