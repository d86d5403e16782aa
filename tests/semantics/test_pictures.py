"""Pictures: colors that follow fields, and tints by vectors, against slow drawings cell by cell; what files may say."""

from __future__ import annotations

import json
from fractions import Fraction
from math import floor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import powderdsl
from powderdsl.diagnostics import CompileError
from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import palette, ramps, rgb
from powderdsl.system.settings import fingerprint
from powderdsl.testing.generators.cases import Choices, random_start
from powderdsl.worlds.store import load_world
from tests.cli.commands import powderdsl as run_command
from tests.fuzz import TARGETS
from tests.semantics.texts import codes, diagnosed, load_text, simulator

BACKENDS = ("reference", *TARGETS)
SIZES = [(1, 1), (3, 33), (5, 65), (16, 70)]

KILN = """\
pack: kiln
fields:
  wind: {type: vec2(-9..9), at: place, tint: {to: "#C86464", full: 5, most: 50%}}
  heat: {type: 0..255, at: place}
  glow: {type: real(-3..5), at: element}
  depth: {type: -100000..200000, default: -100000, at: place}
  wet: {type: flag, default: yes, at: place}
  tilt: {type: -7..6, at: element, of: vane}
  drift: {type: vec2(-3..3), at: element, of: vane, tint: {to: "#0040FF", full: 3}}
elements:
  air: {id: 0, color: "#102030", color_by: {field: heat, to: "#ff8000"}}
  iron: {id: 1, color: "#102030", color_by: {field: glow, from: "#FF8040", to: "#00A0FF", over: -1..2}}
  rock: {id: 2, color: "#808080", color_by: {field: depth, from: "#FF8040", to: "#00A0FF"}}
  sponge: {id: 5, color: "#808080", color_by: {field: wet, to: "#0000FF"}}
  vane: {id: 6, color: "#808080", color_by: {field: tilt, from: "#000000", to: "#FFFFFF", over: -3..3}}
  brick: {id: 9, color: "#123456"}
streams: [coin]
passes:
  burn:
    do:
      - heat += 3 where coin < 20%
      - glow += 0.1 where coin > 70%
      - depth -= 1000 where coin > 50%
      - wet := coin > 30%
      - tilt += 1 where vane and coin < 50%
      - wind += vector(coin, 0 - coin) where coin < 60%
      - drift := vector(coin, coin) where vane
"""


def ramped(ruleset: Ruleset, ids: np.ndarray, read) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Pictures uint8 [..., 3]: what docs/language/elements.md says, word by word."""
    picture = np.zeros((*ids.shape, 3), np.uint8)
    by_id = {element.id: element for element in ruleset.elements}
    for cell in np.ndindex(ids.shape):
        element = by_id[int(ids[cell])]
        if element.ramp is None:
            picture[cell] = list(bytes.fromhex(element.color[1:]))
            continue
        ramp = element.ramp
        value = min(max(Fraction(float(read(ramp.field)[cell])), Fraction(ramp.lo)), Fraction(ramp.hi))
        part = (value - ramp.lo) / (ramp.hi - ramp.lo)
        ends = zip(bytes.fromhex(ramp.start[1:]), bytes.fromhex(ramp.end[1:]), strict=True)
        picture[cell] = [floor(start + (end - start) * part + Fraction(1, 2)) for start, end in ends]
    return picture


def tinted(ruleset: Ruleset, base: np.ndarray, read) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Untinted pictures uint8 [B, H, W, 3] with the tints, cell by cell, as docs/language/elements.md says."""
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


@pytest.mark.parametrize("backend", BACKENDS)
def test_worlds_are_drawn_alike_everywhere(backend: str, torch) -> None:  # type: ignore[no-untyped-def]
    sim = simulator(KILN, backend)
    for number, (height, width) in enumerate(SIZES):
        world = random_start(sim.ruleset, Choices.seeded(number), (3, height, width)).world(sim)
        for now in (world, sim.step(world, steps=2)):
            fields = {field.name: now[field.name].numpy() for field in sim.ruleset.fields}
            plain = ramped(sim.ruleset, now.ids.numpy(), fields.__getitem__)
            picture = tinted(sim.ruleset, plain, fields.__getitem__)
            assert np.array_equal(now.rgb().numpy(), picture), (height, width)
            buffer = torch.full((5, *picture.shape[1:]), 77, dtype=torch.uint8)
            now.rgb(buffer[1:4])
            assert np.array_equal(buffer[1:4].numpy(), picture)
            assert bool((buffer[0] == 77).all() & (buffer[4] == 77).all())
            wide = torch.full((5, height, width, 6), 77, dtype=torch.uint8)
            sim.observer.rgb(now.state, wide[1:4], size=6)
            assert np.array_equal(wide[1:4, ..., :3].numpy(), picture)
            assert bool((wide[[0, 4]] == 77).all() & (wide[1:4, ..., 3:] == 0).all())
    assert (picture != plain).any()


