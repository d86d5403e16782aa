"""Which rule broke a claim: the last step is run by the oracle, pass by pass and substep by substep."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from powderdsl.diagnostics import Span
from powderdsl.model.types import Pass, Ruleset
from powderdsl.testing.properties.breaks import Agreement, Alike, Tested, breaks, is_paired, look
from powderdsl.testing.properties.running import reference_states, reference_step
from powderdsl.testing.properties.samples import Array, Sample, State


@dataclass(frozen=True)
class Oracle:
    """Runs worlds on the reference; the rules of the last step may be fewer than those of the steps before."""

    ruleset: Ruleset
    last: tuple[Pass, ...]

    def states(self, sample: Sample, steps: int, random: Mapping[str, Array] | None = None) -> list[State]:
        states = reference_states(self.ruleset, sample, steps - 1, random)
        cut = replace(self.ruleset, passes=self.last)
        return [*states, reference_step(cut, states[-1], sample, steps - 1, random)]


def culprits(claim: Tested, ruleset: Ruleset, sample: Sample, steps: int) -> tuple[Span, ...]:
    """The lines of rules without which the claim would not have been broken there; several if only together.

    Empty if no rule can be named: the backends disagree, or it shows only in many worlds.
    """
    if isinstance(claim, Agreement | Alike):
        return ()
    before = [] if is_paired(claim) else reference_states(ruleset, sample, steps - 1)

    def broken(last: tuple[Pass, ...]) -> bool:
        if is_paired(claim):
            return bool(breaks(claim, Oracle(ruleset, last), sample, steps).first.any())
        cut = replace(ruleset, passes=last)
        after = reference_step(cut, before[-1], sample, steps - 1)
        return bool(look(claim, ruleset, sample, [*before, after]).first.any())

    for last in _turning(ruleset.passes, broken):
        *rest, pass_ = last
        moment = pass_.moments[-1]
        lines = tuple(dict.fromkeys(rule.span for rule in moment.rules))
        alone = []
        for line in lines:
            kept = tuple(rule for rule in moment.rules if rule.span != line)
            part = replace(pass_, moments=(*pass_.moments[:-1], replace(moment, rules=kept)))
            if not broken((*rest, part)):
                alone.append(line)
        return tuple(alone) or lines
    return ()


def _turning(passes: tuple[Pass, ...], broken) -> Iterator[tuple[Pass, ...]]:  # type: ignore[no-untyped-def]
    """The beginnings of the step, each up to a substep, after which the claim is broken and was not before; last first."""
    was = [broken(passes[:count]) for count in range(len(passes) + 1)]
    for count in range(len(passes), 0, -1):
        if not was[count] or was[count - 1]:
            continue
        pass_ = passes[count - 1]
        parts = [replace(pass_, moments=pass_.moments[:end]) for end in range(1, len(pass_.moments) + 1)]
        for part in reversed(parts):
            if broken((*passes[: count - 1], part)) and not broken(
                (*passes[: count - 1], replace(part, moments=part.moments[:-1]))
            ):
                yield (*passes[: count - 1], part)
