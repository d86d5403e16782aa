"""Modules that stand alone are worlds: the same as the simulator's, on every host, whatever a page does with them."""

from __future__ import annotations

import json
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wasmtime

import powderdsl
from powderdsl.compiler import load, shipped_tests, shipped_variants
from powderdsl.diagnostics import CompileError
from powderdsl.model.state import fitting
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.testing.generators.cases import Choices, Start, random_start
from tests.cli.commands import powderdsl as command
from tests.fuzz.rulemaker import random_ruleset
from tests.semantics.test_mixed import spread
from tests.semantics.texts import load_text
from tests.tiers import tiered
from tests.wasm.standalone_world import CHROMIUM, NODE, StandaloneWorld, in_node, job, screenshot

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
SIZES = [(9, 70), (16, 64)]
RULESETS = sorted(set(shipped_tests()) - shipped_variants())

HOLDERS = """
pack: holders
elements:
  air: {id: 3, color: '#000000'}
  jar: {id: 5, color: '#808080'}
  lid: {id: 9, color: '#F0F0F0'}
fields:
  fill: {type: -3..20, at: element, of: jar, default: 2}
  open: {type: flag, at: element}
  seen: {type: element, at: place, default: lid}
  warm: {type: real(-2..2), at: place, default: 1}
params:
  rate: {type: chance, default: 50%}
streams: [coin]
passes:
  go:
    do:
      - fill += 1 where jar and coin < rate
      - seen := jar where right is jar
      - warm := warm / 2 + 0.25 where open
"""


def states(ruleset: Ruleset, size: tuple[int, int], seed: int) -> tuple[Simulator, World, Any]:
    """A random world of the simulator, and its state as arrays without the axis of worlds."""
    sim = compile_ruleset(ruleset, backend="wasm")
    start = random_start(ruleset, Choices.seeded(seed), (1, *size)).seeded()
    world = sim.world(start.ids, 7)
    world = sim.replace(world, **start.fields)
    return sim, world, {name: value[0].numpy() for name, value in world.state.items()}


def compare(alone: StandaloneWorld, world: World) -> None:
    assert np.array_equal(alone.ids(), world.ids[0].numpy())
    for name in alone.slots:
        assert np.array_equal(alone.field(name), world.state[name][0].numpy()), name


@pytest.mark.parametrize("name", tiered(RULESETS, ["life", "margolus"]))
def test_steps_are_those_of_the_simulator(name: str) -> None:
    ruleset = load(name)
    for number, size in enumerate(SIZES):
        sim, world, state = states(ruleset, size, number)
        alone = StandaloneWorld(ruleset, size)
        alone.begin(state["element"], 7)
        compare(alone, sim.world(state["element"], 7))
        for slot in alone.slots:
            alone.take(slot, state[slot])
        for steps in (0, 1, 30):
            world = sim.step(world, steps)
            alone.call("step", steps)
            compare(alone, world)


def test_painting_is_that_of_the_simulator() -> None:
    ruleset = load("powderworld")
    sim, world, state = states(ruleset, (20, 64), 3)
    alone = StandaloneWorld(ruleset, (20, 64))
    alone.begin(state["element"], 7)
    for slot in alone.slots:
        alone.take(slot, state[slot])
    boxes = ((0, 5, 3, 9), (-4, 2, 60, 99), (19, 20, 0, 64), (7, 7, 0, 9), (30, 40, 0, 9))
    for number, (top, bottom, left, right) in enumerate(boxes):
        element = ruleset.elements[number + 1]
        mask = np.zeros((20, 64), bool)
        mask[max(top, 0) : bottom, max(left, 0) : right] = True
        alone.paint(element.id, *(bound & 0xFFFFFFFF for bound in (top, bottom, left, right)))
        world = sim.paint(world, where=mask, element=element.name)
        compare(alone, world)
    for known in (99, 256, 0xFFFFFFFF):  # not elements
        alone.paint(known, 0, 9, 0, 9)
    compare(alone, world)
    wind = world["velocity"].clone()
    wind[0, 1, 2:9, 60:64] = 1.25
    world = sim.replace(world, velocity=wind)
    alone.set("velocity", 1, (2, 9, 60, 90), 1.25)
    alone.set("velocity", 2, (2, 9, 60, 90), 9.0)  # it has two components
    compare(alone, world)
    alone.call("step", 20)
    compare(alone, sim.step(world, 20))


def test_fields_hold_only_what_rules_allow() -> None:
    """A page may write anything: it is cut to the range, and stays away from cells that cannot have it."""
    ruleset = load_text(HOLDERS, "holders.yaml")
    alone = StandaloneWorld(ruleset, (3, 4))
    alone.begin(np.array([[3, 5, 9, 5], [0, 1, 250, 5], [3, 3, 3, 3]]), 1)
    assert alone.ids().tolist() == [[3, 5, 9, 5], [3, 3, 3, 5], [3, 3, 3, 3]]
    assert alone.field("fill").tolist()[0] == [2, 2, 2, 2]
    alone.take("fill", np.full((3, 4), 90))
    assert alone.field("fill").tolist() == [[2, 20, 2, 20], [2, 2, 2, 20], [2, 2, 2, 2]]
    alone.set("fill", 0, (0, 1, 0, 2), -1e300)
    assert alone.field("fill").tolist()[0] == [2, -3, 2, 20]
    alone.set("open", 0, (0, 1, 0, 4), 7)
    assert alone.field("open").tolist()[0] == [1, 1, 1, 1]
    alone.set("seen", 0, (0, 1, 0, 1), 5)
    alone.set("seen", 0, (0, 1, 1, 2), 77)
    assert alone.field("seen").tolist()[0][:3] == [5, 3, 9]
    given = np.array(
        [[np.nan, np.inf, -np.inf, 2.0**-21], [-0.0, 1, 2, -2], [3, -3, 0.5, 2.0**-20]], np.float32
    )
    alone.take("warm", given)
    wanted = np.array([[0, 2, -2, 0], [0, 1, 2, -2], [2, -2, 0.5, 2.0**-20]], np.float32)
    assert alone.field("warm").tobytes() == wanted.tobytes()
    assert alone.call("field", 99) == 0
    alone.call("take", 99)
    sim = compile_ruleset(ruleset, backend="reference")
    world = sim.replace(sim.world(alone.ids(), 1), **{name: alone.field(name)[None] for name in alone.slots})
    for rate in (0.0, 1.0, 0.3, np.nan, -5.0):
        if not np.isnan(rate):
            params = {"holders.rate": min(max(rate, 0.0), 1.0)}
        alone.parameter(0, rate)
        alone.call("step", 3)
        world = sim.step(world, 3, params=params)
        compare(alone, world)


