"""Fingerprints that users' runs and datasets have recorded: rules and tasks that mean the same keep them."""

from __future__ import annotations

from powderdsl.diagnostics import Reporter, Source
from powderdsl.system.settings import fingerprint
from powderdsl.tasks.file import read_task

TASK = """task: yard
rules: core+sand+wind
size: [16, 20]
fill: empty
knobs: {many: {default: 3, range: 0..9, about: how many}}
let: {row: 3..12}
regions: {slot: box rows 4:8 columns 10:14}
targets: {wanted: [fill sand]}
generate:
  - repeat 0..many:
      - line (sand, wall) from (0..15, 0..15) to (row, 5) width 1..3
  - frame wall
agent: {may: [sand, blow], speed: 20, actions: 8}
reward:
  each: change(count(sand in slot)) / 10 - max(painted, 2) mod 3
  final: match(wanted) if share(sand in slot) > 50% and not taken == 1 else -start(count(sand and velocity.row > 1))
end: {success: count(sand in slot) >= 9 or left < 2, failure: highest(sand) != 3}
splits:
  test: {knobs: {many: 5}}
"""
RECORDED = {
    "task": "8e8ff6627fde4ef4",
    "goal": "b5ca4d0c7989337c",
    "splits": "dad27f9dfce5a554",
    "agent": "e387b8aca9904ca3",
}


def test_a_task_keeps_its_fingerprint() -> None:
    task = read_task(Source("yard.yaml", TASK), Reporter())
    found = {name: fingerprint(getattr(task, name)) for name in ("goal", "agent")}
    found["splits"] = fingerprint(task.split("train")) + fingerprint(task.split("test"))
    found["task"] = fingerprint(task)
    assert {name: value[:16] for name, value in found.items()} == RECORDED


def test_descriptions_do_not_change_a_task() -> None:
    reworded = TASK.replace("how many}", "the number of lines}").replace(
        "task: yard\n", "task: yard\nabout: Move sand.\n"
    )
    reworded = reworded.replace("test: {knobs", "test: {about: More lines., knobs")
    tasks = [read_task(Source("yard.yaml", text), Reporter()) for text in (TASK, reworded)]
    assert tasks[0] is not None
    assert fingerprint(tasks[0]) == fingerprint(tasks[1])
