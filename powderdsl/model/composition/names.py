"""Name resolution: one namespace for all packs, in which unrelated packs may clash.

Passes have a separate namespace; they run in the order of `after` and `before`, then in load order.
"""

from __future__ import annotations

import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import Any, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.declarations import (
    SHARED,
    Definition,
    FieldDecl,
    PackDecl,
    PassDecl,
    PropertyDecl,
    RulesetDecl,
    TestDecl,
)
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Mapping as MappingNode
from powderdsl.syntax.yaml_tree import Node, Scalar

D = TypeVar("D", bound=Definition)

MAX_PASSES = 200

STATE = frozenset(("element", "ids"))
"""Names reserved for the elements of cells in Python and files, which fields and properties cannot have."""


class Names:
    """Every global name in some sections of packs. Clashes are reported.

    The first pack that defines a word keeps it as its global name. A pack that neither needs that one nor is needed by
    it may define the same word: its definition is known as ``pack.word``. So adding a pack never renames anything.

    `rename` maps qualified names to a span and another global name. `reserved` words cannot be names.
    """

    def __init__(
        self,
        packs: Mapping[str, PackDecl],
        sections: Sequence[str],
        rename: Mapping[str, tuple[Scalar, Scalar]],
        reporter: Reporter,
        reserved: frozenset[str] = frozenset(),
    ):
        self.reporter = reporter
        self.reserved = reserved
        self.rename = rename
        self.renamed: set[str] = set()
        """The qualified names of `rename` that were met."""
        self.needs = needs_of(packs)
        """A pack, and all packs that it needs, directly or not."""
        self.packs = packs
        self.versions: dict[str, list[Any]] = {}
        """By global name: the declaration in effect, then those that it overrides."""
        self.known: dict[str, str] = {}
        """Global names by qualified name, including overridden elements and passes."""
        for section in sections:
            for pack in packs.values():
                for decl in getattr(pack, section):
                    self._define(decl)

    def of(self, pack: str, word: str) -> str:
        """The global name of a plain or qualified word in a pack. Unknown words are returned unchanged."""
        return self._first(self.needs.get(pack, ()), word) or self.known.get(word, word)

    def _first(self, packs: Iterable[str], word: str) -> str | None:
        for pack in packs:
            if name := self.known.get(f"{pack}.{word}"):
                return name
        return None

    def declared(self, kind: type[D]) -> dict[str, D]:
        """The declarations of a kind by global name, in load order."""
        return {name: decl for name, (decl, *_) in self.versions.items() if isinstance(decl, kind)}

    def pack(self, name: str) -> str | None:
        """The pack that defines a global name; None for an unknown one."""
        return self.versions[name][-1].pack if name in self.versions else None

    def knows(self, pack: str, name: str) -> bool:
        """True if a global name is a pack's own, or one of a pack that it needs."""
        return self.pack(name) in (None, *self.needs.get(pack, (pack,)))

    def check_word(self, scalar: Scalar | Syntax, noun: str, more: frozenset[str] = frozenset()) -> bool:
        """True if a word may be a name. Reports reserved words."""
        is_reserved = scalar.text in self.reserved | more
        if is_reserved:
            self.reporter.error(
                "PD311", f"`{scalar.text}` is a reserved word", scalar.span, f"cannot name {noun}",
                helps=[f"write `{scalar.text}_`, or choose another name"],
            )  # fmt: skip
        return not is_reserved

    def _define(self, decl: Any) -> None:
        scalar, word, needs = decl.name, decl.name.text, self.needs[decl.pack]
        if getattr(decl, "override", False):
            name = self._first((*needs, *self.needs), word)
            if name is not None and type(self.versions[name][0]) is type(decl):
                self.versions[name].insert(0, decl)
                self._know(decl, name)
                return
            self.reporter.error(
                "PD301", f"`{word}` overrides nothing", scalar.span, "no pack before this one defines it",
                helps=["remove `override`, or load the other pack first"],
            )  # fmt: skip
        _, new = self.rename.get(decl.qualified, (None, None))
        if new is not None:
            self.renamed.add(decl.qualified)
        taken = STATE if isinstance(decl, FieldDecl | PropertyDecl) else frozenset()
        if not all(
            self.check_word(name, decl.NOUN, taken) for name in dict.fromkeys((scalar, new or scalar))
        ):
            return
        near = [pack for pack in self.needs if pack in needs or decl.pack in self.needs[pack]]
        other = self._first(near, word)
        name = new.text if new is not None else word if word not in self.versions else decl.qualified
        if other is not None or name in self.versions:
            first = self.versions[name if other is None else other][-1]
            override = f"; to replace {decl.NOUN}, write `override: yes`" if hasattr(decl, "override") else ""
            clash = scalar if other is not None or new is None else new
            self.reporter.error(
                "PD302", f"{'pass ' * isinstance(decl, PassDecl)}`{clash.text}` is defined twice", clash.span,
                f"{decl.NOUN} of {decl.pack}", secondary=[Label(first.span, f"{first.NOUN} of {first.pack}")],
                helps=[f"rename one of them{override}"],
            )  # fmt: skip
            return
        if name == decl.qualified:
            first, noun = self.versions[word][-1], decl.NOUN.partition(" ")[2]
            self.reporter.report(
                "PD312", f"the {noun} `{word}` of `{decl.pack}` is named `{name}` here", scalar.span,
                f"`{first.pack}` defines `{word}` too",
                secondary=[Label(first.span, f"{first.NOUN} of {first.pack}")],
                notes=[f"in the rules of `{decl.pack}`, `{word}` still refers to its own"],
            )  # fmt: skip
        self.versions[name] = [decl]
        self._know(decl, name)

    def _know(self, decl: Definition, name: str) -> None:
        """Record the global name of a definition, also under the packs that its pack provides."""
        self.known[decl.qualified] = name
        for other in self.packs[decl.pack].provides:
            self.known.setdefault(f"{other.text}.{decl.name.text}", name)


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
    """Report a name that no loaded pack defines, unless it is optional. `more` is further help."""
    if scalar.is_optional:
        return
    kinds = {"pass": "passes", "property": "properties"}.get(kind, f"{kind}s")
    helps = [*suggest(scalar.word, known, kinds), f"if its pack may be absent, write `{scalar.word}?`{more}"]
    reporter.error(
        code, f"unknown {kind} `{scalar.word}`", scalar.span, "no loaded pack defines it", helps=helps
    )


