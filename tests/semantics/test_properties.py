"""What must hold for every ruleset and every world, whatever the rules say.

Random rulesets come from seeds, as in test_differential.py; `Manner` leaves out of them what would break a property.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import powderdsl
from powderdsl.diagnostics import CompileError, Reporter, Source, Span
from powderdsl.model import reference
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, read_file
from powderdsl.model.state import SNAP, slots
from powderdsl.model.types import Assign, Move, Substep, Swap, Transform
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import Choices, random_start
from tests.fuzz.compare import find_difference
from tests.fuzz.rulemaker import Manner, random_ruleset, random_ruleset_text
from tests.semantics.texts import load_text

ANYTHING = Manner()
STEADY = Manner(draws=False, borders=False, symmetry=False)
"""Nothing random, nothing that knows where the grid ends."""
SWAPS = Manner(forms=("swap",), overwrites=False)


@cache
def simulators(manner: Manner, seeds: range) -> tuple[Simulator, ...]:
    """Simulators of random rulesets; texts that the static checks refuse are left out."""
    rulesets = (random_ruleset(seed, manner) for seed in seeds)
    return tuple(compile_ruleset(ruleset, backend="torch") for ruleset in rulesets if ruleset is not None)


def random_world(simulator: Simulator, seed: int, shape: tuple[int, int, int]) -> World:
    return random_start(simulator.ruleset, Choices.seeded(seed), shape).world(simulator)


def assert_equal(first: World, second: World) -> None:
    difference = find_difference(first.state, second.state)
    assert difference is None, f"{difference}\n{first.sim.ruleset.name}"


def test_a_saved_world_goes_on_as_if_it_had_never_stopped(tmp_path: Path) -> None:
    for number, simulator in enumerate(simulators(ANYTHING, range(60, 64))):
        middle = simulator.step(random_world(simulator, number, (2, 5, 33)), 2)
        path = tmp_path / f"world{number}.npz"
        powderdsl.save(middle, path)
        loaded = powderdsl.load_world(path, simulator)
        assert_equal(loaded, middle)
        assert_equal(simulator.step(loaded, 3), simulator.step(middle, 3))


@pytest.mark.parametrize("shape", [(2, 5, 7), (1, 33, 2)])
def test_shifted_worlds_have_shifted_futures(shape: tuple[int, int, int]) -> None:
    for number, simulator in enumerate(simulators(STEADY, range(12))):
        world = random_world(simulator, number, shape)
        dy, dx = 1 + number % 4, 1 + number % 33
        after = simulator.step(world, 2)
        shifted = {name: torch.roll(value, (dy, dx), (-2, -1)) for name, value in world.state.items()}
        moved = simulator.step(World(simulator, shifted, world.seed, world.index, world.step), 2)
        expected = {name: torch.roll(value, (dy, dx), (-2, -1)) for name, value in after.state.items()}
        assert find_difference(moved.state, expected) is None


SYMMETRIC = """
pack: symmetric
kernels:
  corner: {rows: ["1 0 2", "0 0 0", "0 -1 0"], edges: wrap}
  open: ["0 3 0", "0 0 1", "0 0 0"]
fields: {heat: {type: 0..9, at: place}, mark: {type: flag, at: element}}
elements:
  a: {id: 0, color: "#000000"}
  b: {id: 1, color: "#000001"}
  c: {id: 2, color: "#000002"}
passes:
  one:
    symmetry: SYMMETRY
    do: a -> b if above.right is c and left is a
    then:
      - heat := 4 where any(side is c for side in (left, at(0, 2), above.right))
      - mark := yes where all(opposite(side) is not b for side in (below, at(1, -2)))
  two:
    symmetry: SYMMETRY
    conflicts: drop_both
    do:
      - c swaps above.left if below is a and count(b in corner) > 0
      - b moves at(2, 1) leaving a if at(2, 1) is a and heat < 3
      - a -> c if count(a in open) > 3 and mark
  three:
    symmetry: SYMMETRY
    for side in (left, below.right):
      - b -> a if side is c and opposite(side).heat >= heat
