"""Effects of added packs on unrelated packs: values, conflicts, claims and warnings.

The packs that an author took into account are a scope, see `Composition.scope`; all others were added. A conflict, a
claim (an invariant or a test) or a warning is judged within its scope; if only added packs cause it, it is reported at
the line of the added pack.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.names import listed, words_of
from powderdsl.model.declarations import PackDecl
from powderdsl.model.types import ColorRamp
from powderdsl.syntax.parse import Syntax

CODES = ("PD501", "PD502")

CheckAlone = Callable[[tuple[str, ...], Reporter], object]
"""Checks some of the packs alone; None if there are errors."""


@dataclass(frozen=True)
class Cause:
    """A location in the file of an added pack: a rule with its text, or its effect on other packs in a few words."""

    pack: str
    span: Span
    does: str
    is_rule: bool = False


@dataclass(frozen=True)
class ScopeDifference:
    """The reason that packs outside a scope change a claim or a warning.

    `packs` are the relevant added packs, in load order; `causes` are the known locations in their files.
    """

    packs: tuple[str, ...]
    causes: tuple[Cause, ...] = ()

    @property
    def with_packs(self) -> str:
        """``with `steam` and `salt` ``."""
        return f"with {listed([f'`{pack}`' for pack in self.packs])}"


def pack_words(pack: PackDecl) -> Iterator[str]:
    """Every name in a pack's rules, sets, invariants, tests and color ramps."""
    for entry in pack.entries:
        if entry.ramp is not None:
            yield entry.ramp.field.word.rpartition(".")[2]
    lines = [*pack.lines, *pack.invariants, *(named_set.members for named_set in pack.sets)]
    lines += [line for test in pack.tests for line in test.always]
    lines += [decl.of for decl in pack.fields if decl.of is not None]
    for line in lines:
        yield from words_of(line)


# Values


GivenValue = tuple[str, Span, Syntax | ColorRamp]
"""A value that a pack sets for an element: the pack, the location, the value."""


def report_replaced(
    what: str,
    element: str,
    loser: GivenValue,
    winner: GivenValue,
    composition: Composition,
    reporter: Reporter,
) -> None:
    """Report that a pack replaces a value set by another pack: a note if it needs that pack, else a warning.

    Values of a ruleset replace values of its packs without a report; a pack that is added to it may replace them.
    """
    (before, old, lost_value), (after, new, value) = loser, winner
    needs = composition.names.needs
    # A ruleset knows the values of its packs.
    if after not in needs or _meaning(lost_value) == _meaning(value):
        return
    if before not in needs or before in needs[after]:
        reporter.report(
            "PD317", f"`{after}` replaces the `{what}` of `{element}`", new, "this value is used",
            secondary=[Label(old, f"the one that `{before}` sets")],
        )  # fmt: skip
        return
    reporter.report(
        "PD316", f"packs `{before}` and `{after}` set a different `{what}` for `{element}`", new, "this value is used",
        secondary=[Label(old, "this one is lost")],
        helps=[f"write `needs: {before}` in `{after}` if it is meant to replace it", "or remove one of them"],
    )  # fmt: skip


def _meaning(value: Syntax | ColorRamp) -> object:
    """A value as a number, or as words if it is not a number."""
    if isinstance(value, ColorRamp):
        return value
    text = " ".join(value.span.text.split())
    try:
        return Fraction(text[:-1]) / 100 if text.endswith("%") else Fraction(text)
    except (ValueError, ZeroDivisionError):
        return text


# Conflicts: users who add packs cannot change the conflicting rules. So the first rule wins, as with
# `conflicts: first_wins`, where that changes nothing for the packs that the author of the rules knew.


@dataclass
class AddedPacks:
    """Finds conflicts that a pack has only because other packs were added."""

    composition: Composition
    check_alone: CheckAlone
    _conflicts: dict[tuple[str, ...], frozenset[Span] | None] = field(default_factory=dict)

    def causes(self, pack: str, place: Span, ids: Sequence[int]) -> tuple[Cause, ...]:
        """The places in added packs that cause a conflict in `pack`; empty if it has the conflict without them.

        `place`: the span at which the conflict is reported. `ids`: elements for which the rules conflict.
        """
        packs = self.composition.packs
        words = frozenset(pack_words(packs[pack]))
        scope = self.composition.scope(pack, words)
        if len(scope) == len(packs):
            return ()
        if scope not in self._conflicts:
            self._conflicts[scope] = self._conflicts_alone(scope)
        alone = self._conflicts[scope]
        if alone is None or place in alone:
            return ()
        names = self.composition.names_by_id
        elements = [names[number] for number in dict.fromkeys(ids) if number in names]
        return tuple(cause for name in elements for cause in self._additions(name, scope, words))

    def _conflicts_alone(self, scope: tuple[str, ...]) -> frozenset[Span] | None:
        """The spans of conflicts of some packs alone; None if they have other errors."""
        reporter = Reporter()
        self.check_alone(scope, reporter)
        errors = [d for d in reporter.diagnostics if d.severity.value == "error"]
        if any(d.code not in CODES for d in errors):
            return None
        return frozenset(d.primary.span for d in errors if d.primary.span is not None)

    def _additions(self, element: str, scope: tuple[str, ...], words: frozenset[str]) -> list[Cause]:
        """The tags among some words that packs outside a scope add to an element, else their values, or the element."""
        composition = self.composition
        tags: list[Cause] = []
        values: list[Cause] = []
        for name, entry in composition.entries:
            pack = entry.pack
            if name != element or pack in scope or pack not in composition.names.needs:
                continue
            for noun, causes, scalars in (
                ("tag", tags, entry.tags),
                ("value", values, tuple(key for key, _ in entry.values)),
            ):
                for scalar in scalars:
                    word = composition.names.of(pack, scalar.word)
                    if word.rpartition(".")[2] in words:
                        causes.append(Cause(pack, scalar.span, f"adds the {noun} `{word}` to `{element}`"))
        owner = composition.elements[element]
        added = [] if owner.pack in scope else [Cause(owner.pack, owner.span, f"adds `{element}`")]
        return tags or values or added
