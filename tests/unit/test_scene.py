"""Drawn worlds: which cells shapes cover, what the statements say, and every way to write them wrongly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import powderdsl
from powderdsl.diagnostics import CODES, CompileError, Reporter, Source, Span
from powderdsl.worlds.raster import MAX_COORDINATE, Shape, mask
from powderdsl.worlds.scene import draw_start, find_scene
from powderdsl.worlds.scene.read import parse_statement, read_file, read_scenes
from powderdsl.worlds.scene.statements import STATEMENTS
from tests.refusals import refusal, refused_codes
from tests.unit.elements import RULES

ROOT = Path(__file__).resolve().parents[2]
DESIGNED = ROOT / "tasks" / "scenes" / "designed.yaml"


def picture(cells: np.ndarray) -> list[str]:
    return ["".join("x" if cell else "." for cell in row) for row in cells]


def errors(text: str) -> tuple:
    """What is wrong with a scene file: syntax first, then names."""
    reporter = Reporter()
    read_scenes(Source("test.yaml", text), reporter)
    return reporter.diagnostics


# The shapes


def test_the_largest_numbers_do_not_overflow():
    far = MAX_COORDINATE
    diagonal = mask(Shape("line", (-far, -far, far, far, 1)), (8, 8))
    assert picture(diagonal)[0] == "xx......"
    assert mask(Shape("line", (-far, far, far, -far, far)), (8, 8)).all()
    assert mask(Shape("disk", (far, far, far)), (8, 8)).sum() == 0
    assert mask(Shape("disk", (0, 0, far)), (8, 8)).all()


def test_boxes_leave_the_end_out_and_frames_follow_the_size():
    assert picture(mask(Shape("box", (1, 3, 0, 2)), (4, 4))) == ["....", "xx..", "xx..", "...."]
    assert picture(mask(Shape("box", (2, None, 3, None)), (3, 4))) == ["....", "....", "...x"]
    assert mask(Shape("box", (0, None, 0, None)), (2, 3)).all()
    assert picture(mask(Shape("frame"), (4, 3))) == ["xxx", "x.x", "x.x", "xxx"]
    assert mask(Shape("frame"), (1, 5)).all()


# The statements


def statement(text: str):
    reporter = Reporter()
    found = parse_statement(Span(Source("line", text), 0, len(text)), reporter)
    assert reporter.diagnostics == ()
    return found


@pytest.mark.parametrize(
    ("text", "element", "shape"),
    [
        ("line stone from (63, 5) to (32,-5) width 3", "stone", Shape("line", (63, 5, 32, -5, 3))),
        ("disk sand at ( 32 , 32 )radius 10", "sand", Shape("disk", (32, 32, 10))),
        ("box water rows 32:64", "water", Shape("box", (32, 64, 0, None))),
        ("box water rows 32:end columns :4", "water", Shape("box", (32, None, 0, 4))),
        ("box fire rows 48: columns 48:", "fire", Shape("box", (48, None, 48, None))),
        ("box fire columns 7", "fire", Shape("box", (0, None, 7, 8))),
        ("box fire rows :", "fire", Shape("box", (0, None, 0, None))),
        ("box fire", "fire", Shape("box", (0, None, 0, None))),
        ("frame core.wall", "core.wall", Shape("frame")),
    ],
)
def test_statements(text, element, shape):
    found = statement(text)
    assert (found.element, found.shape) == (element, shape)
    assert found.element_span.text == element
    assert found.span.text == text.partition("  #")[0]


def test_every_statement_is_written_as_its_help_says():
    values = {"ELEMENT": "sand", "ROW": "1", "COLUMN": "2", "NUMBER": "3", "A:B": "4:5", "C:D": "6:7"}
    for name, usage in STATEMENTS.items():
        for word, value in values.items():
            usage = usage.replace(word, value)
        assert statement(usage).shape.kind == name


# Files


def load_scene(place: str | Path, rules, **options) -> np.ndarray:
    return draw_start(find_scene(place), rules, **options).ids


def test_the_designed_worlds_are_the_recorded_ones_cell_for_cell():
    recorded = np.load(ROOT / "tests" / "data" / "population.npz")["start_ids"]
    names = [scene.name for scene in read_file(DESIGNED)]
    assert (names[0], names[-1]) == ("sand-on-water", "gas-flowing")
    for name, expected in zip(names, recorded, strict=True):
        for place in (name, f"{DESIGNED}#{name}"):
            found = load_scene(place, RULES)
            assert found.dtype == np.uint8
            assert np.array_equal(found, expected), name


SMALL = """scene: small
size: [4, 5]
fill: empty
draw:
  - box sand rows 2:
  - frame wall
"""


def load(tmp_path: Path, text: str, **options) -> np.ndarray:
    path = tmp_path / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path, RULES, **options)


def test_draw_may_be_a_block_with_comments_or_missing(tmp_path):
    text = """scene: small
