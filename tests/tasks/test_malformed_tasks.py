"""Task files as people get them wrong: each gives one error, with its code, at its place."""

from __future__ import annotations

import re
from contextlib import suppress

import pytest

from powderdsl.diagnostics import CompileError, Reporter, Severity, Source
from powderdsl.diagnostics.diagnostic import render_text
from powderdsl.tasks.file import read_task
from powderdsl.tasks.shipped import load_task
from tests.refusals import refusal

GOOD = """task: yard
rules: powderworld
size: [16, 16]
fill: empty
knobs:
  lines: {default: 3, range: 0..9, about: how many}
let:
  row: 3..12
regions:
  slot: box rows 4:8 columns 10:14
stamps:
  hut: {scene: garden}
parts:
  ground:
    - fill sand
targets:
  wanted:
    - fill wood
generate:
  - part ground
  - repeat 0..lines:
      - line any from (0..15, 0..15) to (row, 5) width 1..3
  - frame wall
agent:
  may: [any, blow]
  speed: 20
  actions: 8
reward:
  each: count(sand in slot) / 10
end:
  success: share(sand in slot) > 50%
splits:
  test:
    parts:
      ground:
        - fill water
"""


def found(text: str) -> list[tuple[str, str, int]]:
    """Codes, what stands at the caret (its first line), and the line."""
    reporter = Reporter()
    with suppress(CompileError):
        read_task(Source("yard.yaml", text), reporter)
    assert all(render_text(one) for one in reporter.diagnostics)  # every message can be printed
    errors = [one for one in reporter.diagnostics if one.severity is Severity.ERROR]
    return [_place(one) for one in errors or reporter.diagnostics]


def _place(one) -> tuple[str, str, int]:
    span = one.primary.span
    return one.code, span.text.split("\n")[0] if span else "", span.line if span else 0


def test_the_good_one_is_good():
    assert found(GOOD) == []


