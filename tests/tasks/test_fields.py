"""Start worlds of tasks whose statements set fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from powderdsl.targets.array_kind import ArrayKind
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.tensors.generator import StartWorlds
from tests.cli.commands import powderdsl as run
from tests.tasks.test_episodes import task_of

HEAD = "task: t\nrules: powderworld\nsize: [8, 8]\nfill: empty\nagent: {may: any, actions: 3}\n"
BODY = """
generate:
  - box cloner rows 0:4
  - clone := sand in box columns :4
  - clone := lava in disk at (2, 0..7) radius 1
  - box cloner rows 2:3 columns 0:1
  - velocity := 0.5, -1 in box rows 6:end
splits:
  still: {generate: [box water rows 6:end]}
  blown:
    generate:
      - velocity := 2, 0
"""


def test_statements_set_fields_in_order() -> None:
    task = task_of(HEAD + BODY)
    sand, lava = (task.ruleset.element(name).id for name in ("sand", "lava"))
    program = compile_task(task, backend="reference")
    seeds = torch.arange(6)
    world = program.start(seeds).world
    clone, velocity = world["clone"], world["velocity"]
    assert set(clone[:, :4].unique().tolist()) == {0, sand, lava}
    assert (clone[:, 4:] == 0).all(), "only cloners have the field"
    assert (clone[:, 2, 0] == 0).all(), "painting again resets it"
    assert (velocity[:, 0, 6:] == 0.5).all()
    assert (velocity[:, 1, 6:] == -1).all()
    assert (velocity[:, :, :6] == 0).all()
    assert len({row.numpy().tobytes() for row in clone}) > 1, "disks are drawn"
    alone = program.start(seeds[3:4]).world
    assert (alone["clone"] == clone[3]).all()
    plain = StartWorlds(task, "train", ArrayKind()).make(np.arange(6)).fields["clone"]
    assert (np.asarray(plain[0])[np.asarray(plain[1])] == clone.numpy()[np.asarray(plain[1])]).all()
    assert not np.asarray(plain[1])[:, 4:].any()


def test_new_episodes_have_their_fields_too() -> None:
    program = compile_task(task_of(HEAD + BODY), split="blown", backend="reference")
    episodes = program.start(torch.arange(3))
    episodes = program.restart(
        program.put(episodes, torch.tensor([0, 1]), program.start(torch.tensor([7, 8]))),
        torch.tensor([False, False, True]),
        torch.arange(3),
    )
    assert (episodes.world["velocity"][:, 0] == 2).all()


def test_variants_that_set_different_fields_lie_in_one_batch() -> None:
    text = (
        HEAD
        + """
generate: [box cloner rows 0:4]
splits:
  both:
    stands:
      - stand: one
        generate: [box cloner rows 0:4, clone := sand]
      - stand: two
        generate: [frame wall]
"""
    )
    world = compile_task(task_of(text), split="both", backend="reference").start(torch.arange(4)).world
    assert [len(cells.unique()) for cells in world["clone"]] == [2, 1, 2, 1]


def test_worlds_that_differ_in_fields_alone_are_not_those_of_training(folder: Path) -> None:
    text = (
        HEAD + "generate:\n  - box cloner rows 0:4\n  - clone := sand in box rows 0:0..4\nreward: {each: 0}\n"
    )
    (folder / "task.yaml").write_text(
        text + "splits:\n  test: {generate: [box cloner rows 0:4, clone := lava]}\n"
    )
    told = run("evaluate", "task.yaml", "--episodes", 4, "--backend", "wasm", exits=0)
    assert "start as a training world does" not in told.output