size: [4, 5]
fill: water.ice
draw: |
  # the ground
  box sand rows 2: columns 3:

  disk water at (0, 0) radius 1   # a drop
"""
    assert load(tmp_path, text).tolist() == [[3, 6, 6, 6, 6], [6] * 5, [6, 6, 6, 2, 2], [6, 6, 6, 2, 2]]
    assert load(tmp_path, text.partition("draw")[0]).tolist() == [[6] * 5] * 4


def test_another_size_moves_the_frame_and_open_ends_and_nothing_else(tmp_path):
    text = SMALL.replace("rows 2:", "rows 2:end")
    wall = [1, 1, 1]
    assert load(tmp_path, text, size=(5, 3)).tolist() == [wall, [1, 0, 1], [1, 2, 1], [1, 2, 1], wall]


def test_elements_need_only_be_known_where_they_are_drawn():
    """A ruleset without some element still has the scenes that do not use it."""
    few = powderdsl.load("core+sand+water")
    assert load_scene(f"{DESIGNED}#sand-on-water", few).shape == (64, 64)
    errors = refusal(load_scene, f"{DESIGNED}#stone-arches", few)
    assert [(found.code, found.primary.span.text) for found in errors] == [("PD604", "stone")]
    (found,) = refusal(load_scene, "fish-tank", powderdsl.load("core+sand"))
    assert "`fish-tank` is drawn with elements that core+sand lacks: `water`, `wood`, `fish`" in found.message


# What can be wrong. Each row: the file, the code, the text under the caret.


def open_ended(text: str) -> str:
    """The span of a YAML list may end before its bracket, where its last item does."""
    return text.rstrip("]}")


HEAD = "scene: bad\nsize: [8, 8]\nfill: empty\ndraw:\n"


@pytest.mark.parametrize(
    ("line", "code", "under"),
    [
        ("disc sand at (1, 1) radius 2", "PD605", "disc"),
        ("disk at (1, 1) radius 2", "PD605", "at"),
        ("disk sand at (1, 1) raduis 2", "PD605", "raduis"),
        ("disk sand at (1 1) radius 2", "PD605", "1"),
        ("disk sand at (1, 1) radius two", "PD605", "two"),
        ("disk sand at (1, 1) radius 0", "PD606", "0"),
        ("disk sand at (1, 1) radius 2.5", "PD606", "2.5"),
        ("disk sand at (1, 1) radius 5px", "PD605", "px"),
        ("disk sand at (٣, 1) radius 2", "PD605", "٣"),
        ("disk sand at (1, 99999999999999999999) radius 2", "PD606", "99999999999999999999"),
        ("disk sand at (20, 20) radius 3", "PD608", "disk sand at (20, 20) radius 3"),
        ("line wall from (0, 0) to (3, 3)", "PD605", "\n"),
        ("box water rows 5:3", "PD606", "5:3"),
        ("box water rows -2:4", "PD606", "-2"),
        ("box water rows 1:2:3", "PD605", ":"),
        ("box water columns 1:2 rows 1:2", "PD605", "rows"),
        ("frame wall wall", "PD605", "wall"),
        ("scatter sand chance 5%", "PD605", "scatter sand chance 5%"),
        ("disk (any but sand) at (1, 1) radius 2", "PD605", "(any but sand)"),
        ("disk sand at (1..3, 1) radius 2", "PD605", "1..3"),
        ("fill sand in slot", "PD605", "slot"),
        ("fill sand over water", "PD605", "water"),
        ('"frame \\"wall\\""', "PD605", '"frame \\"wall\\""'),
        ('""', "PD605", '"'),
        ("frame " + "x" * 2000, "PD605", "f"),
        ("box water rows 2:", "PD605", "box water rows 2:"),
        ("[frame, wall]", "PD107", "[frame, wall]"),
    ],
)
def test_a_bad_statement(line, code, under):
    found = errors(f"{HEAD}  - frame wall\n  - {line}\n")
    assert [one.code for one in found] == [code]
    assert open_ended(found[0].primary.span.text) == open_ended(under)
    assert found[0].primary.span.line == 6
    assert code in CODES


@pytest.mark.parametrize(
    ("text", "code", "under"),
    [
        ("", "PD107", None),
        ("just words\n", "PD107", "just words"),
        ("scene: [a]\nsize: [8, 8]\nfill: empty\n", "PD107", "[a]"),
        ("scene: a b\nsize: [8, 8]\nfill: empty\n", "PD111", "a b"),
        ("scene: a\nsize: [8, 8]\n", "PD109", "s"),
        ("scene: a\nsize: 64\nfill: empty\n", "PD607", "64"),
        ("scene: a\nsize: [8, 8, 8]\nfill: empty\n", "PD607", "[8, 8, 8]"),
        ("scene: a\nsize: [0, 8]\nfill: empty\n", "PD607", "[0, 8]"),
        ("scene: a\nsize: [4097, 4096]\nfill: empty\n", "PD607", "[4097, 4096]"),
        ("scene: a\nsize: [8, 8]\nfill: empty\nsise: 3\n", "PD108", "sise"),
        ("scene: a\nsize: [8, 8]\nfill: empty\nfill: wall\n", "PD104", "fill"),
        ("scene: a\nsize: [8, 8]\nfill: empty\ndraw: frame wall\n", "PD107", "frame wall"),
        ("scene: a\nsize: [8, 8]\nfill: &x empty\n", "PD105", "&x"),
        ("scenes:\n  - frame wall\n", "PD107", "frame wall"),
        ("scenes: []\nscene: a\n", "PD108", "scene"),
        (
            "scenes:\n- {scene: a, size: [1, 1], fill: empty}\n- {scene: a, size: [2, 2], fill: empty}\n",
            "PD302",
            "a",
        ),
        (f"{HEAD}  - box fire rows 4: columns 4:\n", "PD103", ":"),
    ],
)
def test_a_bad_file(text, code, under):
    found = errors(text)
    assert [one.code for one in found] == [code]
    span = found[0].primary.span
    assert (span and open_ended(span.text)) == (under and open_ended(under))


def test_help_says_what_to_write():
    def helps(line: str) -> tuple[str, ...]:
        return errors(f"{HEAD}  - {line}\n")[0].helps

    assert helps("disc sand at (1, 1) radius 2") == ("did you mean `disk`?",)
    assert helps("rump sand") == ("did you mean `ramp`?",)
    assert helps("disk sand at (1, 1) raduis 2") == helps("disk sand") == (STATEMENTS["disk"],)
    assert "48:end" in helps("box water rows 2:")[0]


def test_everything_wrong_is_reported_at_once(tmp_path):
    text = """scene: bad