# Packs and what they need


def needs_of(packs: Mapping[str, PackDecl]) -> dict[str, tuple[str, ...]]:
    """Each pack with itself and all packs that it needs, directly or not, in load order."""
    closed = {}
    for pack in packs:
        reached = [pack]
        for name in reached:  # grows on the way
            for need in packs[name].needs:
                if need.text in packs and need.text not in reached:
                    reached.append(need.text)
        closed[pack] = (pack, *(name for name in packs if name in reached[1:]))
    return closed


def with_stand_ins(packs: Iterable[PackDecl]) -> dict[str, PackDecl]:
    """Packs by name, with needs that are not loaded replaced by the packs that provide them."""
    loaded = {pack.name.text: pack for pack in packs}
    provider = dict(zip(loaded, loaded, strict=True))
    for name, pack in loaded.items():
        for other in pack.provides:
            provider.setdefault(other.text, name)
    for name, pack in loaded.items():
        needs = [replace(need, text=provider.get(need.text, need.text)) for need in pack.needs]
        loaded[name] = replace(pack, needs=tuple(needs))
    return loaded


def in_order(names: Iterable[str], after: Mapping[str, Collection[str]]) -> list[str]:
    """The names in a stable topological order; the names of a cycle keep their order."""
    ordered: list[str] = []
    waiting = list(names)
    while waiting:
        ready = next((name for name in waiting if {*after[name]} & {*waiting} <= {name}), waiting[0])
        waiting.remove(ready)
        ordered.append(ready)
    return ordered


def needed_first(packs: Mapping[str, PackDecl]) -> list[str]:
    """The packs in load order, but after those that they need. Packs that need each other keep their order."""
    return in_order(packs, needs_of(packs))


# The order of passes


