"""Tints by vector fields: each way of drawing against a slow one in single precision, and what files may say."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.cli.pictures import LiveView, first_world, pictures, render_frame
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError
from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import palette, ramps, rgb
from powderdsl.system.fingerprint import fingerprint
from powderdsl.testing.generators.cases import load_text, random_start
from powderdsl.testing.generators.choices import Choices
from tests.compilers import skip_without_compiler
from tests.fuzz import TARGETS

ROOT = Path(__file__).parents[2]
BACKENDS = ("reference", *TARGETS)

WEATHER = """\
pack: weather
fields:
  aim: {type: vec2(-2..2), at: place}
  wind: {type: vec2(-9..9), at: place, tint: {to: "#C86464", full: 5, most: 50%}}
  heat: {type: 0..9, at: place}
  drift: {type: vec2(-3..3), at: element, of: leaf, tint: {to: "#0040FF", full: 3}}
elements:
  air: {id: 0, color: "#ECF0F1"}
  leaf: {id: 1, color: "#26C281"}
  iron: {id: 3, color: "#102030", color_by: {field: heat, to: "#FF8000"}}
streams: [coin]
passes:
  blow:
    do:
      - wind += vector(coin, 0 - coin) where coin < 60%
      - drift := vector(coin, coin) where leaf
      - heat += 1 where coin < 30%
"""


@cache
def weather() -> Ruleset:
    return load_text(WEATHER)


def slow(ruleset: Ruleset, base: np.ndarray, read) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Untinted pictures uint8 [B, H, W, 3] with the tints, cell by cell, as docs/language.md says."""
    one, top = np.float32(1), np.float32(255)
    picture = base.copy()
    for field in ruleset.fields:
        if field.tint is None:
            continue
        full, most = np.float32(field.tint.full), np.float32(field.tint.most)
        color = [np.float32(part) / top for part in bytes.fromhex(field.tint.color[1:])]
        vectors = read(field.name)
        for world, y, x in np.ndindex(base.shape[:3]):
            row, column = vectors[world, :, y, x]
            share = min(np.sqrt(row * row + column * column) / full, most)
            for channel in range(3):
                own = np.float32(picture[world, y, x, channel]) / top
                picture[world, y, x, channel] = int((own * (one - share) + share * color[channel]) * top)
    return picture


def untinted(world: powderdsl.World) -> np.ndarray:
    rules = world.sim.ruleset
    fields = {"heat": world["heat"].numpy()}
    return np.asarray(
        rgb(world.ids.numpy(), palette(rules.elements), ramps=ramps(rules.elements), fields=fields)
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_worlds_are_drawn_alike_everywhere(backend: str, torch) -> None:  # type: ignore[no-untyped-def]
    skip_without_compiler(backend)
    sim = powderdsl.compile(weather(), backend=backend)
    for number, (height, width) in enumerate([(1, 1), (3, 33), (5, 65)]):
        world = random_start(sim.ruleset, Choices.seeded(number), (2, height, width)).world(sim)
        for now in (world, sim.step(world, 2)):
            wanted = slow(sim.ruleset, untinted(now), lambda name, now=now: now[name].numpy())
            assert np.array_equal(now.rgb().numpy(), wanted)
            buffer = torch.full((4, height, width, 3), 7, dtype=torch.uint8)
            now.rgb(buffer[1:3])
            assert np.array_equal(buffer[1:3].numpy(), wanted)
            assert bool((buffer[0] == 7).all() & (buffer[3] == 7).all())
    assert (wanted != untinted(now)).any()


def test_commands_and_the_terminal_draw_what_worlds_show(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    sim = powderdsl.compile(weather(), backend="reference")
    world = random_start(sim.ruleset, Choices.seeded(5), (1, 6, 20)).world(sim)
    image = world.rgb()[0]
    assert np.array_equal(pictures(world, most=1, factor=1), image.numpy())

    class Terminal(io.StringIO):
        encoding = "utf-8"

        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with LiveView(sim.ruleset.elements, stream, fields=sim.ruleset.fields) as view:
        view.show(**first_world(world))
    for line in render_frame(image).split("\n"):
        assert line in stream.getvalue()


def test_tints_have_no_meaning() -> None:
    plain = load_text(WEATHER.replace(', tint: {to: "#0040FF", full: 3}', ""))
    assert plain != weather()
    assert fingerprint(plain) == fingerprint(weather())


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("type: 0..9, at: place, tint: {to: '#FF0000', full: 5}", "PD401", "only vectors do"),
        ("type: vec2(-1..1), at: place, tint: {to: red, full: 5}", "PD110", "`red` is not a color"),
        ("type: vec2(-1..1), at: place, tint: {to: '#FF0000'}", "PD109", "`full`"),
        ("type: vec2(-1..1), at: place, tint: {full: 3}", "PD109", "`to`"),
        ("type: vec2(-1..1), at: place, tint: {to: '#FF0000', full: 0}", "PD402", "full"),
        ("type: vec2(-1..1), at: place, tint: {to: '#FF0000', full: 5, most: 150%}", "PD403", "150"),
        ("type: vec2(-1..1), at: place, tint: {to: '#FF0000', full: 5, least: 1}", "PD108", "least"),
        ("type: vec2(-1..1), at: place, tint: red", "PD107", "tint"),
    ],
)
def test_what_a_tint_cannot_be(text: str, code: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.yaml"
    path.write_text(f"pack: odd\nfields:\n  flow: {{{text}}}\nelements: {{air: {{color: '#FFFFFF'}}}}\n")
    with pytest.raises(CompileError) as caught:
        load_with_diagnostics(path)
    assert code in [one.code for one in caught.value.diagnostics]
    assert says in str(caught.value)
