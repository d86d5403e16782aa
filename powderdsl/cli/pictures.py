"""Worlds as pictures: in files, or in a terminal (two cells per character in 24-bit color, or plain glyphs)."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from powderdsl.arrays import NDArray, np
from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import color_wanted
from powderdsl.diagnostics.printable import printable, raw_stream
from powderdsl.model.types import Element, Field
from powderdsl.simulation.draw import looks, rgb, shown_fields, to_numpy
from powderdsl.worlds.ascii import write_ascii

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

MAX_SIDE = 16_384
"""Maximum pixels per side: larger pictures take gigabytes before the first byte is written."""


def pictures(world: World, *, most: int, factor: int | None) -> NDArray[np.uint8]:
    """A batch as one picture: see `World.picture`. Raises BadInput for pictures of more than MAX_SIDE."""
    longest = max(world.shape[1:]) * math.ceil(math.sqrt(min(len(world), most)))
    if longest * (factor or 1) > MAX_SIDE:
        raise BadInput(
            f"a picture of {longest * (factor or 1):,} pixels a side: choose a smaller --scale or --size"
        )
    return world.picture(factor, most)


def first_world(world: World) -> dict[str, Any]:
    """The first world of a batch, as `LiveView.show` takes it: `ids` [H, W] and `fields`."""
    fields = {name: world[name][0] for name in shown_fields(world.sim.ruleset)}
    return {"ids": world.ids[0], "fields": fields}


# In a terminal

UPPER_HALF = "▀"
"""The foreground is the upper cell, the background the lower one. (`rich.live` takes 20 times as long.)"""

_RESET = "\x1b[0m"
_NO_BACKGROUND = "\x1b[49m"
_HIDE_CURSOR, _SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"
_CLEAR_LINE, _CLEAR_BELOW = "\x1b[2K", "\x1b[J"


def render_frame(image: Any) -> str:
    """A picture uint8 [H, W, 3] as ⌈H/2⌉ lines of half blocks; each line resets its colors.

    Colors are written only where they change, which keeps frames small enough for slow connections.
    """
    picture = to_numpy(image).tolist()
    lines = []
    for row in range(0, len(picture), 2):
        upper = picture[row]
        lower = picture[row + 1] if row + 1 < len(picture) else [None] * len(upper)
        pieces: list[str] = []
        ink = paper = None
        for above, below in zip(upper, lower, strict=True):
            if above != ink:
                pieces.append(f"\x1b[38;2;{above[0]};{above[1]};{above[2]}m")
            if below != paper:
                pieces.append(f"\x1b[48;2;{below[0]};{below[1]};{below[2]}m" if below else _NO_BACKGROUND)
            ink, paper = above, below
            pieces.append(UPPER_HALF)
        lines.append("".join(pieces) + _RESET)
    return "\n".join(lines)


class LiveView:
    """Show worlds one after another in place; a context manager that restores the terminal.

        with LiveView(rules.elements, fields=rules.fields) as view:
            view.show(ids, caption="step 12")

    If the output is not a terminal, frames are printed as plain text. With NO_COLOR set (https://no-color.org), glyphs
    are redrawn in place. Worlds that do not fit are thinned out. On a terminal, `fps` limits the frame rate.
    """

    def __init__(
        self,
        elements: Sequence[Element],
        stream: TextIO | None = None,
        *,
        fields: Sequence[Field] = (),
        fps: int | None = None,
    ):
        self.stream: TextIO = raw_stream(sys.stdout if stream is None else stream)
        self.elements = elements
        self.in_place = self.stream.isatty() and os.environ.get("TERM") != "dumb"
        self.color = color_wanted(self.stream)
        self._looks = looks(elements, fields)
        self._height = 0
        self._frame_seconds, self._due = 1 / fps if fps else 0.0, time.perf_counter()

    def __enter__(self) -> LiveView:
        if self.in_place:
            self._write(_HIDE_CURSOR)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # On Ctrl-C too, the frame stays on the screen, and the prompt appears below it in its usual colors.
        if self.in_place:
            self._write(_RESET + _SHOW_CURSOR)

    def show(self, ids: Any, caption: str = "", fields: Mapping[str, Any] | None = None) -> None:
        """Draw ids [H, W], an array or tensor, with `caption` below.

        `fields` maps the names of fields that pictures show to [H, W], or [2, H, W] for vectors.
        """
        ids = to_numpy(ids)
        shown = {name: to_numpy(value) for name, value in (fields or {}).items()}
        if self.in_place:
            size = shutil.get_terminal_size()
            room = max((size.lines - 2) * (2 if self.color else 1), 1)
            step = max(
                -(-ids.shape[0] // room), -(-ids.shape[1] // max(size.columns, 1)), 1
            )  # no line may wrap
            ids = ids[::step, ::step]
            shown = {name: value[..., ::step, ::step] for name, value in shown.items()}
        if self.color:
            text = render_frame(rgb(ids, fields=shown, **self._looks))
        else:
            text = write_ascii(ids, self.elements).rstrip("\n")
        caption = printable(caption)
        lines = [*text.split("\n"), caption]
        if not self.in_place:
            self._write("\n".join(lines) + "\n")
            return
        # Lines are cleared before they are written: behind a full line the cursor is on its last cell.
        lines[-1] = caption[: shutil.get_terminal_size().columns - 1]
        back = f"\x1b[{self._height}F" if self._height else ""
        self._write(back + "".join(f"{_CLEAR_LINE}{line}\n" for line in lines) + _CLEAR_BELOW)
        self._height = len(lines)
        self._due = max(self._due + self._frame_seconds, time.perf_counter())
        time.sleep(max(self._due - time.perf_counter(), 0))

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()