"""


@pytest.mark.parametrize("symmetry", ["mirror", "rotations", "all"])
def test_symmetric_rules_treat_all_orientations_alike(symmetry: str) -> None:
    simulator = compile_ruleset(load_text(SYMMETRIC.replace("SYMMETRY", symmetry)), backend="wasm")
    turns = {
        "mirror": [lambda x: x.flip(-1)],
        "rotations": [lambda x, k=k: torch.rot90(x, k, (-2, -1)) for k in (1, 2, 3)],
        "all": [lambda x: x.flip(-1), lambda x: x.flip(-2), lambda x: torch.rot90(x, 1, (-2, -1)), lambda x: x.transpose(-1, -2)],
    }[symmetry]  # fmt: skip
    changed = False
    for seed in range(12):
        world = random_world(simulator, seed, (2, 9, 9))
        after = simulator.step(world, 2)
        changed = changed or find_difference(world.state, after.state) is not None
        for turn in turns:
            turned = {name: turn(value).contiguous() for name, value in world.state.items()}
            result = simulator.step(World(simulator, turned, world.seed, world.index, world.step), 2)
            assert find_difference(result.state, {name: turn(v) for name, v in after.state.items()}) is None
    assert changed


def test_swaps_conserve_what_cells_hold() -> None:
    """Swaps move an element with all its fields: the multiset of whole cells stays the same, in any shape."""
    moved = 0
    for number, simulator in enumerate(simulators(SWAPS, range(20, 36))):
        carried = [slot.name for slot in slots(simulator.ruleset) if slot.travels and not slot.resets]
        for shape in ((2, 5, 9), (1, 1, 33), (2, 31, 1), (1, 2, 2)):
            world = random_world(simulator, number, shape)
            after = simulator.step(world, 2)
            assert cells(world, carried) == cells(after, carried)
            moved += not torch.equal(world.ids, after.ids)
    assert moved >= 12


def cells(world: World, names: list[str]) -> list[list[tuple[float, ...]]]:
    """What the cells of each world hold, sorted."""
    planes = [world.state[name].double() for name in names]
    flat = [plane for value in planes for plane in (value.unbind(1) if value.ndim == 4 else (value,))]
    stacked = torch.stack(flat, -1).reshape(len(world), -1, len(flat))
    return [sorted(map(tuple, cells.tolist())) for cells in stacked]


def test_every_value_is_one_that_was_declared() -> None:
    for number, simulator in enumerate(simulators(ANYTHING, range(200, 210))):
        ruleset = simulator.ruleset
        world = simulator.step(random_world(simulator, number, (2, 4, 33)), 3)
        ids = {element.id for element in ruleset.elements}
        for slot in slots(ruleset):
            values = world.state[slot.name]
            found = set(values.unique().tolist())
            assert values.dtype == getattr(torch, slot.dtype)
            match slot.kind.name:
                case "element":
                    assert found <= ids
                case "flag":
                    assert found <= {0, 1}
                case "direction":
                    assert found <= set(range(8))
                case _:
                    assert slot.kind.lo <= min(found)
                    assert max(found) <= slot.kind.hi  # so there is no NaN either
            if slot.is_real:
                assert all(value == 0 or abs(value) >= SNAP for value in found)
            if slot.of is not None:
                elsewhere = ~torch.isin(world.ids, torch.tensor(sorted(slot.of), dtype=torch.uint8))
                parts = values.unbind(1) if slot.planes == 2 else (values,)
                usual = slot.default if isinstance(slot.default, tuple) else (slot.default,)
                for part, default in zip(parts, usual, strict=True):
                    assert bool((part[elsewhere] == torch.tensor(default).to(part.dtype)).all())
        for prop in ruleset.properties:
            if prop.stored and not any(isinstance(value, str) for value in prop.values):
                table = torch.tensor([int(value) for value in prop.values])  # type: ignore[arg-type]
                elsewhere = ~torch.isin(world.ids, torch.tensor(sorted(prop.stored), dtype=torch.uint8))
                assert torch.equal(world[prop.name][elsewhere].long(), table[world.ids.long()][elsewhere])


def test_what_is_shown_to_be_impossible_never_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Substeps without a policy have no conflicts, and rules that "can never fire" (PD503) never fire."""
    silent: set[Span] = set()
    counts = {"claims": 0, "substeps": 0, "silent": 0}
    run_substep = reference.run_substep

    def watched(substep: Substep, at: reference.Context, table: Any) -> reference.State:
        lets = dict(at.lets)
        for let in substep.lets:
            at.lets[let.name] = reference.evaluate(let.value, at)
        masks = [(rule, reference.evaluate(rule.mask, at)) for rule in substep.rules]
        for rule, mask in masks:
            if rule.span in silent:
                counts["silent"] += 1
                assert not mask.any(), f"this rule fires: {rule.span.text}"
        if substep.policy == "prove":
            counts["substeps"] += 1
            for claimed in (_sources(masks), _targets(masks)):
                for cells in claimed:
                    counts["claims"] += int(cells.sum())
                    assert cells.max(initial=0) <= 1, [rule.span.text for rule, _ in masks]
        at.lets.clear()
        at.lets.update(lets)
        return run_substep(substep, at, table)

    monkeypatch.setattr(reference, "run_substep", watched)
    for seed in range(300, 330):
        reporter = Reporter()
        pack = read_file(Source(f"seed{seed}.yaml", random_ruleset_text(seed)), reporter)
        assert isinstance(pack, PackDecl)
        try:
            ruleset = check([pack], None, reporter)
        except CompileError:
            continue
        silent.clear()
        silent |= {d.primary.span for d in reporter.diagnostics if d.code == "PD503" and d.primary.span}
        simulator = compile_ruleset(ruleset, backend="reference")
        for part, shape in enumerate(((3, 4, 6), (2, 1, 3))):
            simulator.step(random_world(simulator, seed * 2 + part, shape), 2)
    assert counts["substeps"] > 70
    assert counts["claims"] > 700
    assert counts["silent"] > 4


