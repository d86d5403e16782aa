"""The live view: what a terminal would show, replayed by a tiny terminal of our own."""

from __future__ import annotations

import io
import os
import re

import numpy as np
import pytest
import torch

import powderdsl
from powderdsl.cli import pictures
from powderdsl.cli.pictures import LiveView, render_frame
from powderdsl.simulation.draw import palette, rgb
from tests.unit.elements import ELEMENTS

COLORS = palette(ELEMENTS)


class Screen(io.StringIO):
    """A stream that says whether it is a terminal and remembers what was written."""

    def __init__(self, is_terminal: bool):
        super().__init__(newline="")
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


def replay(written: str) -> tuple[list[str], list[list[tuple]], bool]:
    """The characters and (ink, paper) colors that a terminal shows, and whether its cursor is visible."""
    rows: list[list[str]] = [[]]
    inks: list[list[tuple]] = [[]]
    row, ink, paper, visible = 0, None, None, True
    for code, plain in re.findall(r"\x1b\[([^a-zA-Z]*[a-zA-Z])|([^\x1b])", written):
        if plain == "\n":
            row += 1
            if row == len(rows):
                rows.append([])
                inks.append([])
        elif plain:
            rows[row].append(plain)
            inks[row].append((ink, paper))
        elif code.endswith("m"):
            numbers = tuple(map(int, code[:-1].split(";")))
            if numbers == (0,):
                ink = paper = None
            elif numbers == (49,):
                paper = None
            elif numbers[:2] == (38, 2):
                ink = numbers[2:]
            else:
                assert numbers[:2] == (48, 2), code
                paper = numbers[2:]
        elif code.endswith("F"):
            row -= int(code[:-1])
            assert row >= 0
        elif code == "2K":
            rows[row], inks[row] = [], []
        elif code == "J":
            del rows[row + 1 :], inks[row + 1 :]
            rows[row], inks[row] = [], []
        else:
            assert code in ("?25l", "?25h"), code
            visible = code == "?25h"
    assert (ink, paper) == (None, None), "colors are left on"
    return ["".join(cells) for cells in rows], inks, visible


@pytest.fixture(autouse=True)
def surroundings(monkeypatch):
    """A color terminal of 80×24, whatever the tests run in."""
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    set_size(monkeypatch, 80, 24)


def set_size(monkeypatch, columns: int, lines: int) -> None:
    monkeypatch.setattr(
        pictures.shutil, "get_terminal_size", lambda *args, **kwargs: os.terminal_size((columns, lines))
    )


@pytest.mark.parametrize("height", [1, 2, 5, 6])
def test_a_frame_shows_every_cell_in_its_color(height):
    image = rgb(np.random.default_rng(height).integers(0, 14, (height, 7)), COLORS)
    lines, colors, _ = replay(render_frame(image))
    assert lines == ["▀" * 7] * ((height + 1) // 2)
    for row in range(height):
        shown = [pair[row % 2] for pair in colors[row // 2]]
        assert shown == [tuple(pixel) for pixel in image[row].tolist()]
    if height % 2:
        assert {paper for _, paper in colors[-1]} == {None}
    assert render_frame(torch.tensor(image)) == render_frame(image)


def test_a_color_is_written_only_where_it_changes():
    plain = rgb(np.zeros((2, 1000), dtype=np.uint8), COLORS)
    assert len(render_frame(plain)) < 1060


def test_frames_are_redrawn_in_place_and_the_cursor_comes_back():
    screen = Screen(True)
    first, second = np.zeros((4, 6), dtype=np.uint8), np.full((4, 6), 3, dtype=np.uint8)
    with LiveView(ELEMENTS, screen) as view:
        view.show(first, caption="a long caption")
        assert not replay(screen.getvalue())[2]
        view.show(second, caption="step 2")
        lines, colors, _ = replay(screen.getvalue())
        assert lines == ["▀" * 6, "▀" * 6, "step 2", ""]
        water = tuple(COLORS[3, :3].tolist())
        assert colors[0] == [(water, water)] * 6
        view.show(np.zeros((2, 3), dtype=np.uint8), caption="small")
    lines, _, visible = replay(screen.getvalue())
    assert lines == ["▀▀▀", "small", ""], "something of the larger frame is left"
    assert visible


def test_motion_tints():
    screen = Screen(True)
    motion = torch.zeros((2, 2, 2))
    motion[0, 1, 1] = 9
    with LiveView(ELEMENTS, screen, fields=powderdsl.load("core+wind").fields) as view:
        view.show(torch.zeros((2, 2), dtype=torch.uint8), fields={"velocity": motion})
    _, colors, _ = replay(screen.getvalue())
    empty = tuple(COLORS[0, :3].tolist())
    assert colors[0][0] == (empty, empty)
    assert colors[0][1][0] == empty
    assert colors[0][1][1] not in (empty, None)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupt_gives_the_terminal_back_and_goes_on(error):
    screen = Screen(True)

    def watch() -> None:
        with LiveView(ELEMENTS, screen) as view:
            view.show(np.zeros((4, 4), dtype=np.uint8))
            screen.write("\x1b[38;2;1;2;3m")  # as if interrupted in the middle of a line
            raise error

    with pytest.raises(error):
        watch()
    lines, _, visible = replay(screen.getvalue())
    assert visible
    assert lines[:2] == ["▀▀▀▀"] * 2


@pytest.mark.parametrize(("is_terminal", "kind"), [(False, "xterm-256color"), (True, "dumb")])
def test_without_a_terminal_frames_are_plain_text(monkeypatch, is_terminal, kind):
    monkeypatch.setenv("TERM", kind)
    screen = Screen(is_terminal)
    with LiveView(ELEMENTS, screen) as view:
        view.show(np.array([[0, 1], [2, 3]]), caption="step 0")
        view.show(np.array([[1, 1], [1, 1]]), caption="step 1")
    assert screen.getvalue() == ".#\ns~\nstep 0\n##\n##\nstep 1\n"


def test_no_color_means_glyphs_in_place(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    screen = Screen(True)
    with LiveView(ELEMENTS, screen) as view:
        view.show(np.array([[0, 1], [2, 3]]), caption="step 0")
        view.show(np.array([[1, 1], [1, 2]]), caption="step 1")
    lines, _, visible = replay(screen.getvalue())
    assert lines == ["##", "#s", "step 1", ""]
    assert visible
    assert "38;2" not in screen.getvalue()
    monkeypatch.setenv("NO_COLOR", "")
    assert LiveView(ELEMENTS, screen).color


@pytest.mark.parametrize(("columns", "lines"), [(80, 24), (64, 34), (63, 100), (10, 5), (1, 1)])
@pytest.mark.parametrize("no_color", ["", "1"])
def test_what_is_shown_fits_the_terminal(monkeypatch, columns, lines, no_color):
    set_size(monkeypatch, columns, lines)
    monkeypatch.setenv("NO_COLOR", no_color)
    screen = Screen(True)
    with LiveView(ELEMENTS, screen) as view:
        view.show(np.zeros((64, 64), dtype=np.uint8), caption="c" * 200)
    shown, _, _ = replay(screen.getvalue())
    assert max(map(len, shown)) <= columns
    if lines > 2:
        assert len(shown) <= lines
    if (columns, lines, no_color) == (64, 34, ""):
        assert shown[:32] == ["▀" * 64] * 32  # no cell is left out where there is room
