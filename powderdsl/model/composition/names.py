"""Name resolution: one namespace over all packs, in which packs that do not know each other may clash.

Passes have a namespace of their own; they run in the order that `after` and `before` ask for, then in load order.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.declarations import Definition, PackDecl, ParamDecl, PassDecl, RulesetDecl, TestDecl
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Mapping as MappingNode
from powderdsl.syntax.yaml_tree import Node, Scalar

T = TypeVar("T", bound=Definition | ParamDecl)

MAX_PASSES = 200


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


@dataclass(frozen=True)
class Names:
    """Every global name of a composition, passes left out: a pass and an element may share a word.

    The first pack that defines a word keeps it as its global name. A pack that neither needs that one nor is needed by
    it may define the same word: its definition is known as ``pack.word``. So adding a pack renames nothing.
    """

    definitions: Mapping[str, Named[Any]]
    """By global name."""
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
        named = self.definitions.get(name)
        return named is None or named.pack in self.needs.get(pack, (pack,))


def a(noun: str) -> str:
    """The noun with its article."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def listed(words: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def words_of(syntax: Syntax) -> Iterator[str]:
    """All words of an expression, without the `?` of optional names."""
    waiting = [syntax]
    while waiting:
        part = waiting.pop()
        if part.text:
            yield part.text.removesuffix("?")
        waiting += part.children


def report_unknown(
    kind: str, scalar: Scalar, known: Iterable[str], reporter: Reporter, code: str = "PD301", more: str = ""
) -> None:
    """Report a name that no loaded pack defines. `more` is what else may help."""
    kinds = {"pass": "passes", "property": "properties"}.get(kind, f"{kind}s")
    helps = [*suggest(scalar.word, known, kinds), f"if its pack may be absent, write `{scalar.word}?`{more}"]
    reporter.error(
        code, f"unknown {kind} `{scalar.word}`", scalar.span, "no loaded pack defines it", helps=helps
    )


# Packs and what they need


def needs_of(packs: Sequence[PackDecl]) -> dict[str, frozenset[str]]:
    """For each pack, itself and all packs that it needs, directly or not."""
    direct = {decl.name.text: [need.text for need in decl.needs] for decl in packs}
    closed: dict[str, frozenset[str]] = {}
    for pack in direct:
        reached = {pack}
        waiting = [pack]
        while waiting:
            new = set(direct.get(waiting.pop(), ())) - reached
            reached |= new
            waiting += new
        closed[pack] = frozenset(reached)
    return closed


def with_stand_ins(packs: Sequence[PackDecl]) -> list[PackDecl]:
    """Replace `needs` that are not loaded by the loaded packs that provide them."""
    loaded = {pack.name.text for pack in packs}
    provider = {
        other.text: pack.name.text for pack in packs for other in pack.provides if other.text not in loaded
    }
    if not provider:
        return list(packs)
    return [
        replace(pack, needs=tuple(replace(one, text=provider.get(one.text, one.text)) for one in pack.needs))
        for pack in packs
    ]


def in_order(names: Iterable[str], after: Mapping[str, Collection[str]]) -> tuple[list[str], list[str]]:
    """The names in a stable topological order, and the names of the first cycle that was met."""
    ordered: list[str] = []
    stuck: list[str] = []
    waiting = list(names)
    while waiting:
        for ready in waiting:
            if not set(after[ready]).intersection(waiting):
                break
        else:
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


