"""Every backend against the oracle, bit by bit: shipped rulesets, random rulesets, odd worlds.

A pair is one ruleset with one world. The random pairs are the same in every run: they come from seeds. To look at
others, or at more of them:

    POWDERDSL_SEEDS=1000..3000 pytest tests/semantics/test_differential.py -k random

A failing case says where the backends differ first, and shows the ruleset and the world;
`powderdsl.testing.reducer` makes it small.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from powderdsl.compiler import load, lower, shipped, shipped_rules
from powderdsl.diagnostics import CompileError
from powderdsl.ir.bits import lower_bits
from powderdsl.ir.ops import OPS as IR_OPS
from powderdsl.ir.ops import Node, Program
from powderdsl.model.types import OPS, Assign, Expr, Ruleset
from powderdsl.simulator import compile as compile_ruleset
from powderdsl.testing.cases import Start, load_text, random_start
from powderdsl.testing.choices import Choices
from powderdsl.testing.compare import assert_same, find_difference
from powderdsl.testing.rulemaker import random_ruleset_text
from powderdsl.testing.strategies import rulesets, worlds

BACKENDS = ("reference", "dense", "planes")
FIRST, LAST = (int(seed) for seed in os.environ.get("POWDERDSL_SEEDS", "0..250").split(".."))
CHUNK = 25
CHUNKS = range(FIRST, LAST, CHUNK)
MAX_REJECTED = 0.08
"""Share of random texts that the static checks may refuse: it is 0.014."""

PLANE_OPS = {"chance", "below_planes"}
"""What only the lowering to bit planes makes."""


@cache
def seeded_ruleset(seed: int) -> Ruleset | None:
    """The random ruleset of a seed; None if the static checks refuse it."""
    try:
        return load_text(random_ruleset_text(seed), f"seed{seed}.yaml")
    except CompileError:
        return None


def starts(ruleset: Ruleset, seed: int) -> Iterator[Start]:
    """The start worlds of a seed: five small ones, three and two a batch, the second batch wider."""
    for part, (batch, side) in enumerate(((3, 5), (2, 65))):
        choices = Choices.seeded(seed * 2 + part)
        yield random_start(ruleset, choices, (batch, *_sides(choices, side)))


def _sides(choices: Choices, limit: int) -> tuple[int, int]:
    """Rows and columns: few rows where there are many columns, so that the oracle has little to do."""
    if limit <= 5:
        return choices.whole(1, limit), choices.whole(1, limit)
    return choices.whole(1, 3), choices.pick([31, 32, 33, 63, 64, 65])


# Shipped rulesets


def compositions() -> list[str]:
    """Everything shipped, as it can be loaded: rulesets, and packs with what they need."""
    found = []
    for name in shipped_rules():
        text = (shipped("rules") / f"{name}.yaml").read_text(encoding="utf-8")
        needs = next((line for line in text.splitlines() if line.startswith("needs:")), "")
        words = needs.removeprefix("needs:").replace("[", " ").replace("]", " ").replace(",", " ").split()
        found.append("+".join([*words, name]))
    return found


@pytest.mark.parametrize("name", compositions())
def test_shipped_rulesets(name: str) -> None:
    ruleset = load(name)
    simulators = [compile_ruleset(ruleset, backend=backend) for backend in BACKENDS]
    for seed, shape in enumerate(
        [(2, 9, 33), (3, 4, 5), (2, 1, 64), (2, 65, 1), (1, 1, 1), (1, 2, 31), (1, 20, 97)]
    ):
        start = random_start(ruleset, Choices.seeded(seed), shape)
        assert_same(ruleset, start, steps=3, simulators=simulators)


# Random rulesets


@pytest.mark.parametrize("first", CHUNKS)
def test_random_rulesets(first: int) -> None:
    pairs = 0
    for seed in range(first, min(first + CHUNK, LAST)):
        ruleset = seeded_ruleset(seed)
        if ruleset is None:
            continue
        simulators = [compile_ruleset(ruleset, backend=backend) for backend in BACKENDS]
        for start in starts(ruleset, seed):
            pairs += len(start.ids)
            assert_same(ruleset, start, steps=2, simulators=simulators)
    assert pairs >= 4 * CHUNK


@settings(
    max_examples=25, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
)
@given(st.data())
def test_rulesets_that_hypothesis_finds(data: st.DataObject) -> None:
    """Fewer than the seeds give, but Hypothesis shrinks what fails."""
    ruleset = data.draw(rulesets())
    assert_same(ruleset, data.draw(worlds(ruleset, max_batch=2, max_side=33)), BACKENDS, steps=2)


def test_few_random_texts_are_refused() -> None:
    refused = [seed for seed in range(FIRST, LAST) if seeded_ruleset(seed) is None]
    assert len(refused) <= MAX_REJECTED * (LAST - FIRST), refused


def test_one_seed_one_text() -> None:
    assert random_ruleset_text(7) == random_ruleset_text(7)
    assert len({random_ruleset_text(seed) for seed in range(20)}) == 20


def test_draws_from_outside() -> None:
    """Draws that the caller gives count the same on every backend; extremes among them."""
    generator = np.random.default_rng(5)
    for seed in range(FIRST, FIRST + 12):
        ruleset = seeded_ruleset(seed)
        if ruleset is None or not ruleset.streams:
            continue
        start = random_start(ruleset, Choices.seeded(seed), (2, 3, 33))
        edges = [0.0, 0.5, 0.05, 1 - 2.0**-24, 2.0**-16, 0.2]
        draws = {
            stream.name: np.where(generator.random(start.ids.shape) < 0.5, generator.random(start.ids.shape), generator.choice(edges, start.ids.shape))
            for stream in ruleset.streams
        }  # fmt: skip
        assert_same(ruleset, start, BACKENDS, random=draws)


# What the random rulesets are made of


def expressions(ruleset: Ruleset) -> Iterator[Expr]:
    """Every expression of a ruleset and every part of it."""
    for pass_ in ruleset.passes:
        for moment in pass_.moments:
            tops = [let.value for let in moment.lets]
            for rule in moment.rules:
                effects = () if isinstance(rule, Assign) else rule.effects
                tops += [
                    top
                    for top in (rule.mask, getattr(rule, "value", None), getattr(rule, "target", None))
                    if top is not None
                ]
                tops += [effect.value for effect in effects]
            for top in tops:
                yield from top.walk()


def ir_nodes(program: Program) -> Iterator[Node]:
    """Every node of a program."""
    for pass_ in program.passes:
        seen: set[Node] = set()
        stack = [node for _, node in pass_.outputs] + [
            node for step in pass_.moments for _, node in step.writes
        ]
        while stack:
            node = stack.pop()
            if node not in seen:
                seen.add(node)
                yield node
                stack.extend(node.args)


def test_random_rulesets_use_all_of_the_model() -> None:
    ops: Counter[tuple[str, str]] = Counter()
    forms: Counter[str] = Counter()
    policies: Counter[str] = Counter()
    updates: Counter[str] = Counter()
    for seed in range(FIRST, LAST):
        ruleset = seeded_ruleset(seed)
        if ruleset is None:
            continue
        ops.update((expr.op, expr.kind.name) for expr in expressions(ruleset))
        for moment in (moment for pass_ in ruleset.passes for moment in pass_.moments):
            forms.update(type(rule).__name__ for rule in moment.rules)
            policies[moment.policy] += 1
            for rule in moment.rules:
                updates.update(a.op for a in ([rule] if isinstance(rule, Assign) else rule.effects))
    assert {op for op, _ in ops} == OPS.keys()
    assert {"Transform", "Swap", "Move", "Assign"} == forms.keys()
    assert {"prove", "drop_both", "first_wins"} == policies.keys()
    assert {":=", "+=", "-="} == updates.keys()
    for op in ("look", "choose", "field", "const", "let"):
        kinds = {"flag", "int", "element", "direction", "real", "vec2"} - (
            {"direction"} if op == "const" else set()
        )
        assert kinds - {"vec2" if op == "const" else ""} <= {kind for name, kind in ops if name == op}, op
    assert {"int", "real", "vec2"} <= {kind for name, kind in ops if name == "sum"}
    assert {"int", "real", "vec2", "draw"} <= {kind for name, kind in ops if name == "add"}


def test_random_rulesets_use_all_of_the_ir() -> None:
    ops: set[str] = set()
    plane_ops: set[str] = set()
    for seed in range(FIRST, min(LAST, FIRST + 150)):
        ruleset = seeded_ruleset(seed)
        if ruleset is not None:
            program = lower(ruleset)
            ops |= {node.op for node in ir_nodes(program)}
            plane_ops |= {node.op for node in ir_nodes(lower_bits(program))}
    assert ops >= IR_OPS.keys() - PLANE_OPS
    assert plane_ops >= PLANE_OPS & IR_OPS.keys()


# The comparison itself


def test_a_difference_is_found_and_located() -> None:
    ruleset = load_text(
        "pack: p\nfields: {f: {type: 0..9, at: place}}\nelements: {a: {id: 0, color: '#000000'}}\n"
        "passes:\n  first: {do: f += 1}\n  second: {do: f += step mod 2}\n"
    )
    start = Start(np.zeros((2, 3, 4), np.uint8))
    right, wrong = compile_ruleset(ruleset, backend="reference"), compile_ruleset(ruleset, backend="dense")
    assert_same(ruleset, start, simulators=[right, wrong], steps=3)
    step = wrong.step

    def broken(world, **options):  # type: ignore[no-untyped-def]
        after = step(world, **options)
        if int(after.step[0]) < 2:
            return after
        values = after["f"].clone()
        values[1, 2, 3] = 7
        return wrong.replace(after, f=values)

    wrong.step = broken  # type: ignore[method-assign]
    with pytest.raises(
        AssertionError, match=r"differ in step 2: `f` at \(1, 2, 3\): 3 and 7 \(1 differ\)"
    ) as found:
        assert_same(ruleset, start, simulators=[right, wrong], steps=3)
    assert "f += step mod 2" in str(found.value)


def test_floats_are_compared_by_their_bits() -> None:
    one = np.array([1.0, 0.0, np.nan], np.float32)
    assert find_difference({"f": one}, {"f": np.array([1.0, -0.0, np.nan], np.float32)}) is None
    difference = find_difference(
        {"f": one}, {"f": np.array([np.nextafter(np.float32(1), 2), 0.0, np.nan], np.float32)}
    )
    assert difference is not None
    assert difference.cell == (0,)
    assert find_difference({"f": one}, {"f": one.astype(np.float64)}) is not None