needs_node = pytest.mark.skipif(NODE is None, reason="no Node.js")


def same_in_v8(cases: list[tuple[Ruleset, Start]], steps: int, folder: Path, backend: str) -> None:
    """Worlds in JavaScript are those of a backend: ids, fields and velocity, by hash."""
    jobs, expected = [], []
    for ruleset, start in cases:
        jobs.append(job(ruleset, start, steps))
        sim = compile_ruleset(ruleset, backend=backend)
        later = sim.step(start.world(sim), steps, params=dict(start.params) or None)
        expected.append(
            {slot: sha256(value[0].numpy().tobytes()).hexdigest() for slot, value in later.state.items()}
        )
    assert in_node(jobs, folder) == expected


@pytest.mark.slow
@needs_node
def test_shipped_rulesets_in_v8(tmp_path: Path) -> None:
    cases = []
    for number, name in enumerate(RULESETS):
        ruleset = load(name)
        cases.append((ruleset, random_start(ruleset, Choices.seeded(number), (1, *SIZES[number % 2]))))
    same_in_v8(cases, 50, tmp_path, "wasm")


@needs_node
@pytest.mark.parametrize("seeds", tiered([range(2), range(2, 60)], [range(2)]))
def test_random_rulesets_in_v8(seeds: range, tmp_path: Path) -> None:
    cases = []
    for ruleset in filter(None, map(random_ruleset, seeds)):
        size = fitting(ruleset, 8), fitting(ruleset, 70)
        with suppress(CompileError):  # too large for planes
            standalone_module(ruleset, size)
            cases.append((ruleset, random_start(ruleset, Choices.seeded(len(cases)), (1, *size))))
    assert len(cases) >= 0.6 * len(seeds)
    same_in_v8(cases, 5, tmp_path, "torch")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_the_page_of_the_documentation_shows_falling_sand(tmp_path: Path) -> None:
    page = DOCS.read_text(encoding="utf-8")
    html = page.partition("```html\n")[2].partition("```")[0]
    assert len(html.partition("<script")[2].strip().splitlines()) <= 17  # fifteen, and the two of the element
    (tmp_path / "index.html").write_text(f"<!doctype html><body style='margin: 0'>{html}")
    command("export", "powderworld", "--out", str(tmp_path / "rules.wasm"), exits=0)
    picture = np.asarray(screenshot(tmp_path, (512, 512)).convert("RGB"))
    sand = powderdsl.load("powderworld").element("sand")
    grains = (picture == np.array([int(sand.color[i : i + 2], 16) for i in (1, 3, 5)])).all(-1)
    assert grains[16:].sum() >= 4 * 64  # cells of 8×8 pixels that have fallen


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CompileError, match="heavy does not fit into WebAssembly") as found:
        standalone_module(spread("heavy"), (8, 8))
    assert "heavy.yaml:" in str(found.value)
    with pytest.raises(CompileError, match="a world of 0×64 cells"):
        standalone_module(load("life"), (0, 64))
    out, pack = str(tmp_path / "world.wasm"), tmp_path / "holders.yaml"
    pack.write_text(HOLDERS.replace("pack: holders", "pack: holders\nside_multiple: 2"))
    for given, words in (
        ((str(pack), "--out", out, "--size", "63"), "must be a multiple of 2"),
        (("life", "--out", out, "--size", "4096"), "PD607"),
        (("life", "--out", str(tmp_path / "world.js")), "must end in .wasm"),
        (("life",), "--out"),
    ):
        assert words in command("export", *given, exits=2).stderr
    assert list(tmp_path.iterdir()) == [pack]


def test_the_command_writes_a_module_that_says_what_it_is(tmp_path: Path) -> None:
    out = tmp_path / "world.wasm"
    done = command("export", "powderworld", "--out", str(out), "--size", "24x40", "--set", "water.melt=0.25")
    assert (done.exit_code, done.stderr) == (0, "")
    assert "powderworld, 24×40 cells" in done.stdout
    code = out.read_bytes()
    assert len(code) <= 300_000
    module = wasmtime.Module(wasmtime.Engine(), code)
    assert not module.imports
    names = {one.name for one in module.exports}
    assert names == {
        *("memory", "cells", "begin", "step", "show", "field", "take", "paint", "set", "parameter", "clock")
    }
    about = json.loads(code[code.index(b'{"format"') :].decode())
    assert (about["rows"], about["columns"], about["ruleset"]) == (24, 40, "powderworld")
    assert [one["name"] for one in about["elements"]] == [
        one.name for one in powderdsl.load("powderworld").elements
    ]
    assert next(one["value"] for one in about["parameters"] if one["name"] == "water.melt") == 0.25
