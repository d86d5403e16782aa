"""Declarations of several packs -> one composition: every name defined once, passes in order."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.builtins import RESERVED
from powderdsl.model.declarations import (
    ElementDecl,
    KernelDecl,
    PackDecl,
    PassDecl,
    RulesetDecl,
    StreamDecl,
    TypedDecl,
)
from powderdsl.model.types import Element
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import reserved_words
from powderdsl.syntax.yaml_tree import Scalar

MAX_PASSES = 200

T = TypeVar("T")


@dataclass(frozen=True)
class Named(Generic[T]):
    """A declaration with the pack it comes from."""

    pack: str
    decl: T


@dataclass(frozen=True)
class Composition:
    """Packs merged. Dictionaries are by name, in load order; kinds and values are still syntax."""

    name: str
    about: str
    packs: tuple[PackDecl, ...]
    ruleset: RulesetDecl | None
    elements: dict[str, Element]
    element_decls: dict[str, Named[ElementDecl]]
    slots: int
    tags: dict[str, frozenset[int]]
    tag_spans: dict[str, Span]
    properties: dict[str, Named[TypedDecl]]
    fields: dict[str, Named[TypedDecl]]
    streams: dict[str, Named[StreamDecl]]
    params: dict[str, Named[TypedDecl]]
    kernels: dict[str, Named[KernelDecl]]
    sets: dict[str, Named[tuple[Scalar, Syntax]]]
    passes: tuple[Named[PassDecl], ...]
    owners: dict[str, str]
    """The pack that defines each global name."""

    def knows(self, pack: str, name: str) -> bool:
        """Whether a pack can be expected to know a global name: its own, or one of a pack that it needs."""
        owner = self.owners.get(name)
        return owner is None or owner in self.needs_of(pack)

    def needs_of(self, pack: str) -> frozenset[str]:
        """A pack and all packs that it needs, directly or not."""
        needs = {decl.name.text: [need.text for need in decl.needs] for decl in self.packs}
        found: set[str] = set()
        waiting = [pack]
        while waiting:
            name = waiting.pop()
            if name not in found:
                found.add(name)
                waiting.extend(needs.get(name, ()))
        return frozenset(found)


def compose(packs: Sequence[PackDecl], ruleset: RulesetDecl | None, reporter: Reporter) -> Composition:
    """Merge packs in the order given. Reports clashes of names and ids, missing packs, and cycles of passes."""
    _check_needs(packs, reporter)
    names = _Names(reporter)
    elements, element_decls = _elements(packs, names, reporter)
    slots = max([ruleset.slots or 0 if ruleset else 0, *(e.id + 1 for e in elements.values()), 1])
    # The ruleset's own packs must fit its slots; packs loaded on top of them add slots.
    own = {scalar.text for scalar in ruleset.packs} if ruleset and ruleset.slots else set()
    top = max((e for e in elements.values() if e.pack in own), key=lambda element: element.id, default=None)
    if top and ruleset and ruleset.slots and top.id >= ruleset.slots:
        reporter.error(
            "PD402",
            f"element `{top.name}` has id {top.id}, but the ruleset has {ruleset.slots} slots",
            top.span,
            helps=[f"say `slots: {top.id + 1}` in {ruleset.source.name}"],
        )
    tag_spans: dict[str, Span] = {}
    for pack in packs:
        for scalar, _ in pack.tags:
            names.define(scalar, "tag", pack.name.text)
            tag_spans.setdefault(scalar.text, scalar.span)

    def table(entries: Iterable[tuple[PackDecl, Scalar, T]], kind: str) -> dict[str, Named[T]]:
        found: dict[str, Named[T]] = {}
        for pack, scalar, decl in entries:
            if names.define(scalar, kind, pack.name.text):
                found[scalar.text] = Named(pack.name.text, decl)
        return found

    properties = table(((p, d.name, d) for p in packs for d in p.properties), "property")
    fields = table(((p, d.name, d) for p in packs for d in p.fields), "field")
    streams = table(((p, d.name, d) for p in packs for d in p.streams), "stream")
    kernels = table(((p, d.name, d) for p in packs for d in p.kernels), "kernel")
    sets = table(((p, d[0], d) for p in packs for d in p.sets), "set")
    params: dict[str, Named[TypedDecl]] = {}
    for pack in packs:
        for decl in pack.params:
            params[f"{pack.name.text}.{decl.name.text}"] = Named(pack.name.text, decl)
            names.check_word(decl.name, "parameter")
    tags = _tags(packs, elements, tag_spans, reporter)
    passes = _order_passes(packs, reporter)
    name = ruleset.name.text if ruleset else "+".join(pack.name.text for pack in packs)
    about = ruleset.about if ruleset else (packs[0].about if len(packs) == 1 else "")
    return Composition(
        name,
        about,
        tuple(packs),
        ruleset,
        elements,
        element_decls,
        slots,
        tags,
        tag_spans,
        properties,
        fields,
        streams,
        params,
        kernels,
        sets,
        passes,
        {name: pack for name, (_, _, pack) in names.defined.items()},
    )


def a(noun: str) -> str:
    """The noun with its article."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