def _sources(masks: list[tuple[Any, Any]]) -> Iterator[Any]:
    """How often each cell is changed, swapped or left. Transforms to one target may meet."""
    movers = [mask for rule, mask in masks if isinstance(rule, (Swap, Move))]
    swapped = [_there(rule, mask) for rule, mask in masks if isinstance(rule, Swap)]
    yield _total([*movers, *swapped, *_transformed(masks)])


def _targets(masks: list[tuple[Any, Any]]) -> Iterator[Any]:
    """How often each cell is changed, swapped or moved into, and how often each field of it is assigned."""
    arrivals = [_there(rule, mask) for rule, mask in masks if isinstance(rule, (Swap, Move))]
    swapped = [mask for rule, mask in masks if isinstance(rule, Swap)]
    yield _total([*arrivals, *swapped, *_transformed(masks)])
    fields: dict[str, dict[Any, Any]] = {}
    for rule, mask in masks:
        if isinstance(rule, Assign) and rule.op == ":=":
            values = fields.setdefault(rule.field, {})
            values[rule.value] = values.get(rule.value, False) | _there(rule, mask)
    for values in fields.values():
        yield _total(list(values.values()))


def _there(rule: Any, mask: Any) -> Any:
    """The cells that a rule's offset points at."""
    return reference.look(mask, (-rule.offset[0], -rule.offset[1]))


def _transformed(masks: list[tuple[Any, Any]]) -> list[Any]:
    """Cells that change, by what they become."""
    targets: dict[Any, Any] = {}
    for rule, mask in masks:
        if isinstance(rule, Transform):
            targets[rule.target] = targets.get(rule.target, False) | mask
    return list(targets.values())


def _total(masks: list[Any]) -> Any:
    return np.sum(masks, axis=0) if masks else np.zeros(1, int)