# Definitions


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
        self.packs = packs
        self.needs = needs_of(packs)
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
        named = Named(pack, decl, name, kind)
        written.append(named)
        self._known[name] = named
        return named

    def versions(
        self, kind: str, decls_of: Callable[[PackDecl], Sequence[Any]]
    ) -> dict[str, list[Named[Any]]]:
        """The declarations of each element or pass by global name: the effective one first, then those that it overrides.

        What is overridden is of a pack before; what the pack knows comes first.
        """
        found: dict[str, list[Named[Any]]] = {}
        for pack, decl in ((one.name.text, decl) for one in self.packs for decl in decls_of(one)):
            name = decl.name
            written = [one for one in self._words.get(name.text, ()) if one.kind == kind]
            near = [one for one in written if one.pack in self.needs[pack]]
            if decl.override and written:
                known = (near or written)[0].name
                self._overridden[pack, name.text] = known
                found[known].insert(0, Named(pack, decl, known, kind))
                continue
            if decl.override:
                self.reporter.error(
                    "PD301", f"`{name.text}` overrides nothing", name.span, "no pack before this one defines it",
                    helps=["remove `override`, or load the other pack first"],
                )  # fmt: skip
            if named := self.define(decl, kind, pack):
                found[named.name] = [named]
        return found

    def finish(self) -> Names:
        """The meaning of every word in every pack."""
        meanings: dict[tuple[str, str], str] = {}
        for word, written in self._words.items():
            if all(one.name == word for one in written):
                continue
            for pack, needs in self.needs.items():
                near = [one.name for one in written if one.pack in needs]
                own = [one.name for one in written if one.pack == pack]
                if near:
                    meanings[pack, word] = (own or near)[0]
        defined = {(one.pack, one.decl.name.text): name for name, one in self._known.items()}
        defined |= self._overridden
        provided = {pack.name.text: pack.provides for pack in self.packs}
        stands_in = {
            (other.text, word): name for (pack, word), name in defined.items() for other in provided[pack]
        }
        return Names(self._known, meanings, stands_in | defined, self.needs)

    def _report_twice(self, scalar: Scalar, kind: str, pack: str, other: Named[Any]) -> None:
        override = f"; to replace {a(kind)} say `override: yes`" if kind in ("element", "pass") else ""
        self.reporter.error(
            "PD302", f"{'pass ' if kind == 'pass' else ''}`{scalar.text}` is defined twice", scalar.span,
            f"{a(kind)} of {pack}", secondary=[Label(other.span, f"{a(other.kind)} of {other.pack}")],
            helps=[f"rename one of them{override}"],
        )  # fmt: skip


# The order of passes


def order_passes(
    passes: dict[str, Named[PassDecl]], names: Names, reporter: Reporter
) -> tuple[Named[PassDecl], ...]:
    """Sort passes by `after` and `before`, then by load order. `names` resolves names of passes."""
    if len(passes) > MAX_PASSES:
        last = list(passes.values())[MAX_PASSES].decl.name.span
        reporter.error(
            "PD508", f"{len(passes):,} passes", last, f"the limit is {MAX_PASSES}", helps=["load fewer packs"]
        )
        return tuple(passes.values())
    earlier: dict[str, dict[str, Span]] = {name: {} for name in passes}
    for name, named in passes.items():
        for scalars, is_after in ((named.decl.after, True), (named.decl.before, False)):
            for scalar in scalars:
                other = names.of(named.pack, scalar.word)
                if other in passes:
                    first, second = (other, name) if is_after else (name, other)
                    earlier[second][first] = scalar.span
                elif not scalar.is_optional:
                    report_unknown("pass", scalar, passes, reporter)
    ordered, stuck = in_order(passes, earlier)
    if stuck:
        _report_cycle(stuck, earlier, reporter)
    return tuple(passes[name] for name in ordered)


def _report_cycle(waiting: list[str], earlier: dict[str, dict[str, Span]], reporter: Reporter) -> None:
    path = [waiting[0]]
    while len(set(path)) == len(path):
        path.append(next(name for name in earlier[path[-1]] if name in waiting))
    cycle = path[path.index(path[-1]) :]
    (place, label), *more = [
        (earlier[later][first], f"`{first}` before `{later}`") for later, first in pairwise(cycle)
    ]
    message = "the order of passes is a cycle: " + " after ".join(f"`{name}`" for name in cycle)
    helps = ["take one of these names out of its `after` or `before`"]
    reporter.error("PD307", message, place, label, secondary=[Label(*step) for step in more], helps=helps)


# Optional names that look like misspelled ones

SECTIONS = ("tags", "properties", "fields", "streams", "kernels", "sets", "elements", "passes")
"""Sections of a pack whose keys are names that other packs may ask for."""

MAX_PLACES = 4
"""Places of one name that are shown besides the first."""