class _Names:
    """One namespace for everything that rules can name."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter
        self.defined: dict[str, tuple[str, Scalar, str]] = {}
        self.reserved = RESERVED | reserved_words() | {"elements"}

    def check_word(self, scalar: Scalar, kind: str) -> bool:
        if scalar.text in self.reserved:
            self.reporter.error(
                "PD311",
                f"`{scalar.text}` is a word of the language",
                scalar.span,
                f"cannot name {a(kind)}",
                helps=[f"write `{scalar.text}_`, or choose another name"],
            )
            return False
        return True

    def define(self, scalar: Scalar, kind: str, pack: str) -> bool:
        if not self.check_word(scalar, kind):
            return False
        # A pass and an element may share a name; streams too stand where no element can.
        known = self.defined.get(scalar.text)
        if known is not None:
            self.reporter.error(
                "PD302",
                f"`{scalar.text}` is defined twice",
                scalar.span,
                f"{a(kind)} of {pack}",
                secondary=[Label(known[1].span, f"{a(known[0])} of {known[2]}")],
                helps=[
                    "rename one of them"
                    + ("; to replace an element say `override: yes`" if kind == "element" else "")
                ],
            )
            return False
        self.defined[scalar.text] = (kind, scalar, pack)
        return True


def _check_needs(packs: Sequence[PackDecl], reporter: Reporter) -> None:
    loaded = {pack.name.text: pack for pack in packs}
    for pack in packs:
        for need in pack.needs:
            if need.text not in loaded:
                reporter.error(
                    "PD305",
                    f"pack `{pack.name.text}` needs `{need.text}`, which is not loaded",
                    need.span,
                    "not loaded",
                    helps=[_need_help(need.text, pack.name.text, loaded)],
                )
        for other in pack.conflicts:
            if other.text in loaded:
                reporter.error(
                    "PD306",
                    f"packs `{pack.name.text}` and `{other.text}` cannot be loaded together",
                    other.span,
                    "says so",
                    secondary=[Label(loaded[other.text].name.span, "loaded too")],
                    helps=["leave one of them out"],
                )


def _need_help(need: str, pack: str, loaded: Iterable[str]) -> str:
    close = suggest(need, set(loaded) - {pack})
    return close[0] if close and close[0].startswith("did") else f"load it too, as in `{need}+{pack}`"


def _elements(
    packs: Sequence[PackDecl], names: _Names, reporter: Reporter
) -> tuple[dict[str, Element], dict[str, Named[ElementDecl]]]:
    chosen: dict[str, Named[ElementDecl]] = {}
    for pack in packs:
        for decl in pack.elements:
            name = decl.name.text
            if name in chosen and decl.override:
                chosen[name] = Named(pack.name.text, decl)
                continue
            if decl.override and name not in chosen:
                reporter.error(
                    "PD301",
                    f"`{name}` overrides nothing",
                    decl.name.span,
                    "no pack before this one defines it",
                    helps=["remove `override`, or load the other pack first"],
                )
            if names.define(decl.name, "element", pack.name.text):
                chosen[name] = Named(pack.name.text, decl)
    by_id: dict[int, ElementDecl] = {}
    glyphs = {named.decl.glyph for named in chosen.values() if named.decl.glyph}
    elements: dict[str, Element] = {}
    used = {named.decl.id for named in chosen.values()}
    for name, named in chosen.items():
        decl = named.decl
        if decl.id is None:
            continue
        if decl.id in by_id:
            free = next((i for i in range(256) if i not in used), None)
            reporter.error(
                "PD303",
                f"elements `{by_id[decl.id].name.text}` and `{name}` have the same id {decl.id}",
                decl.id_scalar.span if decl.id_scalar else decl.name.span,
                "already taken",
                secondary=[Label(by_id[decl.id].name.span, "by this one")],
                helps=[] if free is None else [f"id {free} is free"],
            )
        by_id[decl.id] = decl
        glyph = decl.glyph or next(
            (
                c
                for c in [*name, *name.upper(), *"0123456789@$&*+=<>"]
                if c.isalnum() | (c in "@$&*+=<>") and c not in glyphs
            ),
            "?",
        )
        glyphs.add(glyph)
        elements[name] = Element(
            name, named.pack, decl.id, decl.color, glyph, decl.about, frozenset(), decl.name.span
        )
    _check_glyphs(chosen, reporter)
    if not chosen:
        reporter.error(
            "PD109",
            "no element is defined",
            packs[0].name.span if packs else None,
            "a world needs elements",
            helps=["define `elements:`, or load `core` too"],
        )
    ordered = dict(sorted(elements.items(), key=lambda item: item[1].id))
    return ordered, {name: chosen[name] for name in ordered}


def _check_glyphs(chosen: dict[str, Named[ElementDecl]], reporter: Reporter) -> None:
    """One character cannot stand for two elements."""
    owners: dict[str, ElementDecl] = {}
    for named in chosen.values():
        decl = named.decl
        first = owners.setdefault(decl.glyph, decl)
        if decl.glyph and first is not decl:
            reporter.error(
                "PD302", f"elements `{first.name.text}` and `{decl.name.text}` have the same glyph `{decl.glyph}`",
                decl.name.span, "this one", secondary=[Label(first.name.span, "and this one")], helps=["give one of them another glyph"],
            )  # fmt: skip


def _tags(
    packs: Sequence[PackDecl], elements: dict[str, Element], tag_spans: dict[str, Span], reporter: Reporter
) -> dict[str, frozenset[int]]:
    members: dict[str, set[int]] = {tag: set() for tag in tag_spans}

    def give(element: str, tags: Iterable[Scalar]) -> None:
        for scalar in tags:
            tag = scalar.text.removesuffix("?")
            if tag in members:
                if element in elements:
                    members[tag].add(elements[element].id)
            elif not scalar.text.endswith("?"):
                reporter.error(
                    "PD301",
                    f"unknown tag `{tag}`",
                    scalar.span,
                    "no loaded pack declares it",
                    helps=[
                        *suggest(tag, members, "tags"),
                        f"if its pack may be absent, write `{tag}?`; to make a tag, declare it under `tags:`",
                    ],
                )

    for pack in packs:
        for decl in pack.elements:
            give(decl.name.text, decl.tags)
        for also in pack.also:
            name = also.element.text.removesuffix("?")
            if name not in elements and not also.element.text.endswith("?"):
                reporter.error(
                    "PD301",
                    f"unknown element `{name}`",
                    also.element.span,
                    "no loaded pack defines it",
                    helps=[
                        *suggest(name, elements, "elements"),
                        f"if its pack may be absent, write `{name}?`",
                    ],
                )
            give(name, also.tags)
    return {tag: frozenset(ids) for tag, ids in members.items()}


def _order_passes(packs: Sequence[PackDecl], reporter: Reporter) -> tuple[Named[PassDecl], ...]:
    """Sort passes by `after` and `before`; what those leave open is decided by load order."""
    passes: dict[str, Named[PassDecl]] = {}
    for pack in packs:
        for decl in pack.passes:
            name = decl.name.text
            if name in passes:
                reporter.error(
                    "PD302",
                    f"pass `{name}` is defined twice",
                    decl.name.span,
                    f"in {pack.name.text}",
                    secondary=[Label(passes[name].decl.name.span, f"in {passes[name].pack}")],
                    helps=["rename one of them"],
                )
            else:
                passes[name] = Named(pack.name.text, decl)
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
                other = scalar.text.removesuffix("?")
                if other in passes:
                    first, second = (other, name) if is_after else (name, other)
                    earlier[second][first] = scalar.span
                elif not scalar.text.endswith("?"):
                    reporter.error(
                        "PD301",
                        f"unknown pass `{other}`",
                        scalar.span,
                        "no loaded pack has it",
                        helps=[
                            *suggest(other, passes, "passes"),
                            f"if its pack may be absent, write `{other}?`",
                        ],
                    )
    ordered: list[str] = []
    waiting = list(passes)
    while waiting:
        ready = next((name for name in waiting if not set(earlier[name]) & set(waiting)), None)
        if ready is None:
            _report_cycle(waiting, earlier, reporter)
            return tuple(passes[name] for name in [*ordered, *waiting])
        waiting.remove(ready)
        ordered.append(ready)
    return tuple(passes[name] for name in ordered)


def _report_cycle(waiting: list[str], earlier: dict[str, dict[str, Span]], reporter: Reporter) -> None:
    path = [waiting[0]]
    cycle: list[str] = []
    while not cycle:
        step = next(name for name in earlier[path[-1]] if name in waiting)
        if step in path:
            cycle = [*path[path.index(step) :], step]
        path.append(step)
    labels = [
        Label(earlier[later][first], f"`{first}` before `{later}`")
        for later, first in itertools.pairwise(cycle)
    ]
    reporter.error(
        "PD307",
        "passes wait for each other: " + " after ".join(f"`{name}`" for name in cycle),
        labels[0].span,
        labels[0].text,
        secondary=labels[1:],
        helps=["take one of these names out of its `after` or `before`"],
    )
