"""Passes that planes cannot carry run on cells between the others: the same worlds, whichever passes those are."""

from __future__ import annotations

import pytest

import powderdsl
from powderdsl.compiler import lower
from powderdsl.ir import bits
from powderdsl.ir.bits import PassForm, choose_form, segments
from powderdsl.ir.ops import PassGraph, Program
from powderdsl.model.types import Ruleset
from powderdsl.simulation.programs import BackendProgram
from powderdsl.simulation.simulator import Simulator
from powderdsl.targets.job import MixedProgram, mixed_program
from powderdsl.targets.tensor_kind import Tensors
from powderdsl.targets.torch.program import TorchProgram
from powderdsl.targets.wasm.program import WasmProgram
from powderdsl.testing.generators.cases import Choices, random_start
from tests.compilers import skip_without_compiler
from tests.fuzz.compare import assert_same_worlds, find_difference
from tests.semantics.texts import load_text
from tests.tiers import tiered

ROWS = "\n".join("      - " + " ".join(str(1 + (5 * i + 3 * j) % 7) for j in range(21)) for i in range(21))

HEAVY = f"""\
pack: heavy
elements:
  air: {{id: 0, color: "#102030"}}
  dust: {{id: 1, color: "#FEDCBA"}}
kernels:
  wide:
    rows:
{ROWS}
fields:
  level: {{type: -500..500, at: element, default: 3}}
  light: {{type: -20..500, at: place, default: 1}}
  waves: {{type: real(-9..9), at: place}}
  marks: {{type: 0..9, at: place, resets: step}}
streams: [coin]
passes:
  mark:
    do: marks += 2 where dust and coin < 0.5
  fall:
    after: mark
    do: dust swaps below if below is air and coin < 0.3
  weigh:
    after: fall
    do:
      - light := sum(level in wide) mod 61 - marks where coin < 0.7
      - waves := waves / 2 + marks
  settle:
    after: weigh
    do:
      - dust -> air if light > 40 with chance 5%
      - level += 1 where marks > 1
"""


def spread(name: str) -> Ruleset:
    return load_text(HEAVY, "heavy.yaml") if name == "heavy" else powderdsl.load(name)


def test_a_pass_of_too_many_gates_runs_on_cells() -> None:
    """A kernel of 441 weights over numbers of eleven bits. Its rule is named, the other passes stay on planes."""
    program = lower(spread("heavy"))
    carried = {pass_.name: choose_form(program, pass_) for pass_ in program.passes}
    assert [name for name, one in carried.items() if one.planes is None] == ["weigh"]
    assert carried["weigh"].why == f"more than {bits.MAX_GATES:,} gates"
    assert carried["weigh"].place.startswith("heavy.yaml:")
    parts = segments(program)
    assert [[p.name for p in part.program.passes] for part in parts] == [
        ["mark", "fall"],
        ["weigh"],
        ["settle"],
    ]
    assert [part.planes is None for part in parts] == [False, True, False]
    assert [any(slot.resets for slot in part.program.slots) for part in parts] == [True, False, False]


@pytest.mark.parametrize("backend", tiered(["native", "wasm"], ["wasm"]))
def test_the_oracles_worlds(backend: str) -> None:
    """Two backends on rules of which one pass runs on cells, against the oracle, over steps taken one at a time."""
    rules = spread("heavy")
    skip_without_compiler(backend)
    sims = [powderdsl.compile(rules, backend=name) for name in ("reference", "torch", backend)]
    assert_same_worlds(sims, [(2, 3, 5), (9, 4, 33), (1, 2, 65)], 3)


@pytest.mark.parametrize("name", tiered(["powderworld", "heavy"], ["heavy"]))
def test_any_passes_on_cells(name: str, torch) -> None:  # type: ignore[no-untyped-def]
    """Whichever passes are kept from planes: several steps at once, with given draws, with chosen passes."""
    rules = spread(name)
    program = lower(rules)
    choices = Choices.seeded(11)
    oracle = powderdsl.compile(rules, backend="torch")
    names = [pass_.name for pass_ in program.passes]
    for number, refused in enumerate((names[0::2], names[1::2], names[-1:])):
        sim = with_refused(rules, program, refused)
        start = random_start(rules, choices, (2, 5, (7, 64, 65)[number]))
        draws = {stream.name: torch.rand(start.ids.shape) for stream in rules.streams[:1]}
        for options in ({}, {"passes": names[::3]}, {"random": draws}):
            expected = oracle.step(start.world(oracle), 3, **options)
            found = sim.step(start.world(sim), 3, **options)
            difference = find_difference(expected.state, found.state)
            assert difference is None, (difference, refused, options.keys())


def with_refused(rules: Ruleset, program: Program, refused: list[str]) -> Simulator:
    """A simulator on planes that runs some passes on cells."""

    def choose(program: Program, pass_: PassGraph) -> PassForm:
        found = choose_form(program, pass_)
        return PassForm(pass_, None, "refused here") if pass_.name in refused else found

    sim = powderdsl.compile(rules, backend="torch")
    mixed = mixed_program(
        segments(program, choose),
        lambda *parts: WasmProgram(*parts, Tensors()),
        lambda cells: TorchProgram(cells, sim.device),
    )
    assert isinstance(mixed, MixedProgram)
    sim._program = BackendProgram("wasm", mixed, lambda: TorchProgram(program, sim.device))
    return sim
