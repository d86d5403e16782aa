"""Scopes of invariants and tests: the packs that their authors knew. Added packs lie outside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from powderdsl.model.composition.names import Names
from powderdsl.model.declarations import AlsoDecl, PackDecl, RulesetDecl
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar


class ClaimScopes:
    """The scopes of the claims of loaded packs and rulesets. A scope is a tuple of loaded packs, in load order."""

    def __init__(self, packs: Sequence[PackDecl], ruleset: RulesetDecl | None, names: Names) -> None:
        self._packs = [pack.name.text for pack in packs]
        self._lineage = ruleset.lineage if ruleset else ()
        self._names = names

    def of_pack(self, pack: str, words: Iterable[str] = ()) -> tuple[str, ...]:
        """The pack, what it needs, the ruleset that lists it, and the packs of some words that it uses."""
        home = next((lister for one in self._lineage if (lister := one.lister(pack))), None)
        return self._closed([pack, *(home.members if home else ()), *self._definers(pack, words)])

    def of_ruleset(self, ruleset: RulesetDecl, words: Iterable[str] = ()) -> tuple[str, ...]:
        """The ruleset's packs, what they need, and the packs of some words that it uses."""
        return self._closed([*ruleset.members, *self._definers("", words)])

    def _definers(self, pack: str, words: Iterable[str]) -> list[str]:
        owners = self._names.owners
        names = [self._names.of(pack, word) for word in words]
        return [owners[name][0] for name in names if name in owners]

    def _closed(self, packs: Iterable[str]) -> tuple[str, ...]:
        reached = {need for pack in packs for need in self._names.needs.get(pack, (pack,))}
        return tuple(pack for pack in self._packs if pack in reached)


def title_of(packs: Sequence[PackDecl], ruleset: RulesetDecl | None) -> str:
    """The title of what is loaded: a ruleset, packs left out of it, packs added: ``ruleset-pack+pack``."""
    loaded = [pack.name.text for pack in packs]
    if ruleset is None:
        return "+".join(loaded)
    named = [ruleset]
    for one in reversed(ruleset.beside):  # a ruleset that a later one extends has no title of its own
        if all(one.source.name not in {base.source.name for base in known.lineage} for known in named):
            named.insert(0, one)
    members = list(dict.fromkeys(name for one in named for name in one.members))
    gone = [f"-{name}" for name in members if name not in loaded]
    added = [f"+{name}" for name in loaded if name not in members]
    return "".join(["+".join(one.name.text for one in named), *gone, *added])


def names_left_out(ruleset: RulesetDecl | None) -> frozenset[str]:
    """The names defined by packs that a ruleset leaves out: its own lines may use them as if they ended in `?`."""
    left_out = ruleset.left_out if ruleset else ()
    return frozenset(decl.name.text for pack in left_out for decl in pack.definitions)


def with_waiting(also: AlsoDecl, names: frozenset[str]) -> AlsoDecl:
    """What a ruleset adds to an element, with a `?` behind some names."""

    def waiting(scalar: Scalar) -> Scalar:
        return replace(scalar, text=f"{scalar.text}?") if scalar.text in names else scalar

    return replace(
        also,
        name=waiting(also.name),
        tags=tuple(map(waiting, also.tags)),
        values=tuple((waiting(key), value) for key, value in also.values),
    )


def with_optional(syntax: Syntax, names: frozenset[str]) -> Syntax:
    """The expression with a `?` behind some names."""
    kind = "optional_name" if syntax.kind == "name" and syntax.text in names else syntax.kind
    return replace(
        syntax, kind=kind, children=tuple(with_optional(child, names) for child in syntax.children)
    )


def words_of(syntax: Syntax) -> Iterator[str]:
    """All words of an expression, without the `?` of optional names."""
    waiting = [syntax]
    while waiting:
        one = waiting.pop()
        if one.text:
            yield one.text.removesuffix("?")
        waiting += one.children
