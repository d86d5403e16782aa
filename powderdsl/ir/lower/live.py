"""Leaves rules out that no world lets happen: a loop writes many copies, of which few suit the loaded elements."""

from __future__ import annotations

from dataclasses import replace

from powderdsl.analysis.reactions import facts_of
from powderdsl.model.logic.budget import Budget
from powderdsl.model.logic.satisfy import Facts, satisfiable
from powderdsl.model.types import Moment, Pass, Ruleset

BUDGET = 100_000
"""Nodes evaluated for it, a tenth of a second. After that every rule stays."""


def live_passes(ruleset: Ruleset) -> tuple[Pass, ...]:
    """The passes without rules whose conditions cannot hold. What the others do is the same."""
    facts = replace(facts_of(ruleset), budget=Budget(BUDGET))
    return tuple(
        replace(one, moments=tuple(_live_moment(moment, facts) for moment in one.moments))
        for one in ruleset.passes
    )


def _live_moment(moment: Moment, facts: Facts) -> Moment:
    lets = {let.name: let.value for let in moment.lets}
    rules = tuple(
        rule for rule in moment.rules if rule.mask is None or satisfiable(facts, [(rule.mask, (0, 0))], lets)
    )
    return moment if len(rules) == len(moment.rules) else replace(moment, rules=rules)
