"""ASCII art and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from powderdsl.diagnostics import CompileError, Reporter, Source, Span
from powderdsl.worlds import ascii as ascii_art
from powderdsl.worlds.ascii import load_ascii, parse_ascii, write_ascii
from tests.drawings import read_ascii
from tests.refusals import refusal
from tests.unit.elements import ELEMENTS

WORLDS = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 13))


def problems(text: str) -> list[tuple[str, str]]:
    return [(one.code, one.primary.span.text) for one in refusal(read_ascii, text, ELEMENTS)]


def test_glyphs_are_cells_and_whitespace_is_nothing():
    expected = [[1, 1, 1], [1, 2, 3]]
    for text in ("###\n#s~\n", "###\n#s~", "# # #\n# s ~", "\n\n  ###  \r\n\t#s ~\r\n\n"):
        ids = read_ascii(text, ELEMENTS)
        assert ids.dtype == np.uint8
        assert ids.tolist() == expected


@given(WORLDS)
def test_what_is_written_is_read_back(ids):
    assert np.array_equal(read_ascii(write_ascii(ids, ELEMENTS), ELEMENTS), ids)


def test_a_legend_wins_over_glyphs():
    # `s` is sand's glyph: with this legend it means water, and sand is written as `□`.
    drawing = Span(Source("drawing", "s□."), 0, 3)
    ids = parse_ascii(drawing, ELEMENTS, Reporter(), {"s": "water", "□": "sand.sand"})
    assert ids.tolist() == [[3, 2, 0]]
    with pytest.raises(CompileError, match=r"PD604.*`watr`[\s\S]*did you mean `water`"):
        parse_ascii(drawing, ELEMENTS, Reporter(), {"w": "watr"})


@pytest.mark.parametrize(
    ("text", "code", "under"),
    [
        ("..X\n.YX\nY..\n", "PD610", ["X", "Y"]),
        ("....\n  . . .  \n\n....\n.....\n", "PD611", [". . .", "....."]),
        ("", "PD607", [""]),
        (" \n\t\n", "PD607", [" "]),
    ],
)
def test_each_mistake_is_named_once_where_it_first_stands(text, code, under):
    assert problems(text) == [(code, one) for one in under]


def test_a_drawing_larger_than_any_world(monkeypatch):
    monkeypatch.setattr(ascii_art, "MAX_CELLS", 5)
    assert problems("...\n...\n") == [("PD607", ".")]
    assert read_ascii(".....", ELEMENTS).shape == (1, 5)


def test_spans_point_into_the_text_around_the_drawing():
    text = "given: |\n  ..\n  .X\nafter: 1 step\n"
    start, end = text.index("  .."), text.index("after")
    reporter = Reporter()
    assert parse_ascii(Span(Source("pack.yaml", text), start, end), ELEMENTS, reporter) is None
    assert [one.primary.span.place for one in reporter.diagnostics] == ["pack.yaml:3:4"]


def test_files(tmp_path):
    path = tmp_path / "world.txt"
    path.write_bytes(b"\xef\xbb\xbf##\r\n#s\r\n")
    assert load_ascii(path, ELEMENTS).tolist() == [[1, 1], [1, 2]]
    path.write_text("##\n#X\n")
    with pytest.raises(CompileError, match=r"world\.txt:2:2"):
        load_ascii(path, ELEMENTS)
    with pytest.raises(CompileError, match="PD101"):
        load_ascii(tmp_path / "nowhere.txt", ELEMENTS)
