"""Defaults of fields by element: fresh cells of every kind have them, on every backend and in every tool."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.analysis.ledger import ledger
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.draw import to_numpy
from powderdsl.simulation.simulator import compile
from powderdsl.simulation.tracing import trace
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.shipped import load_task
from powderdsl.testing.pack_tests.runner import run_examples
from tests.semantics.texts import load_text, mistakes

HEAD = """\
pack: hunt
elements:
  grass: {id: 0, color: "#EDF6F9", glyph: "."}
  rabbit: {id: 1, color: "#83C5BE", mood: 3}
  fox: {id: 2, color: "#006D77"}
"""
FIELDS = """\
fields:
  energy: {type: 0..9, at: element, default: 1, rabbit: 5, wolf?: 9}
  speed: {type: vec2(-9..9), at: element, fox: "vector(1, -2)"}
  warmth: {type: real(0..1), at: element, default: 0.25, fox: 0.5}
  mood: {type: 0..9, at: element}
  loves: {type: element, at: element, of: "(rabbit, fox)", default: grass}
  looks: {type: direction, at: element, fox: left}
  awake: {type: flag, at: element, default: yes, grass: no}
also:
  fox: {loves: rabbit, energy: 7}
"""
REST = """\
passes:
  live:
    do:
      - rabbit -> fox if energy > 4
      - grass -> above if left is rabbit
    then: fox moves below leaving rabbit if below is grass and left is grass
tests:
  - fresh worlds:
      given: r . f
      after: 0 steps
      expect_fields:
        energy: 5 1 7
        speed: 0,0 0,0 1,-2
        warmth: 0.25 0.25 0.5
        mood: 3 0 0
        loves: grass grass rabbit
        looks: right right left
        awake: yes no yes
  - a transform, a move and what it leaves:
      given: |
        r . .
        . . .
      fields: {speed: "3,3"}
      after: 1 step
      expect: |
        r . .
        f . .
      expect_fields:
        energy: |
          5 1 1
          7 1 1
        speed: |
          0,0 0,0 3,3
          1,-2 3,3 3,3
        loves: |
          grass . .
          rabbit . .
"""
PACK = HEAD + FIELDS + REST


@pytest.fixture(scope="module")
def rules():
    return load_text(PACK)


def test_fresh_cells_have_their_elements_default(rules):
    assert [result.problem for result in run_examples(rules)] == ["", ""]


def test_painted_cells_are_fresh(rules):
    sim = compile(rules, backend="reference")
    world = sim.world(np.zeros((1, 2, 3), np.uint8))
    painted = sim.paint(world, where=np.eye(2, 3, dtype=bool), element="fox")
    assert to_numpy(painted["energy"])[0].tolist() == [[7, 1, 1], [1, 7, 1]]
    assert to_numpy(painted["speed"])[0, 1].tolist() == [[-2, 0, 0], [0, -2, 0]]
    replaced = sim.replace(world, ids=np.full((1, 2, 3), 1, np.uint8))
    assert (to_numpy(replaced["energy"]) == 5).all()


def test_the_ledger_and_traces_know_them(rules):
    fields = {entry.name: entry for entry in ledger(rules).fields}
    assert fields["energy"].fresh_bounds == (1, 7)
    assert "fox as 7" in fields["energy"].default
    world = compile(rules, backend="reference").world(np.array([[[1, 0]]], np.uint8))
    found = trace(world, 0, 0, 1, of=["energy"])
    assert 7 in [write.after for write in found.writes]


@pytest.mark.parametrize(
    ("fields", "code", "under"),
    [
        ("f: {type: 0..9, at: place, fox: 3}", "PD407", "fox"),
        ("f: {type: 0..9, at: element, resets: step, fox: 3}", "PD407", "fox"),
        ("f: {type: 0..9, at: element, of: rabbit, fox: 3}", "PD407", "fox"),
        ("f: {type: 0..9, at: element, fox: 12}", "PD402", "12"),
        ("f: {type: 0..9, at: element, fox: yes}", "PD401", "yes"),
        ("f: {type: 0..9, at: element, fox: energy}", "PD405", "energy"),
        ("f: {type: 0..9, at: element, wolf: 3}", "PD301", "wolf"),
        ("f: {type: 0..9, at: element, defualt: 3}", "PD108", "defualt"),
    ],
)
def test_bad_defaults(fields, code, under):
    known = "fields:\n  mood: {type: 0..9, at: element}\n  energy: {type: 0..9, at: element}\n"
    assert mistakes(f"{HEAD}{known}  {fields}\n") == [(code, under)]


def test_an_invariant_meets_every_fresh_cell():
    with pytest.raises(CompileError, match="a fresh cell has 7"):
        load_text(PACK + "invariants: [energy stays in 0..6]\n")


@pytest.mark.parametrize("backend", ["reference", "wasm"])
def test_tasks_make_fresh_cells(folder, torch, backend):
    """Worlds of tasks are drawn and acted on by code of their own."""
    (folder / "hunt.yaml").write_text(PACK.replace("energy > 4", "energy > 9"))
    (folder / "task.yaml").write_text(
        "task: hunting\nrules: hunt.yaml\nsize: [64, 64]\nfill: grass\ngenerate: [box fox rows 0:4]\n"
        "agent: {may: [rabbit, fox], speed: 9, actions: 4, steps_per_action: 0}\n"
        "reward: {each: count(rabbit)}\n"
    )
    task = load_task("task.yaml")
    program = TaskProgram(task, "train", compile(task.ruleset, backend=backend))
    episodes = program.start(torch.arange(2))
    energy = to_numpy(episodes.world["energy"])
    assert (energy[:, :4] == 7).all()
    assert (energy[:, 4:] == 1).all()
    assert to_numpy(episodes.world["speed"])[0, :, 0, 0].tolist() == [1, -2]
    assert to_numpy(episodes.world["warmth"])[0, 3:5, 0].tolist() == [0.5, 0.25]
    after, *_ = program.act(episodes, torch.tensor([[8, 8, 0, 1, 1], [8, 8, 1, 1, 1]]))
    assert to_numpy(after.world["energy"])[:, 34, 34].tolist() == [5, 7]
    assert to_numpy(after.world["speed"])[1, :, 34, 34].tolist() == [1, -2]
