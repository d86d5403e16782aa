"""Models of some packs of a ruleset alone: the scopes of invariants and tests, without added packs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Span
from powderdsl.model.check import check
from powderdsl.model.composition.names import needs_of
from powderdsl.model.declarations import RulesetDecl
from powderdsl.model.types import Ruleset


@dataclass(frozen=True)
class Cause:
    """Something in the file of an added pack: a rule with its text, or what it does to other packs in a few words."""

    pack: str
    span: Span
    does: str
    is_rule: bool = False


@dataclass(frozen=True)
class Difference:
    """Why an invariant or a test that holds in its scope does not hold with more packs.

    `packs` are the added packs without which it would, in load order; `causes` is what in their files does it, as far
    as that is known.
    """

    packs: tuple[str, ...]
    causes: tuple[Cause, ...]

    @property
    def with_packs(self) -> str:
        """``with `steam` and `salt` ``."""
        names = [f"`{pack}`" for pack in self.packs]
        return "with " + " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def restricted(ruleset: Ruleset, packs: Iterable[str]) -> Ruleset | None:
    """The model of some of a ruleset's packs, with its parameters; None if they are not a ruleset of their own."""
    found = _checked(ruleset, packs, Reporter())
    if found is None:
        return None
    there = {param.name for param in found.params}
    return found.with_params({p.name: p.default for p in ruleset.params if p.name in there})


def remarks_alone(ruleset: Ruleset, packs: Iterable[str]) -> tuple[Diagnostic, ...] | None:
    """The diagnostics of checking some packs alone; None if they are not a ruleset of their own."""
    reporter = Reporter()
    return None if _checked(ruleset, packs, reporter) is None else reporter.diagnostics


def _checked(ruleset: Ruleset, packs: Iterable[str], reporter: Reporter) -> Ruleset | None:
    if ruleset.declared is None:
        return None
    wanted = set(packs)
    kept = [pack for pack in ruleset.declared.packs if pack.name.text in wanted]
    try:
        return check(kept, _bare(ruleset.declared.ruleset, set(ruleset.packs) - wanted), reporter)
    except CompileError:
        return None


def without(ruleset: Ruleset, pack: str) -> Ruleset | None:
    """The model without one pack and the packs that need it; None if the rest is not a ruleset."""
    assert ruleset.declared is not None
    return restricted(
        ruleset, [name for name, needs in needs_of(ruleset.declared.packs).items() if pack not in needs]
    )


def _bare(decl: RulesetDecl | None, gone: set[str]) -> RulesetDecl | None:
    """A ruleset that names nothing of packs that are gone: no channels, and no invariants if some of them are its own."""
    if decl is None:
        return None
    return replace(
        decl,
        matrix=(),
        slots=None,
        invariants=decl.invariants if gone.isdisjoint(decl.members) else (),
        base=_bare(decl.base, gone),
        beside=tuple(bare for one in decl.beside if (bare := _bare(one, gone))),
    )