def order_passes(names: Names, reporter: Reporter) -> dict[str, PassDecl]:
    """The passes sorted by `after` and `before`, then by load order. An overriding pass takes the other's position."""
    passes = names.declared(PassDecl)
    if len(passes) > MAX_PASSES:
        last = list(passes.values())[MAX_PASSES].span
        reporter.error(
            "PD508", f"{len(passes):,} passes", last, f"the limit is {MAX_PASSES}", helps=["load fewer packs"]
        )
        return passes
    earlier: dict[str, dict[str, Span]] = defaultdict(dict)
    for name, versions in names.versions.items():
        for decl in reversed(versions):
            for scalars, is_after in ((decl.after, True), (decl.before, False)):
                for scalar in scalars:
                    other = names.of(versions[0].pack, scalar.word)
                    if other in passes:
                        first, second = (other, name) if is_after else (name, other)
                        earlier[second][first] = scalar.span
                    else:
                        report_unknown("pass", scalar, passes, reporter)
    try:
        TopologicalSorter(earlier).prepare()
    except CycleError as error:
        cycle = error.args[1][:0:-1]
        start = cycle.index(max(cycle, key=[*passes].index))  # likely in the file being edited
        cycle = [*cycle[start:], *cycle[: start + 1]]  # each pass comes after the next one
        places = [(earlier[later][first], f"`{first}` before `{later}`") for later, first in pairwise(cycle)]
        message = "the order of passes is a cycle: " + " after ".join(f"`{name}`" for name in cycle)
        helps, others = ["remove one of these names from its `after` or `before`"], places[1:]
        reporter.error("PD307", message, *places[0], secondary=[Label(*p) for p in others], helps=helps)
    return {name: passes[name] for name in in_order(passes, earlier)}


# Optional names that look like misspelled ones

MAX_PLACES = 4
"""Places of one name that are shown besides the first."""

_OPTIONAL = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\?")


def report_misspelled(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl,
    elsewhere: Callable[[], Mapping[str, str]],
    reporter: Reporter,
) -> None:
    """Warn of optional names that no pack defines but that resemble a defined name.

    `elsewhere`: returns the words of packs that are not loaded, with the packs; called only if needed.
    """
    known: set[str] = set()
    for pack in (*packs, *ruleset.left_out.values()):
        for section in (*SHARED, "params", "passes"):
            known.update(decl.name.text for decl in getattr(pack, section))
        for decl in pack.passes:
            known.update(field.name.text for field in decl.scratch)
            for block in decl.walk():
                known.update(name.text for name, _ in block.lets)
    unknown: dict[str, dict[Span, None]] = {}
    for word, span in _optional_names((*packs, ruleset)):
        if word not in known:
            unknown.setdefault(word, {})[span] = None
    others = elsewhere() if unknown else {}
    for word, places in unknown.items():
        closest = None if word in others else _closest(word, (*sorted(known), *others))
        if closest is None:
            continue
        first, *more = places
        reporter.report(
            "PD315", f"no loaded or shipped pack defines `{word}`", first,
            "with the `?`, it is always absent",
            secondary=[Label(span, "and here") for span in more[:MAX_PLACES]],
            helps=[f"did you mean `{closest}?`" + ("" if closest in known else f", which `{others[closest]}` defines")],
        )  # fmt: skip


def words_of_tree(tree: Node | None) -> Iterator[str]:
    """The names that a pack's file defines, from its structure alone."""
    for key, section in tree.entries if isinstance(tree, MappingNode) else ():
        if key.text in (*SHARED, "passes"):
            names: Iterable[Node] = section.items
            if isinstance(section, MappingNode):
                names = (name for name, _ in section.entries)
            yield from (name.text for name in names if isinstance(name, Scalar))


def _optional_names(value: object) -> Iterator[tuple[str, Span]]:
    """Every word with a `?` in declarations, with its span."""
    match value:
        case Scalar():
            if _OPTIONAL.fullmatch(value.text):
                yield value.text[:-1], value.span
            return
        case Syntax():
            if value.kind == "optional_name":
                yield value.text.removesuffix("?"), value.span
            parts: Iterable[object] = value.children
        case TestDecl():  # in its worlds, a `?` matches anything
            keys = tuple(key for key, _ in (*value.fields, *value.expect_fields, *value.params))
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


def _closest(word: str, names: Sequence[str]) -> str | None:
    """The name that a word misspells. Short words and first letters are assumed to be right: `ash` is not `dash`."""
    longer = [name for name in names if name[0] == word[0] and min(len(name), len(word)) > 3]
    turned = (name for name in longer if sorted(name) == sorted(word))
    return next(iter(get_close_matches(word, longer, n=1, cutoff=0.8)), None) or next(turned, None)
