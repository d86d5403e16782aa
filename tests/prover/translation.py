"""Compares the passes of a ruleset before and after stages of the compiler, by proof."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from powderdsl.ir import stages
from powderdsl.ir.bits import NotBits
from powderdsl.ir.lower import lower_ruleset
from powderdsl.ir.ops import Program
from powderdsl.ir.text import structure
from powderdsl.model.types import Ruleset
from powderdsl.prover.equality import Side, _differ
from powderdsl.prover.solver import OutOfWork
from powderdsl.prover.symbolic import Budget, Renaming, Undecided, deep_recursion
from tests.ir.verify import verify

SECONDS = 60.0
"""Work for one pass and stage."""


class Comparison(NamedTuple):
    """A pass before and after some stages: ``equal``, ``differs``, or the reason why neither is proven: ``floats``, or an error."""

    pass_: str
    stage: str
    verdict: str


def programs(ruleset: Ruleset) -> Mapping[str, Program]:
    """The program after lowering, and after each stage, verified."""
    after = {"lower": lower_ruleset(ruleset)}
    program = after["lower"]
    for stage in stages.PIPELINE:
        program = after[stage.name] = replace(program, passes=tuple(map(stage.run, program.passes)))
    for name, program in after.items():
        verify(program, name)
    return after


def compare(
    ruleset: Ruleset,
    *,
    each_stage: bool,
    takes: Callable[[str], bool] = lambda name: True,
    seconds: float = SECONDS,
) -> Iterator[Comparison]:
    """Compare the passes after lowering with those at the end, or `each_stage` with the one before.

    Passes that a stage has not changed are left out, and those that are not taken, by name.
    """
    after = list(programs(ruleset).items())
    pairs = [*pairwise(after)] if each_stage else [(after[0], after[-1])]
    for (_, first), (stage, second) in pairs:
        for number, (one, other) in enumerate(zip(first.passes, second.passes, strict=True)):
            is_same = structure(one, places=False) == structure(other, places=False)
            if not is_same and takes(one.name):
                verdict = _verdict(ruleset, first, second, number, seconds)
                yield Comparison(one.name, stage, verdict)


def _verdict(ruleset: Ruleset, first: Program, second: Program, number: int, seconds: float) -> str:
    sides = (Side(ruleset, program, Renaming()) for program in (first, second))
    try:
        with deep_recursion():
            difference = _differ(*sides, ((number,), (number,)), Budget.of(seconds), False)
    except (NotBits, OutOfWork, Undecided) as error:
        return f"{type(error).__name__}: {error}"
    if difference is None:
        return "equal"
    transition = difference.transition
    # Arithmetic of floats is not known to the prover: what differs may be two ways to write one number.
    return "floats" if transition.questions.same or transition.symbols.comparisons else "differs"
