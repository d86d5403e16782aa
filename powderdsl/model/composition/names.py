"""Name resolution: one namespace over all packs, in which packs that do not know each other may clash."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.declarations import Definition, PackDecl, ParamDecl
from powderdsl.syntax.yaml_tree import Scalar

T = TypeVar("T", bound=Definition | ParamDecl)


@dataclass(frozen=True)
class Names:
    """Every global name of a composition, passes left out: a pass and an element may share a word.

    The first pack that defines a word keeps it as its global name. A pack that neither needs that one nor is needed by
    it may define the same word: its definition is known as ``pack.word``. So adding a pack renames nothing.
    """

    owners: Mapping[str, tuple[str, str]]
    """The pack that defines each global name, and the word under which it does."""
    meanings: Mapping[tuple[str, str], str]
    """By pack and word: the global name that the word means there, where that is not the word itself."""
    defined: Mapping[tuple[str, str], str]
    """By pack and word: the global name of what the pack defines, elements that it overrides among them."""
    needs: Mapping[str, frozenset[str]]
    """A pack, and all packs that it needs, directly or not."""

    def of(self, pack: str, word: str) -> str:
        """The global name that a word, plain or qualified, means in a pack. Unknown words stay as they are."""
        owner, point, own = word.partition(".")
        return (self.defined.get((owner, own)) if point else self.meanings.get((pack, word))) or word

    def qualified(self, pack: str, word: str) -> str | None:
        """The global name of what a pack defines under a word."""
        return self.defined.get((pack, word))

    def knows(self, pack: str, name: str) -> bool:
        """Whether a pack can be expected to know a global name: its own, or one of a pack that it needs."""
        owner = self.owners.get(name)
        return owner is None or owner[0] in self.needs.get(pack, frozenset((pack,)))


def a(noun: str) -> str:
    """The noun with its article."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def needs_of(packs: Sequence[PackDecl]) -> dict[str, frozenset[str]]:
    """For each pack, itself and all packs that it needs, directly or not."""
    direct = {decl.name.text: [need.text for need in decl.needs] for decl in packs}
    closed: dict[str, frozenset[str]] = {}
    for pack in direct:
        found: dict[str, None] = {}
        waiting = [pack]
        while waiting:
            name = waiting.pop()
            if name not in found:
                found[name] = None
                waiting.extend(direct.get(name, ()))
        closed[pack] = frozenset(found)
    return closed


def with_stand_ins(packs: Sequence[PackDecl]) -> list[PackDecl]:
    """The packs, in whose `needs` stand the packs that provide what is needed where that is not loaded itself."""
    loaded = {pack.name.text for pack in packs}
    provider = {
        other.text: pack.name.text for pack in packs for other in pack.provides if other.text not in loaded
    }
    return [
        replace(pack, needs=tuple(replace(one, text=provider.get(one.text, one.text)) for one in pack.needs))
        if any(one.text in provider for one in pack.needs)
        else pack
        for pack in packs
    ]


def in_order(names: Iterable[str], after: Mapping[str, Collection[str]]) -> tuple[list[str], list[str]]:
    """The names in a stable topological order, and the names of the first cycle that was met."""
    ordered: list[str] = []
    stuck: list[str] = []
    waiting = list(names)
    while waiting:
        ready = next((name for name in waiting if not set(after[name]) & set(waiting)), None)
        if ready is None:
            stuck = stuck or list(waiting)
            ready = waiting[0]
        waiting.remove(ready)
        ordered.append(ready)
    return ordered, stuck


def needed_first(packs: Sequence[PackDecl]) -> list[PackDecl]:
    """The packs in load order, but each after the packs that it needs. Packs that need each other keep their order."""
    by_name = {pack.name.text: pack for pack in packs}
    ordered, _ = in_order(by_name, {name: needs - {name} for name, needs in needs_of(packs).items()})
    return [by_name[name] for name in ordered]


def report_unknown(
    kind: str, scalar: Scalar, known: Iterable[str], reporter: Reporter, code: str = "PD301", more: str = ""
) -> None:
    """Report a name that no loaded pack defines. `more` is what else may help."""
    kinds = {"pass": "passes", "property": "properties"}.get(kind, f"{kind}s")
    helps = [*suggest(scalar.word, known, kinds), f"if its pack may be absent, write `{scalar.word}?`{more}"]
    reporter.error(
        code, f"unknown {kind} `{scalar.word}`", scalar.span, "no loaded pack defines it", helps=helps
    )


@dataclass(frozen=True)
class Named(Generic[T]):
    """A declaration with the pack it comes from, and its global name."""

    pack: str
    decl: T
    name: str
    kind: str = ""

    @property
    def span(self) -> Span:
        """Where its name stands in the file."""
        return self.decl.name.span

    @property
    def word(self) -> str:
        """Its name in its own file if that differs from `name`, else empty."""
        return self.decl.name.text if self.decl.name.text != self.name else ""