MALFORMED = [
    # What is written, what is written instead, the code, the text at the caret.
    ("task: yard\n", "", "PD109", "r"),
    ("task: yard", "task: the yard", "PD111", "the yard"),
    ("rules: powderworld", "rules: powderwrld", "PD304", "powderwrld"),
    ("rules: powderworld", "rules: ../powder.yaml", "PD112", "../powder.yaml"),
    ("rules: powderworld", "rules: powderworld\nparams: {water.mlt: 5%}", "PD309", "powderworld"),
    ("rules: powderworld", "rules: powderworld\nparams: {water.melt: 500%}", "PD402", "powderworld"),
    ("size: [16, 16]", "size: 16", "PD607", "16"),
    ("size: [16, 16]", "size: [16, 2000]", "PD607", "[16, 2000]"),
    ("fill: empty", "fill: emty", "PD604", "emty"),
    ("fill: empty", "filling: empty", "PD108", "filling"),
    ("generate:", "genrate:", "PD108", "genrate"),
    # Knobs and names
    ("default: 3", "default: 30", "PD803", "30"),
    ("default: 3", "default: 3.5", "PD606", "3.5"),
    ("default: 3", "default: lnes", "PD802", "lnes"),
    ("range: 0..9", "range: 9", "PD803", "9"),
    ("range: 0..9", "range: 9..0", "PD606", "9..0"),
    ("range: 0..9, ", "", "PD109", "{"),
    ("  lines: {", "  width: {default: 1, range: 0..2}\n  lines: {", "PD311", "width"),
    ("  row: 3..12", "  row: 3..12\n  lines: 4", "PD308", "lines"),
    ("  row: 3..12", "  row: 3..12\n  sand: 4", "PD308", "sand"),
    ("  row: 3..12", "  row: 3..other", "PD802", "other"),
    ("  row: 3..12", "  row: 3..12\n  half_row: row / (row - 5)", "PD606", "row / (row - 5)"),
    ("  row: 3..12", "  row: 3..12\n  bad name: 4", "PD111", "bad name"),
    # Regions, stamps, parts
    ("box rows 4:8 columns 10:14", "box rows 4:8 columns 20:24", "PD608", "box rows 4:8 columns 20:24"),
    ("box rows 4:8 columns 10:14", "box sand rows 4:8", "PD605", "sand"),
    ("box rows 4:8 columns 10:14", "box rows rwo:8", "PD802", "rwo"),
    ("hut: {scene: garden}", "hut: {scene: gardn}", "PD601", "gardn"),
    ("hut: {scene: garden}", "hut: {legend: {}}", "PD109", "hut"),
    ("hut: {scene: garden}", "hut: {scene: /etc/passwd.txt}", "PD112", "/etc/passwd.txt"),
    ("hut: {scene: garden}", "hut:\n    art: |\n      #@", "PD610", "@"),
    ("hut: {scene: garden}", "hut:\n    art: |\n      ##\n      #", "PD611", "#"),
    ("- part ground", "- part grund", "PD802", "grund"),
    ("- fill sand", "- fill sand\n    - part ground", "PD307", "ground"),
    ("- part ground\n", "- fill sand\n", "PD507", "ground"),
    # Statements
    ("- frame wall", "- frame wal", "PD604", "wal"),
    ("- frame wall", "- fame wall", "PD605", "fame"),
    ("- frame wall", "- fill water in solt", "PD802", "solt"),
    ("- frame wall", "- stamp hat at (0, 0)", "PD802", "hat"),
    ("- frame wall", "- fill (any but any_thing)", "PD604", "any_thing"),
    ("- frame wall", "- velosity := 1, 0", "PD301", "velosity"),
    ("- frame wall", "- velocity := 5000, 0", "PD402", "5000, 0"),
    ("- frame wall", "- clone := snad", "PD110", "snad"),
    ("- frame wall", "- density := 3", "PD407", "density"),
    ("- frame wall", "- velocity := 1, 0 in box columns 20:end", "PD608", "box columns 20:end"),
    ("- frame wall", "- velocity := 1, 0 in disk at (x, 0) radius 2", "PD802", "x"),
    ("- frame wall", "- fill (first row of sand, water)", "PD606", "row"),
    ("- frame wall", "- disk sand at (row, rw) radius 5", "PD802", "rw"),
    ("- frame wall", "- disk sand at (5, 5) radius row - 3", "PD606", "row - 3"),
    ("- frame wall", "- disk sand at (5, 5) radius 15..row", "PD606", "15..row"),
    ("- frame wall", "- box sand rows row + 20:end", "PD608", "box sand rows row + 20:end"),
    ("- frame wall", "- scatter sand chance 5", "PD605", "\n"),
    ("- frame wall", "- scatter sand chance 105%", "PD606", "105"),
    ("- frame wall", "- repeat 3:", "PD109", "repeat 3"),
    ("repeat 0..lines", "repeat 0..1000", "PD606", "0..1000"),
    ("repeat 0..lines", "repeat 0..liens", "PD802", "liens"),
    ("repeat 0..lines", "repeet 0..lines", "PD605", "repeet 0..lines:"),
    ("- frame wall", "- repeat 3:\n      - repeat 2:\n          - frame wall", "PD605", "repeat 2:"),
    ("- frame wall", "- let: {a: 3}", "PD605", "let: {a: 3}"),
    ("wanted:\n    - fill wood\n", "wanted: fill wood\n", "PD107", "fill wood"),
    # Agents
    ("actions: 8", "actions: 0", "PD402", "0"),
    ("actions: 8", "actions: many", "PD110", "many"),
    ("  actions: 8\n", "", "PD109", "m"),
    ("may: [any, blow]", "may: []", "PD109", "may"),
    ("may: [any, blow]", "may: [any, wind]", "PD604", "wind"),
    ("  speed: 20\n", "", "PD109", "agent"),
    ("speed: 20", "speed: fast", "PD110", "fast"),
    ("speed: 20", "speed: 20\n  speed_field: momentum", "PD804", "momentum"),
    ("speed: 20", "speed: 20\n  brush: 17", "PD804", "17"),
    ("speed: 20", "speed: 20\n  free_steps: -1", "PD402", "-1"),
    # Rewards
    ("count(sand in slot) / 10", "count(sand in solt) / 10", "PD802", "solt"),
    ("count(sand in slot) / 10", "count(snad in slot) / 10", "PD301", "snad"),
    ("count(sand in slot) / 10", "conut(sand in slot) / 10", "PD301", "conut"),
    ("count(sand in slot) / 10", "count(sand in slot / 10", "PD201", "\n"),
    ("count(sand in slot) / 10", "sand / 10", "PD401", "sand"),
    ("count(sand in slot) / 10", "count(sand, water)", "PD406", "count(sand, water)"),
    ("count(sand in slot) / 10", "sum(sand is water in slot)", "PD201", "in"),
    ("count(sand in slot) / 10", "sum(velocity)", "PD401", "velocity"),
    ("count(sand in slot) / 10", "count(momentum)", "PD401", "momentum"),
    ("count(sand in slot) / 10", "match(wnated)", "PD802", "wnated"),
    ("count(sand in slot) / 10", "min(taken)", "PD406", "min(taken)"),
    ("count(sand in slot) / 10", "change(taken)", "PD406", "taken"),
    ("count(sand in slot) / 10", "count(interact < 5%)", "PD406", "interact < 5%"),
    ("count(sand in slot) / 10", "count(sand in slot) / 0", "PD402", "0"),
    ("count(sand in slot) / 10", "5", "PD805", "5"),
    ("count(sand in slot) / 10", "count(sand and water)", "PD805", "sand and water"),
    ("share(sand in slot) > 50%", "share(sand in slot)", "PD401", "share(sand in slot)"),
    ("share(sand in slot) > 50%", "3 > 2", "PD805", "3 > 2"),
    # Splits
    ("    parts:\n      ground:\n", "    parts:\n      groud:\n", "PD802", "groud"),
    ("  test:\n", "  test:\n    knobs: {liens: 3}\n", "PD802", "liens"),
    ("  test:\n", "  test:\n    let: {rows_: 3}\n", "PD802", "rows_"),
    ("  test:\n", "  test:\n    knobs: {lines: 1..3}\n", "PD803", "1..3"),
    ("  test:\n", "  test:\n    stands: []\n", "PD107", "[]"),
    ("  test:\n", "  test:\n    stands: [{let: {row: 4}}]\n", "PD109", "{"),
    ("  test:\n", "  te st:\n", "PD111", "te st"),
    ("  test:\n", "  train:\n", "PD302", "train"),
]  # fmt: skip