size: [8, 8]
fill: emty
draw:
  - disk snad at (3, 3) radius 2
  - box watr
"""
    found = [(one.code, one.primary.span.text, one.helps) for one in refusal(load, tmp_path, text)]
    assert found == [
        ("PD604", "emty", ("did you mean `empty`?",)),
        ("PD604", "snad", ("did you mean `sand`?",)),
        ("PD604", "watr", ("did you mean `water`?",)),
    ]
    lines = "  - line wall from (x1, 0) to (3, 3) width 1\n  - line wall from (1.5, 0) to (3, 2.5) width 0\n"
    numbers = errors(HEAD + lines)
    assert [one.primary.span.text for one in numbers] == ["x1", "1.5", "2.5", "0"]


@pytest.mark.parametrize("size", [(0, 5), (5, -1), (4096, 4097), (1 << 40, 1 << 40)])
def test_another_size_has_the_same_limits(tmp_path, size):
    assert refused_codes(load, tmp_path, SMALL.replace("rows 2:", "rows 2:4"), size=size) == ["PD607"]


@pytest.mark.parametrize(
    ("name", "code", "hint"),
    [
        ("stone-arch", "PD601", "did you mean `stone-arches`?"),
        ("zzz", "PD601", "sand-on-water"),
        ("nowhere.yaml", "PD101", ""),
        (str(DESIGNED), "PD601", f"{DESIGNED}#sand-on-water"),
        (f"{DESIGNED}#gas-flow", "PD601", "did you mean `gas-flowing`?"),
        ("x" * 5000, "PD601", "sand-on-water"),
        ("x" * 5000 + ".yaml", "PD101", ""),
        ("bad\0name.yaml", "PD101", ""),
        (str(ROOT / "tests"), "PD601", ""),
    ],
)
def test_unknown_scenes_are_refused(name, code, hint):
    (found,) = refusal(find_scene, name)
    assert found.code == code
    assert hint in "".join(found.helps)


def test_files_that_are_not_text_are_refused(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_bytes(b"scene: \xff\xfe")
    assert refusal(load_scene, path, RULES)[0].code == "PD101"
    path.write_bytes(b"a" * (1 << 21))
    assert refusal(load_scene, path, RULES)[0].code == "PD102"


@settings(max_examples=300, deadline=None)
@given(
    st.text(alphabet=st.sampled_from(list("diskboxlinefrmw ath(),:0123-.#'\"\t\u00e9[]{}&*!|>")), max_size=60)
)
def test_no_statement_ends_in_anything_but_a_diagnostic(text):
    reporter = Reporter()
    found = parse_statement(Span(Source("fuzz", text), 0, len(text)), reporter)
    assert (found is None) == reporter.has_errors
    str(CompileError(reporter.diagnostics))
    read_scenes(Source("fuzz", f"{HEAD}  - {text}\n"), Reporter())


def test_the_garden_is_alive_after_two_minutes():
    sim = powderdsl.compile(powderdsl.load("powderworld"))
    before = sim.step(powderdsl.load_world("garden", sim, batch=4), 7200)
    assert (sim.step(before, 60).ids != before.ids).sum((1, 2)).min() > 20
