"""Proofs of claims without running a world: from the ledger, from the reach of rules, or from the claim itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from powderdsl.analysis.changes import facts_of
from powderdsl.analysis.ledger import TREND_BREAKS, Ledger, Proven, Verdict
from powderdsl.model.logic.satisfy import satisfiable
from powderdsl.model.types import (
    Assign,
    Bounded,
    Claim,
    Expr,
    Local,
    Move,
    Never,
    Offset,
    Ruleset,
    Substep,
    Swap,
    Total,
    Transform,
    Unchanging,
    writes_of,
)


def prove(claim: Claim, ruleset: Ruleset, ledger: Ledger, without: frozenset[int]) -> Proven | None:
    """Return the proof that the claim holds in all worlds that start without some elements; None if none is found."""
    verdicts: list[Verdict] = []
    match claim:
        case Unchanging():
            verdicts = [ledger.unchanged(name) for name in _names(ruleset, claim.ids)]
        case Total() if claim.ids is not None:
            counted = _names(ruleset, claim.ids)
            verdicts = [ledger.keeps(counted, claim.trend)]
            if without and not all(verdicts):
                return _prove_count(claim.trend, set(counted), ledger, _names(ruleset, without))
        case Bounded():
            prop = ruleset.property(claim.field)
            if prop is not None and not prop.stored:
                return Proven(f"no rule changes `{claim.field}`")
            verdicts = [ledger.within(claim.field, claim.lo, claim.hi)]
        case Local() if (reach := horizon(ruleset)) <= claim.radius:
            return Proven(f"a cell depends on nothing beyond {reach} cells")
        case Never() if not satisfiable(facts_of(ruleset), [(claim.condition, (0, 0))]):
            return Proven("no cell can fulfill the condition", by="search")
    proofs = [verdict for verdict in verdicts if isinstance(verdict, Proven)]
    return proofs[0] if proofs and len(proofs) == len(verdicts) else None


def _prove_count(trend: str, counted: set[str], ledger: Ledger, without: list[str]) -> Proven | None:
    """The proof for a count in worlds without some elements: rules that need these cannot happen."""
    cells = frozenset(ledger.reach(name for name in ledger.elements if name not in without))
    changes = ((before in counted, after in counted) for _, before, after in ledger.possible(cells))
    if any(TREND_BREAKS[trend](after, before) for before, after in changes):
        return None
    return Proven("no rule that can fire in such worlds changes the number in this way")


def _names(ruleset: Ruleset, ids: Iterable[int]) -> list[str]:
    wanted = set(ids)
    return [element.name for element in ruleset.elements if element.id in wanted]


# The reach of a step


def horizon(ruleset: Ruleset) -> int:
    """An upper bound on the rows and columns away at which a cell may affect another one within a step.

    Each substep sees what earlier substeps saw around each cell that it reads. `step` and `row` are not cells.
    """
    seen = 0
    for pass_ in ruleset.passes:
        lets: dict[str, int] = {}
        for substep in pass_.substeps:
            for let in substep.lets:
                lets[let.name] = _sight(let.value, seen, lets)
            seen = _substep_reach(substep, seen, lets)
    return seen


def _substep_reach(substep: Substep, seen: int, lets: Mapping[str, int]) -> int:
    claims = [rule for rule in substep.rules if not isinstance(rule, Assign)]
    masks = {id(rule): _sight(rule.mask, seen, lets) for rule in substep.rules}
    reaches = [_length(rule.offset) for rule in claims if not isinstance(rule, Transform)]
    if substep.policy in ("drop_both", "first_wins") and claims:
        # A rule depends on the cells that others claim; under `first_wins`, these in turn depend on earlier rules.
        rounds = len(claims) if substep.policy == "first_wins" and reaches else 1
        widest = max(masks[id(rule)] for rule in claims)
        wide = widest + 2 * max(reaches, default=0) * rounds
        masks |= {id(rule): wide for rule in claims}
    distances = [seen]
    for rule in substep.rules:
        mask = masks[id(rule)]
        for write in writes_of(rule):
            distances.append(_length(write.offset) + max(mask, _sight(write.value, seen, lets)))
        match rule:
            case Transform():
                distances.append(max(mask, _sight(rule.target, seen, lets)))
            case Swap() | Move():
                left = rule.leaving if isinstance(rule, Move) else None
                sight = seen if left is None else max(seen, _sight(left, seen, lets))
                distances.append(_length(rule.offset) + max(mask, sight))
    return max(distances)


def _sight(expr: Expr, seen: int, lets: Mapping[str, int]) -> int:
    """The distance at which an expression sees cells, where a cell itself depends on cells `seen` away."""
    inner = max((_sight(arg, seen, lets) for arg in expr.args), default=0)
    match expr.op:
        case "element" | "property" | "field":
            return seen
        case "let":
            return lets[str(expr.value)]
        case "look":
            return _length(expr.value) + inner
        case "count" | "sum":
            return expr.value.radius + inner
    return inner


def _length(offset: Offset) -> int:
    return max(abs(offset[0]), abs(offset[1]))