@pytest.mark.parametrize(("written", "instead", "code", "under"), MALFORMED)
def test_a_malformed_task(written, instead, code, under):
    assert GOOD.count(written) == 1
    text = GOOD.replace(written, instead)
    reports = found(text)
    assert [one[0] for one in reports] == [code], reports
    if under:
        assert reports[0][1].rstrip("]}") == under.rstrip("\n]}"), reports
    place = GOOD[: GOOD.index(written)].count("\n") + 1
    last = place + max(written.count("\n"), instead.count("\n")) + 1
    if under and code not in ("PD109", "PD507"):
        assert place - 1 <= reports[0][2] <= last, reports


def test_everything_is_reported_at_once():
    text = (
        GOOD.replace("fill: empty", "fill: emty")
        .replace("- frame wall", "- frame wal")
        .replace("actions: 8", "actions: 0")
    )
    text = text.replace("count(sand in slot)", "count(snad in solt)").replace("default: 3", "default: 30")
    assert [code for code, *_ in found(text)] == ["PD604", "PD803", "PD604", "PD402", "PD802"]


@pytest.mark.parametrize(
    "text", ["", "just words", "[1, 2]", "task: a", "task: {a: b}\nrules: []\n", "task: &x a"]
)
def test_files_that_are_not_tasks_are_refused(text):
    assert found(text)


def test_fixes_name_what_was_meant():
    for written, instead, fix in (
        ("count(sand in slot)", "count(sand in solt)", "slot"),
        ("- part ground", "- part grund", "ground"),
        ("repeat 0..lines", "repeat 0..liens", "lines"),
        ("- frame wall", "- frame wal", "wall"),
        ("generate:", "genrate:", "generate"),
        ("- frame wall", "- fame wall", "frame"),
    ):
        reporter = Reporter()
        errors = refusal(read_task, Source("yard.yaml", GOOD.replace(written, instead)), reporter)
        assert errors[0].helps == (f"did you mean `{fix}`?",)


def test_deep_and_long_files_end_well():
    deep = "1" + " + 1" * 60
    assert [one[0] for one in found(GOOD.replace("width 1..3", f"width {deep}"))] == ["PD605"]
    many = "\n".join("  - repeat 256:\n      - fill sand" for _ in range(40))
    assert {one[0] for one in found(GOOD.replace("  - frame wall", many))} == {"PD508"}
    sums = " + ".join(["count(sand)"] * 300)
    assert {one[0] for one in found(GOOD.replace("count(sand in slot) / 10", sums))} == {"PD202"}
    doubling = (
        "".join(f"  p{i}:\n" + f"    - part p{i + 1}\n" * 2 for i in range(30)) + "  p30:\n    - fill sand\n"
    )
    parts = GOOD.replace("parts:\n  ground:", f"parts:\n{doubling}  ground:").replace(
        "- part ground", "- part p0\n  - part ground"
    )
    assert {one[0] for one in found(parts)} == {"PD508"}
    nothing = parts.replace("  p30:\n    - fill sand\n", "  p30:\n    - repeat 0: [fill sand]\n")
    assert [one[0] for one in found(nothing)] == ["PD508"]  # without a single drawing
    assert re.match("PD", found("task: a\n" * 3)[0][0])


def test_rules_beside_a_task_are_found(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "pack: mine\nneeds: [core]\nelements: {salt: {id: 20, color: '#FFFFFF'}}\n", encoding="utf-8"
    )
    text = GOOD.replace("rules: powderworld", "rules: powderworld+mine.yaml").replace(
        "- fill sand", "- fill salt"
    )
    (tmp_path / "yard.yaml").write_text(text, encoding="utf-8")
    task = load_task(tmp_path / "yard.yaml")
    assert task.agent.choices == (*range(14), 20, -1)
