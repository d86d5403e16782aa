"""Conflicts between rules of one pack that arise only because other packs were added, and the tags that cause them.

The author of the rules could not know the added packs, and users who add packs cannot change the rules. So the first
rule wins, as with `conflicts: first_wins`, where that changes nothing for the packs that the author knew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Span
from powderdsl.model.composition.compose import Composition
from powderdsl.model.logic.needless import pack_words
from powderdsl.model.types import Moment, Move, Transform

CODES = ("PD501", "PD502")

CheckAlone = Callable[[tuple[str, ...], Reporter], object]
"""Checks some of the packs alone. Raises CompileError."""


@dataclass(frozen=True)
class Given:
    """What an added pack does to an element: `word` is a tag or a value that it gives, or empty for the element itself.

    `noun` says which: ``tag`` or ``value``.
    """

    pack: str
    element: str
    noun: str
    word: str
    span: Span


@dataclass
class AddedPacks:
    """Finds conflicts that a pack has only because other packs were added to it."""

    composition: Composition
    check_alone: CheckAlone
    _conflicts: dict[tuple[str, ...], frozenset[Span] | None] = field(default_factory=dict)

    def causes(self, pack: str, place: Span, ids: Sequence[int]) -> tuple[Given, ...]:
        """The changes by added packs that cause a conflict in `pack`; empty if it has the conflict without them.

        Args:
            place: where the conflict is reported. ids: elements with which the rules meet.
        """
        composition = self.composition
        decl = next(one for one in composition.packs if one.name.text == pack)
        words = frozenset(pack_words(decl))
        scope = composition.scopes.of_pack(pack, sorted(words))
        added = [one for one in composition.packs if one.name.text not in scope]
        if not added:
            return ()
        known = self._conflicts_alone(scope)
        if known is None or place in known:
            return ()
        names = {element.id: name for name, element in composition.elements.items()}
        elements = [names[number] for number in dict.fromkeys(ids) if number in names]
        return tuple(given for one in elements for given in self._given(one, scope, words))

    def _conflicts_alone(self, scope: tuple[str, ...]) -> frozenset[Span] | None:
        """Where rules of some packs alone meet; None if something else is wrong with them."""
        if scope not in self._conflicts:
            found: tuple[Diagnostic, ...] = ()
            try:
                self.check_alone(scope, Reporter())
            except CompileError as error:
                found = error.diagnostics
            wrong = any(one.severity.value == "error" and one.code not in CODES for one in found)
            places = frozenset(one.primary.span for one in found if one.primary.span is not None)
            self._conflicts[scope] = None if wrong else places
        return self._conflicts[scope]

    def _given(self, element: str, scope: tuple[str, ...], words: frozenset[str]) -> list[Given]:
        """The tags among some words that packs outside a scope give an element, else such values, else the element itself."""
        composition = self.composition
        named = composition.element_decls[element]
        packs = {pack.name.text for pack in composition.packs}
        entries = [
            (pack, entry) for pack, name, entry in composition.entries() if name == element and pack in packs
        ]
        tags = [("tag", pack, tag) for pack, entry in entries for tag in entry.tags]
        values = [("value", pack, key) for pack, entry in entries for key, _ in entry.values]
        for several in (tags, values):
            found = [
                Given(pack, element, noun, name, scalar.span)
                for noun, pack, scalar in several
                if pack not in scope
                and (name := composition.names.of(pack, scalar.word)).rpartition(".")[2] in words
            ]
            if found:
                return found
        return [] if named.pack in scope else [Given(named.pack, element, "", "", named.span)]


def may_settle(moment: Moment) -> bool:
    """Whether `first_wins` changes nothing where no two rules meet.

    Moves may go where another one leaves, and transforms into one element may all have their effects: under the policy
    they may not.
    """
    targets = [rule.target for rule in moment.rules if isinstance(rule, Transform)]
    effects = [rule.target for rule in moment.rules if isinstance(rule, Transform) and rule.effects]
    return all(targets.count(one) == 1 for one in effects) and not any(
        isinstance(rule, Move) for rule in moment.rules
    )


def report_added(
    code: str, rules: Sequence[Span], notes: Sequence[str], causes: Sequence[Given], pass_name: str, settled: bool,
    assigns: bool, reporter: Reporter,
) -> None:  # fmt: skip
    """Report a conflict that added packs cause, at their change: a warning if `settled`, because one rule wins.

    Args:
        rules: what the rules claim. assigns: whether they assign a field.
    """
    first, *more = causes
    words = [f"`{one.word}`" for one in causes if one.word and one.element == first.element]
    several = len(words) > 1
    what = f"adds `{first.element}`"
    if words:
        listed = " and ".join([", ".join(words[:-1]), words[-1]] if several else words)
        what = f"gives `{first.element}` the {first.noun}{'s' * several} {listed}"
    message = f"`{first.pack}` {what}: two rules of `{pass_name}` may claim one cell with it"
    secondary = [Label(one.span, "and this" if one.word else "this element too") for one in more]
    secondary += [
        Label(span, "claims it too" if number else "claims the cell")
        for number, span in enumerate(dict.fromkeys(rules))
    ]
    fix = f"give `{first.element}` other values, so that it does not fulfill the conditions of both rules"
    if first.noun == "tag":
        needless = "all of them" if several else "that"
        fix = f"leave out {' or '.join(words)} here, if `{first.element}` need not be {needless}"
    holds = "the rule that stands first holds, as with `conflicts: first_wins`"
    if assigns:
        holds = "the assignment that stands last holds"
    policy = f"or ask the author of `{pass_name}` for a policy, such as `conflicts: first_wins`"
    reporter.report(
        "PD517" if settled else code, message, first.span, "because of this", secondary=secondary,
        notes=[*notes, holds] if settled else notes, helps=[fix] if settled else [fix, policy],
    )  # fmt: skip
