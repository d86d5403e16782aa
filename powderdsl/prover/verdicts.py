"""Verdicts on claims: proven, possibly broken in a transition of a step, or undecided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from powderdsl.ir.bits import NotBits
from powderdsl.model.types import Claim, Ruleset, Total
from powderdsl.prover.induction import Prover
from powderdsl.prover.questions import Model
from powderdsl.prover.solver import OutOfWork
from powderdsl.prover.symbolic import Budget, Undecided, deep_recursion


@dataclass(frozen=True)
class Judgment:
    """The result for a claim. `model` is a part of a world that breaks it if such a world can be reached."""

    is_proven: bool
    reason: str
    model: Model | None = None


def judgments(
    ruleset: Ruleset, claims: Sequence[tuple[Claim, frozenset[int]]], seconds: float
) -> list[Judgment]:
    """Judge claims about worlds that start without some elements, in order.

    `seconds` bounds the work for all of them, which is counted, so results are the same on every machine. Sums, which
    take the most work, come last, and no claim gets more than an eighth.
    """
    try:
        with deep_recursion():
            prover = Prover(ruleset, Budget.of(seconds))
            spoiler = prover.well_formed()
            if spoiler is not None:
                return [Judgment(False, f"pass `{spoiler.name}` may leave the range of a field")] * len(
                    claims
                )
            order = sorted(range(len(claims)), key=lambda number: isinstance(claims[number][0], Total))
            results = {}
            for number in order:
                rest = max(prover.budget.left - Budget.of(seconds / 8).left, 0)
                prover.budget.left -= rest
                results[number] = _judgment(prover, *claims[number])
                prover.budget.left = max(prover.budget.left, 0) + rest
            return [results[number] for number in range(len(claims))]
    except NotBits as error:
        return [Judgment(False, f"bit planes cannot express the rules: {error}")] * len(claims)
    except (OutOfWork, Undecided):
        return [Judgment(False, "the rules are too large for a proof")] * len(claims)


def _judgment(prover: Prover, claim: Claim, without: frozenset[int]) -> Judgment:
    try:
        transition = prover.broken(claim, without)
    except OutOfWork:
        return Judgment(False, "a proof takes too long: `--prove SECONDS` allows more")
    except Undecided as error:
        return Judgment(False, f"no proof is known: {error}")
    if transition is None:
        return Judgment(True, "each pass keeps it")
    return Judgment(False, f"pass `{transition.name}` may break it", transition.model)