@pytest.mark.parametrize(
    ("start", "end", "lo", "hi"),
    [
        ("#000000", "#FF0102", 0, 1),
        ("#FF00FF", "#00FF00", -5, 6),
        ("#102030", "#102030", 0, 9),
        ("#010203", "#FEFDFC", -1_000_000, 1_000_000),
    ],
)
def test_floats_change_color_at_the_next_float(start: str, end: str, lo: int, hi: int) -> None:
    """At each value where a color begins, and one float before it: no rounding decides."""
    ruleset = load_text(
        f"pack: lamp\nfields: {{power: {{type: real({lo}..{hi}), at: place}}}}\n"
        f'elements: {{bulb: {{color: "#FFFFFF", color_by: {{field: power, from: "{start}", to: "{end}"}}}}}}\n'
    )
    (ramp,) = ramps(ruleset.elements)
    values = np.concatenate(
        [ramp.starts, np.nextafter(ramp.starts, np.float32(-np.inf)), np.float32([lo, hi])]
    )
    ids, values = np.zeros((1, len(values)), np.uint8), values.astype(np.float32)[None]
    image = rgb(ids, palette(ruleset.elements), ramps=[ramp], fields={"power": values})
    assert np.array_equal(image, ramped(ruleset, ids, {"power": values}.__getitem__))


def test_colors_have_no_meaning() -> None:
    text = KILN.replace('color_by: {field: wet, to: "#0000FF"}', "")
    plain, colored = load_text(text.replace(', tint: {to: "#0040FF", full: 3}', "")), load_text(KILN)
    assert plain != colored
    assert fingerprint(plain) == fingerprint(colored)


STOVE = """\
pack: stove
needs: core
fields: {heat: {type: 0..9, at: place}}
elements:
  stove: {density: 5, color: "#303030", color_by: {field: heat, to: "#FF3000"}}
passes:
  burn:
    do: heat += 1 where stove
"""


@pytest.fixture
def stove(folder: Path) -> Path:  # type: ignore[no-untyped-def]
    path = folder / "stove.yaml"
    path.write_text(STOVE)
    (folder / "start.txt").write_text("s s\ns .\n")
    return path


def pixels(path: Path) -> set[tuple[int, ...]]:
    with Image.open(path) as image:
        return {tuple(pixel) for row in np.asarray(image.convert("RGB")).tolist() for pixel in row}


def test_pictures_of_commands(stove: Path) -> None:
    def done(words: str) -> None:
        run_command(*words.split(), exits=0)

    run = "run core+stove.yaml --world start.txt --steps 3 --backend torch --out"
    done(f"{run} a.png --scale 1")
    assert (48 + (255 - 48) // 3, 48, 48 - 48 // 3) in pixels(Path("a.png"))  # a third of the way
    done(f"{run} a.npz")
    done("render core+stove.yaml --world a.npz --out b.png --scale 1")
    assert pixels(Path("b.png")) == pixels(Path("a.png"))
    done(f"{run} a.gif --scale 1")
    done("run core+stove.yaml --world b.png --steps 0 --out c.npz")  # a color of a ramp means its element
    sim = powderdsl.compile("core+stove.yaml", backend="reference")
    assert np.array_equal(*(load_world(name, sim).ids.numpy() for name in ("c.npz", "a.npz")))


def test_show_prints_ramps(stove: Path) -> None:
    text = run_command("show", "core+stove.yaml").stdout
    assert "#303030  #303030 -> #FF3000 by heat 0..9" in text
    shown = json.loads(run_command("show", "core+stove.yaml", "--json").stdout)
    data = {element["name"]: element for element in shown["elements"]}
    ramp = {"field": "heat", "from": "#303030", "to": "#FF3000", "over": [0, 9]}
    assert data["stove"]["color_by"] == ramp
    assert data["wall"]["color_by"] is None
    model = run_command("compile", "core+stove.yaml", "--emit", "model").stdout
    assert "#303030 #303030 -> #FF3000 by heat 0..9" in model


def test_other_packs_color_elements(stove: Path) -> None:
    Path("thermal.yaml").write_text(
        'pack: thermal\nneeds: [core, stove]\nalso:\n  wall: {color_by: {field: stove.heat, to: "#FF0000", over: 2..5}}\n'
        '  stove: {color_by: {field: heat, to: "#00FF00"}}\n  oven?: {color_by: {field: heat, to: "#00FF00"}}\n'
        '  empty: {color_by: {field: moisture?, to: "#0000FF"}}\n'
    )
    ruleset, found = powderdsl.compiler.load_with_diagnostics("core+stove.yaml+thermal.yaml")
    ramps = {element.name: element.ramp for element in ruleset.elements}
    assert (ramps["wall"].field, ramps["wall"].lo, ramps["wall"].hi) == ("heat", 2, 5)
    assert ramps["stove"].end == "#00FF00"
    assert ramps["empty"] is None
    assert [one.code for one in found if one.code.startswith("PD3")] == ["PD317"]


def test_a_field_that_a_color_follows_is_used() -> None:
    assert "PD507" not in codes(KILN.replace("      - wet := coin > 30%\n", ""))


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
def test_what_a_tint_cannot_be(text: str, code: str, says: str) -> None:
    pack = f"pack: odd\nfields:\n  flow: {{{text}}}\nelements: {{air: {{color: '#FFFFFF'}}}}\n"
    (error,) = [diagnostic for diagnostic in diagnosed(pack) if diagnostic.code == code]
    assert says in str(CompileError([error]))