_OPTIONAL = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\?")


def report_misspelled(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    elsewhere: Callable[[], Mapping[str, str]],
    reporter: Reporter,
) -> None:
    """Warn of optional names that no pack defines and that are a slip away from one that some pack defines.

    Args:
        elsewhere: words that packs define which are not loaded, and these packs. Asked only if it matters.
    """
    known: set[str] = set()
    for pack in (*packs, *(ruleset.left_out if ruleset else ())):
        known.update(one.name.text for one in (*pack.definitions, *pack.params, *pack.passes))
        for one in pack.passes:
            known.update(item.name.text for item in one.scratch)
            known.update(name.text for block in one.walk() for name, _ in block.lets)
    asked: dict[str, dict[Span, None]] = {}
    for word, span in _optional_names((*packs, ruleset)):
        if word not in known:
            asked.setdefault(word, {})[span] = None
    others = elsewhere() if asked else {}
    for word, places in asked.items():
        names = () if word in others else (*sorted(known), *others)
        near = {name: slips for name in names if (slips := _slips(word, name)) is not None}
        if not near:
            continue
        meant = min(near, key=near.__getitem__)
        first, *more = places
        reporter.report(
            "PD315", f"no loaded or shipped pack defines `{word}`", first,
            "with the `?`, it is always absent",
            secondary=[Label(span, "and here") for span in more[:MAX_PLACES]],
            helps=[f"did you mean `{meant}?`" + ("" if meant in known else f", which `{others[meant]}` defines")],
        )  # fmt: skip


def words_of_tree(tree: Node | None) -> Iterator[str]:
    """The names that a pack's file defines, from its structure alone."""
    if isinstance(tree, MappingNode):
        for key, section in tree.entries:
            if key.text in SECTIONS and isinstance(section, MappingNode):
                yield from (name.text for name, _ in section.entries)
            elif key.text in SECTIONS and not isinstance(section, Scalar | MappingNode):
                yield from (item.text for item in section.items if isinstance(item, Scalar))


def _optional_names(value: object) -> Iterator[tuple[str, Span]]:
    """Every word with a `?` in declarations, and where it stands."""
    match value:
        case Scalar():
            if _OPTIONAL.fullmatch(value.text):
                yield value.text[:-1], value.span
            return
        case Syntax():
            if value.kind == "optional_name":
                yield value.text.removesuffix("?"), value.span
            parts: Iterable[object] = value.children
        case TestDecl():  # in its worlds a `?` stands for anything
            keys = tuple(key for key, _ in (*value.fields, *value.expect_fields))
            parts = (value.legend, value.always, value.often, keys)
        case RulesetDecl():
            parts = (value.matrix, value.invariants)
        case tuple():
            parts = value
        case _ if dataclasses.is_dataclass(value):
            parts = [getattr(value, item.name) for item in dataclasses.fields(value)]
        case _:
            return
    for part in parts:
        yield from _optional_names(part)


def _slips(word: str, name: str) -> int | None:
    """How many slips make a word of a name; None if they are more than its length makes likely.

    A letter that is left out, added, wrong, or exchanged with the next one is a slip. Other words may differ by one
    letter too, as `food` and `mood`, `ash` and `dash`. So short words, and the first letter, must be right.
    """
    shorter, longer = sorted((len(word), len(name)))
    most = 2 if len(name) >= 8 else 1
    if shorter < 3 or longer - shorter > most or (shorter == 3 and longer > 3):
        return None
    wrong = 1 if len(name) >= 5 and word[0] == name[0] else most + 1
    rows = [list(range(len(name) + 1))]
    for i, a in enumerate(word, 1):
        row = [i]
        for j, b in enumerate(name, 1):
            best = min(rows[-1][j] + 1, row[-1] + 1, rows[-1][j - 1] + (wrong if a != b else 0))
            if i > 1 and j > 1 and a == name[j - 2] and b == word[i - 2]:
                best = min(best, rows[-2][j - 2] + 1)
            row.append(best)
        rows.append(row)
    return rows[-1][-1] if 0 < rows[-1][-1] <= most else None
