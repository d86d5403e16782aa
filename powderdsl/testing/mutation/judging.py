"""Judges a mutant: the checker, an invariant that a world breaks, or a test notices it, or a proof that nothing can."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from powderdsl.analysis.proofs import horizon
from powderdsl.compiler import starting_backend
from powderdsl.diagnostics import CompileError
from powderdsl.model.state import slots
from powderdsl.model.text import one_line
from powderdsl.model.types import Example, Invariant, Local, Ruleset, Symmetric
from powderdsl.simulation.simulator import Simulator, compile
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.mutation.equivalence import proven_equal
from powderdsl.testing.mutation.mutants import Mutant
from powderdsl.testing.mutation.original import Batch, Invalid, Original, is_generated, lowered, meaning
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.breaks import breaks, is_paired, look, steps_for
from powderdsl.testing.properties.running import first_difference, run_sample
from powderdsl.testing.properties.samples import State

NOTICED = ("check", "invariant", "test", "generated")
"""The checks that may notice a mutant. `test`: tests written by hand; the quick ones run before invariants."""

AT_ONCE = "torch"
"""Runs the quick tests and the random worlds, which have many widths: others compile for each width."""

FEW_STEPS = 20
"""Tests of at most this many steps run before longer ones."""

PAIRED = 6
"""Batches on which invariants are tried that need more than one run of a world."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on a mutant.

    `status` is ``killed``, ``survived``, ``equivalent`` (proven) or ``invalid`` (not a rule file); `by` is one of NOTICED
    or how it was proven; `detail` is a code, an invariant's words or a test's name.
    """

    status: str
    by: str = ""
    detail: str = ""


def judge(original: Original, mutant: Mutant) -> Verdict:
    """Hold a mutant against everything that its composition says about itself, cheapest first."""
    try:
        ruleset, warnings = original.mutated(mutant)
    except Invalid:
        return Verdict("invalid")
    except CompileError as error:
        return Verdict("killed", "check", error.diagnostics[0].code)
    new = warnings - original.warnings
    if new:
        return Verdict("killed", "check", min(new))
    if meaning(ruleset) == original.meaning:
        return Verdict("equivalent", "the same model")
    sim = compile(ruleset, backend=AT_ONCE)
    differs = True
    failed = failed_test(original, sim, mutant.pack, quick=True)
    if failed is None:
        broken, differs = broken_invariant(original, sim)
        if broken is not None:
            return Verdict("killed", "invariant", one_line(broken.span))
        sim = compile(ruleset, backend=starting_backend("cpu"))
        failed = failed_test(original, sim, mutant.pack, quick=False)
    if failed is not None:
        by = "generated" if is_generated(failed) else "test"
        return Verdict("killed", by, f"{failed.pack}: {failed.name}")
    if not differs:  # proofs come last: few mutants need them
        if lowered(ruleset) == original.lowered:
            return Verdict("equivalent", "the same program")
        if proven_equal(original.ruleset, ruleset):
            return Verdict("equivalent", "the same in every case")
    return Verdict("survived")


# Tests


def failed_test(original: Original, sim: Simulator, pack: str, *, quick: bool) -> Example | None:
    """A test that the original passes and the mutant fails: one written by hand, if there is one.

    `quick`: only tests that cost less than invariants; otherwise only the others.
    """
    for some in _portions(sim.ruleset, pack, quick):
        # Without a scope: which added packs make a test fail does not matter here.
        known = tuple(replace(one, scope=()) for one in some if one.name not in original.failing)
        if known:
            results = run_examples(replace(sim.ruleset, tests=known), sim=sim)
            failed = next((one.example for one in results if not one.passed), None)
            if failed is not None:
                return failed
    return None


def _portions(ruleset: Ruleset, pack: str, quick: bool) -> Iterator[list[Example]]:
    """Tests in portions: by hand before generated, exact before counted, those of the mutated pack, short ones."""
    portions: dict[tuple[bool, bool, bool, bool], list[Example]] = {}
    for one in ruleset.tests:
        key = is_generated(one), bool(one.often), one.pack != pack, one.steps > FEW_STEPS
        if quick != (not key[0] and not key[1] and not key[3]):
            continue
        portions.setdefault(key, []).append(one)
    for (_, counted, _, _), some in sorted(portions.items(), key=lambda portion: portion[0]):
        if counted:  # each of them runs many worlds: one is enough
            yield from ([one] for one in some)
        else:
            yield some


# Invariants


@dataclass(frozen=True)
class _Mutated:
    """Runs worlds with the mutant."""

    sim: Simulator

    @property
    def ruleset(self) -> Ruleset:
        return self.sim.ruleset

    def states(self, sample: Start, steps: int, random: Mapping[str, Array] | None = None) -> list[State]:
        return run_sample(self.sim, sample, steps, random)[0]


def broken_invariant(original: Original, sim: Simulator) -> tuple[Invariant | None, bool]:
    """An invariant of the mutant that some world breaks, and whether any world ended otherwise than before.

    Only such worlds are asked about the invariants, unless elements have other properties or tags than before.
    """
    ruleset = sim.ruleset
    alike = _declared(ruleset) == _declared(original.ruleset)
    broken = original_breaks(original)
    kept = [one for number, one in enumerate(ruleset.invariants) if number not in broken]
    single = [one for one in kept if not is_paired(one.claim)]
    any_differs = False
    if same_state(original.ruleset, ruleset):
        for batch in original.batches():
            states, _ = run_sample(sim, batch.sample, batch.steps)
            differs = first_difference(batch.states, states) > 0
            any_differs |= bool(differs.any())
            asked = differs if alike else np.ones_like(differs)
            found = _broken_in(batch, original, sim, single, states, asked)
            if found is not None:
                return found, True
            if any_differs and not single:
                break
    found = next((one for one in kept if is_paired(one.claim) and _is_broken(one, original, sim)), None)
    return found, any_differs or found is not None


def _declared(ruleset: Ruleset) -> tuple[object, ...]:
    """Properties and tags of elements: conditions read them, and no world holds them."""
    return (
        [(prop.name, prop.values) for prop in ruleset.properties],
        [(element.name, element.tags) for element in ruleset.elements],
    )


def _is_broken(invariant: Invariant, original: Original, sim: Simulator) -> bool:
    """Whether some world breaks an invariant that needs more than one run of it."""
    ruleset = sim.ruleset
    if isinstance(invariant.claim, Local) and horizon(ruleset) <= invariant.claim.radius:
        return False
    if isinstance(invariant.claim, Symmetric) and ruleset.streams:
        return False  # the same draws may be used in another way, and frequencies take thousands of worlds
    runs = _Mutated(sim)
    samples = (sample.without(invariant.without, ruleset) for sample in original.samples[:PAIRED])
    return any(bool(breaks(invariant.claim, runs, sample, 1).first.any()) for sample in samples)


@lru_cache(maxsize=4)
def original_breaks(original: Original) -> frozenset[int]:
    """Places of invariants that the original itself breaks: what more packs change says nothing about a mutant."""
    found = set()
    for number, one in enumerate(original.ruleset.invariants):
        if is_paired(one.claim):
            broken = _is_broken(one, original, original.sim)
        else:
            everywhere = np.ones(1, bool)
            broken = any(
                _broken_in(batch, original, original.sim, [one], batch.states, everywhere) is not None
                for batch in original.batches()
            )
        if broken:
            found.add(number)
    return frozenset(found)


def _broken_in(
    batch: Batch,
    original: Original,
    sim: Simulator,
    invariants: list[Invariant],
    states: list[State],
    differs: Array,
) -> Invariant | None:
    for number, without in enumerate(original.withouts):
        worlds = np.nonzero(differs & (batch.group == number))[0]
        if not len(worlds):
            continue
        sample = batch.sample.select(worlds)
        some = [{name: values[worlds] for name, values in state.items()} for state in states]
        for one in invariants:
            asked = one.without == without and steps_for(one.claim, batch.steps) <= batch.steps
            if asked and look(one.claim, sim.ruleset, sample, some).first.any():
                return one
    return None


def same_state(first: Ruleset, second: Ruleset) -> bool:
    """Whether worlds of one composition hold what worlds of the other hold."""
    return slots(first) == slots(second) and [p.name for p in first.params] == [p.name for p in second.params]