class NameBook:
    """Collects the definitions of packs, in load order, and reports clashes.

    `rename` has other global names, by qualified name; `reserved` are words that name nothing.
    """

    def __init__(
        self,
        packs: Sequence[PackDecl],
        rename: Sequence[tuple[Scalar, Scalar]],
        reporter: Reporter,
        reserved: frozenset[str] = frozenset(),
    ):
        self.reporter = reporter
        self.packs = [pack.name.text for pack in packs]
        self.needs = needs_of(packs)
        self.provided = {pack.name.text: [other.text for other in pack.provides] for pack in packs}
        self.reserved = reserved
        self.rename = {old.text: new for old, new in rename}
        self.renamed: set[str] = set()
        """The qualified names of `rename` that were met."""
        self._words: dict[str, list[Named[Any]]] = {}
        """By the word in its own file."""
        self._known: dict[str, Named[Any]] = {}
        """By global name."""
        self._overridden: dict[tuple[str, str], str] = {}
        """By pack and word: the global name of the element or pass that the pack overrides."""

    def check_word(self, scalar: Scalar, kind: str) -> bool:
        """Whether a word may name something; reports one that belongs to the language."""
        if scalar.text in self.reserved:
            self.reporter.error(
                "PD311", f"`{scalar.text}` is a reserved word", scalar.span, f"cannot name {a(kind)}",
                helps=[f"write `{scalar.text}_`, or choose another name"],
            )  # fmt: skip
        return scalar.text not in self.reserved

    def define(self, decl: T, kind: str, pack: str) -> Named[T] | None:
        """A definition with its global name, or None after reporting that it clashes with one the pack knows."""
        scalar, word = decl.name, decl.name.text
        if not self.check_word(scalar, kind):
            return None
        written = self._words.setdefault(word, [])
        for other in written:
            if other.pack in self.needs[pack] or pack in self.needs[other.pack]:
                self._report_twice(scalar, kind, pack, other)
                return None
        name, new = word, self.rename.get(f"{pack}.{word}")
        if new is not None:
            self.renamed.add(f"{pack}.{word}")
            if not self.check_word(new, kind):
                return None
            name = new.text
        elif word in self._known:
            name, first = f"{pack}.{word}", self._known[word]
            self.reporter.report(
                "PD312", f"the {kind} `{word}` of `{pack}` is known as `{name}` here", scalar.span,
                f"`{first.pack}` defines `{word}` too",
                secondary=[Label(first.span, f"{a(first.kind)} of {first.pack}")],
                notes=[f"in the rules of `{pack}`, `{word}` still means its own"],
            )  # fmt: skip
        if name in self._known:
            self._report_twice(new or scalar, kind, pack, self._known[name])
            return None
        found = Named(pack, decl, name, kind)
        written.append(found)
        self._known[name] = found
        return found

    def override(self, word: str, pack: str, kind: str) -> str | None:
        """The global name of the element or pass that a pack overrides, which is also known by the pack's name from now on.

        It is one of a pack before this one; what the pack knows comes first.
        """
        written = [one for one in self._words.get(word, ()) if one.kind == kind]
        near = [one for one in written if one.pack in self.needs[pack]]
        known = next(iter(near or written), None)
        if known is None:
            return None
        self._overridden[pack, word] = known.name
        return known.name

    def finish(self) -> Names:
        """The meaning of every word in every pack."""
        meanings: dict[tuple[str, str], str] = {}
        for word, written in self._words.items():
            for pack in self.packs if any(one.name != word for one in written) else ():
                own = [one.name for one in written if one.pack == pack]
                near = own or [one.name for one in written if one.pack in self.needs[pack]]
                if near:
                    meanings[pack, word] = near[0]
        owners = {name: (one.pack, one.decl.name.text) for name, one in self._known.items()}
        defined = {owner: name for name, owner in owners.items()} | self._overridden
        stands_in = {
            (other, word): name
            for (pack, word), name in defined.items()
            for other in self.provided.get(pack, ())
        }
        return Names(owners, meanings, stands_in | defined, self.needs)

    def _report_twice(self, scalar: Scalar, kind: str, pack: str, other: Named[Any]) -> None:
        override = f"; to replace {a(kind)} say `override: yes`" if kind in ("element", "pass") else ""
        self.reporter.error(
            "PD302", f"{'pass ' if kind == 'pass' else ''}`{scalar.text}` is defined twice", scalar.span,
            f"{a(kind)} of {pack}", secondary=[Label(other.span, f"{a(other.kind)} of {other.pack}")],
            helps=[f"rename one of them{override}"],
        )  # fmt: skip
