"""Declarations of several packs -> one composition: every name defined once, passes in order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from math import lcm
from typing import Generic, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.composition.claim_scopes import ClaimScopes, title_of
from powderdsl.model.composition.names import PASS, NameBook, Names, needs_of
from powderdsl.model.composition.palette import Claim, Palette, composed_ids, recorded_ids, report_ids
from powderdsl.model.composition.pass_order import order_passes
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
from powderdsl.syntax.yaml_tree import Scalar

T = TypeVar("T")


@dataclass(frozen=True)
class Named(Generic[T]):
    """A declaration with the pack it comes from, and its global name."""

    pack: str
    decl: T
    name: str


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
    names: Names
    order: dict[int, int]
    """The place of each id where loops run over elements: as if no palette had been recorded."""
    groups: tuple[tuple[str, ...], ...]
    """The packs whose elements and channels are placed together; the first ones lie where they lie by themselves."""
    side_multiple: int
    """The least common multiple of what the packs ask of the sides of worlds."""
    reserved: tuple[int, ...]
    """Ids of elements of a ruleset's own packs that are left out."""

    @cached_property
    def scopes(self) -> ClaimScopes:
        """What invariants and tests speak of."""
        return ClaimScopes(self.packs, self.ruleset, self.names)

    def glyphs_alone(self, packs: Sequence[str]) -> dict[str, str]:
        """The glyphs of elements, by global name, as they are where only some packs are loaded."""
        found: dict[str, Named[ElementDecl]] = {}
        for pack in self.packs:
            for decl in pack.elements if pack.name.text in packs else ():
                name = self.names.of(pack.name.text, decl.name.text)
                if name in self.elements:  # what overrides it elsewhere has no say here
                    found[name] = Named(pack.name.text, decl, name)
        return _glyphs(list(found.values()))

    def element(self, word: str, pack: str) -> str | None:
        """The global name of the element that a pack means by a plain or qualified name."""
        name = self.names.of(pack, word)
        if name in self.elements:
            return name
        return next((one for one, element in self.elements.items() if element.qualified == word), None)


def compose(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Palette | None = None,
) -> Composition:
    """Merge packs in the order given. Reports clashes of names and ids, missing packs, and cycles of passes.

    `palette` has ids that were recorded earlier.
    """
    _check_needs(packs, reporter)
    reporter.raise_if_errors()  # every name of a pack that lacks would be a mistake of its own
    book = NameBook(packs, ruleset.renames if ruleset else (), reporter)
    chosen = _chosen_elements(packs, book, reporter)
    groups = _groups(packs, ruleset)
    claims = _claims(groups, ruleset is not None, chosen)
    natural = composed_ids(claims)
    ids = natural if palette is None else recorded_ids(claims, palette)
    report_ids(claims, ids, reporter, recorded=palette is not None)
    elements = _elements(chosen, ids, reporter)
    placing = ruleset.placing if ruleset else None
    wanted = (placing.slots if placing else None) or 0
    slots = max(
        [
            wanted,
            *(number + 1 for number in ids.values()),
            len(palette or ()),
            1,
        ]
    )
    # The packs of the ruleset that says so must fit its slots; packs loaded on top of them add slots.
    own = ruleset.placed if ruleset and wanted else ()
    top = max((e for e in elements.values() if e.pack in own), key=lambda element: element.id, default=None)
    if top and placing and palette is None and top.id >= wanted:
        reporter.error(
            "PD402",
            f"element `{top.name}` has id {top.id}, but the ruleset has {wanted} slots",
            top.span,
            helps=[f"say `slots: {top.id + 1}` in {placing.source.name}"],
        )
    tag_spans: dict[str, Span] = {}
    for pack in packs:
        for scalar, _ in pack.tags:
            if name := book.define(scalar, "tag", pack.name.text):
                tag_spans[name] = scalar.span

    def table(entries: Iterable[tuple[PackDecl, Scalar, T]], kind: str) -> dict[str, Named[T]]:
        found: dict[str, Named[T]] = {}
        for pack, scalar, decl in entries:
            if name := book.define(scalar, kind, pack.name.text):
                found[name] = Named(pack.name.text, decl, name)
        return found

    properties = table(((p, d.name, d) for p in packs for d in p.properties), "property")
    fields = table(((p, d.name, d) for p in packs for d in p.fields), "field")
    streams = table(((p, d.name, d) for p in packs for d in p.streams), "stream")
    kernels = table(((p, d.name, d) for p in packs for d in p.kernels), "kernel")
    sets = table(((p, d[0], d) for p in packs for d in p.sets), "set")
    passes = table(((p, d.name, d) for p in packs for d in p.passes), PASS)
    params: dict[str, Named[TypedDecl]] = {}
    for pack in packs:
        for decl in pack.params:
            qualified = f"{pack.name.text}.{decl.name.text}"
            params[qualified] = Named(pack.name.text, decl, qualified)
            book.check_word(decl.name, "parameter")
    names = book.finish()
    _check_renamed(ruleset, book, reporter)
    name = title_of(packs, ruleset)
    about = ruleset.about if ruleset else (packs[0].about if len(packs) == 1 else "")
    composition = Composition(
        name=name,
        about=about,
        packs=tuple(packs),
        ruleset=ruleset,
        elements=elements,
        element_decls={word: chosen[word].named for word in elements},
        slots=slots,
        tags={},
        tag_spans=tag_spans,
        properties=properties,
        fields=fields,
        streams=streams,
        params=params,
        kernels=kernels,
        sets=sets,
        passes=order_passes(passes, names, reporter),
        names=names,
        order={number: natural.get(word, number) for word, number in ids.items()},
        side_multiple=lcm(*(pack.side_multiple for pack in packs)),
        groups=tuple(tuple(pack.name.text for pack in group) for group in groups),
        reserved=tuple(ids[c.name] for c in claims if c.name in ids and c.name not in chosen),
    )
    return replace(composition, tags=_tags(composition, reporter))


def _check_renamed(ruleset: RulesetDecl | None, book: NameBook, reporter: Reporter) -> None:
    """Report names under `rename:` that no pack defines. Those of packs that are left out may wait."""
    if ruleset is None:
        return
    waiting = {pack.name.text for pack in ruleset.left_out}
    for old, _ in ruleset.renames:
        if old.text not in book.renamed and old.text.partition(".")[0] not in waiting:
            reporter.error(
                "PD310",
                f"nothing is called `{old.text}`",
                old.span,
                "no loaded pack defines this",
                helps=["write the pack's name, a point, and the name that it defines: `pack.word`"],
            )


def _check_needs(packs: Sequence[PackDecl], reporter: Reporter) -> None:
    loaded = {pack.name.text: pack for pack in packs}
    missing: dict[str, list[Scalar]] = {}
    needing: dict[str, list[str]] = {}
    for pack in packs:
        for need in pack.needs:
            if need.text not in loaded:
                missing.setdefault(need.text, []).append(need)
                needing.setdefault(need.text, []).append(pack.name.text)
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
    for name, places in missing.items():
        first, *others = needing[name]
        count = f" and {len(others)} others need" if others else " needs"
        reporter.error(
            "PD305",
            f"pack `{first}`{count} `{name}`, which is not loaded",
            places[0].span,
            "not loaded",
            secondary=[Label(place.span, "needed here too") for place in places[1:4]],
            helps=_need_helps(name, [first, *others], loaded),
        )


def _need_helps(need: str, needing: Sequence[str], loaded: Iterable[str]) -> list[str]:
    close = get_close_matches(need, sorted(set(loaded) - set(needing)), n=1, cutoff=0.75)
    if close:
        return [f"did you mean `{close[0]}`?"]
    if len(needing) == 1:
        return [f"load it too, as in `{need}+{needing[0]}`"]
    return [f"load `{need}` too, or leave out what needs it: {', '.join(f'`{name}`' for name in needing)}"]


@dataclass(frozen=True)
class _Chosen:
    """The declaration of an element that holds, and those that it overrides, the latest first."""

    named: Named[ElementDecl]
    replaced: tuple[Named[ElementDecl], ...] = ()

    @property
    def first(self) -> ElementDecl:
        """Where the element is defined, not overridden."""
        return (self.replaced or (self.named,))[-1].decl


def _chosen_elements(packs: Sequence[PackDecl], book: NameBook, reporter: Reporter) -> dict[str, _Chosen]:
    """By global name, in load order."""
    chosen: dict[str, _Chosen] = {}
    for pack in packs:
        for decl in pack.elements:
            known = book.override(decl.name.text, pack.name.text) if decl.override else None
            if known is not None:
                before = chosen[known]
                _check_same_id(decl, before, reporter)
                named = Named(pack.name.text, decl, known)
                chosen[known] = _Chosen(named, (before.named, *before.replaced))
                continue
            if decl.override:
                reporter.error(
                    "PD301",
                    f"`{decl.name.text}` overrides nothing",
                    decl.name.span,
                    "no pack before this one defines it",
                    helps=["remove `override`, or load the other pack first"],
                )
            if name := book.define(decl.name, "element", pack.name.text):
                chosen[name] = _Chosen(Named(pack.name.text, decl, name))
    if not chosen:
        reporter.error(
            "PD109",
            "no element is defined",
            packs[0].name.span if packs else None,
            "a world needs elements",
            helps=["define `elements:`, or load `core` too"],
        )
    return chosen


def _check_same_id(decl: ElementDecl, before: _Chosen, reporter: Reporter) -> None:
    """Warn if an element that overrides asks for another id than the one it replaces."""
    old = next((one.decl for one in (before.named, *before.replaced) if one.decl.id is not None), decl)
    if old.id_scalar and decl.id_scalar and decl.id != old.id:
        reporter.report(
            "PD318", f"`{decl.name.text}` gets the id {decl.id} instead of {old.id}", decl.id_scalar.span,
            "its channel moves too", secondary=[Label(old.id_scalar.span, "the id of the element that it replaces")],
            helps=["leave out `id`: an element that overrides another keeps its id"],
        )  # fmt: skip


def _groups(packs: Sequence[PackDecl], ruleset: RulesetDecl | None) -> list[list[PackDecl]]:
    """The packs whose elements and channels are placed together, one group after the other.

    A ruleset's own packs come first, those that are left out among them, for their places stay reserved. Then comes
    each further pack by itself, after those that it needs: the order in which packs are named decides little.
    """
    own = ruleset.placed if ruleset else ()
    left_out = ruleset.left_out if ruleset else ()
    first = [pack for pack in (*packs, *left_out) if pack.name.text in own]
    first.sort(key=lambda pack: own.index(pack.name.text))
    others = needed_first([pack for pack in packs if pack.name.text not in own])
    return [*([first] if first else []), *([pack] for pack in others)]


def _claims(groups: Sequence[Sequence[PackDecl]], own: bool, chosen: dict[str, _Chosen]) -> list[Claim]:
    """All elements in the order in which ids are decided. In each group those that ask for an id come first.

    `own` says that the first group is a ruleset's.
    """
    claims: list[Claim] = []
    for number, group in enumerate(groups):
        found = [claim for pack in group for claim in _claims_of(pack, chosen, not own or number == 0)]
        claims += sorted(found, key=lambda claim: claim.decl.id is None)
    return claims


def _claims_of(pack: PackDecl, chosen: dict[str, _Chosen], own: bool) -> Iterator[Claim]:
    """The claims of the elements that a pack defines first. What overrides them speaks for them."""
    name = pack.name.text
    by_decl = {id(one.first): one for one in chosen.values()}
    for decl in pack.elements:
        one = by_decl.get(id(decl))
        if one is None:
            if not decl.override:  # of a pack that is left out: its id stays reserved
                qualified = f"{name}.{decl.name.text}"
                yield Claim(f"-{qualified}", qualified, name, decl, own, is_loaded=False)
            continue
        final = one.named
        wished = next((old for old in (final, *one.replaced) if old.decl.id is not None), final).decl
        yield Claim(
            final.name,
            f"{final.pack}.{final.decl.name.text}",
            final.pack,
            replace(final.decl, id=wished.id, id_scalar=wished.id_scalar),
            own,
            tuple(f"{old.pack}.{old.decl.name.text}" for old in one.replaced),
        )


def needed_first(packs: Sequence[PackDecl]) -> list[PackDecl]:
    """The packs in load order, but each after those that it needs. Packs that need each other stay as they are."""
    needs = needs_of(packs)
    ordered: list[PackDecl] = []
    waiting = list(packs)
    while waiting:
        names = {pack.name.text for pack in waiting}
        ready = next((p for p in waiting if not (needs[p.name.text] - {p.name.text}) & names), waiting[0])
        waiting.remove(ready)
        ordered.append(ready)
    return ordered


def _elements(chosen: dict[str, _Chosen], ids: dict[str, int], reporter: Reporter) -> dict[str, Element]:
    """The elements by ascending id. A glyph that another element has already is replaced by a free one."""
    owners: dict[str, Named[ElementDecl]] = {}
    for one in chosen.values():
        glyph = one.named.decl.glyph
        first = owners.setdefault(glyph, one.named) if glyph else one.named
        if first is not one.named and first.pack == one.named.pack:
            reporter.error(
                "PD302", f"elements `{first.decl.name.text}` and `{one.named.decl.name.text}` have the same glyph `{glyph}`",
                one.named.decl.name.span, "this one", secondary=[Label(first.decl.name.span, "and this one")], helps=["give one of them another glyph"],
            )  # fmt: skip
    glyphs = _glyphs([one.named for name, one in chosen.items() if name in ids])
    elements: dict[str, Element] = {}
    for name, one in chosen.items():
        decl = one.named.decl
        if name not in ids:
            continue
        elements[name] = Element(
            name,
            one.named.pack,
            ids[name],
            decl.color,
            glyphs[name],
            decl.about,
            frozenset(),
            decl.name.span,
            "" if name == decl.name.text else decl.name.text,
        )
    return dict(sorted(elements.items(), key=lambda item: item[1].id))


def _glyphs(elements: Sequence[Named[ElementDecl]]) -> dict[str, str]:
    """A glyph for each global name: what files say comes first, then free letters in the order of the elements."""
    owners: dict[str, Named[ElementDecl]] = {}
    for named in elements:
        if named.decl.glyph:
            owners.setdefault(named.decl.glyph, named)
    taken = set(owners)
    glyphs: dict[str, str] = {}
    for named in elements:
        word, glyph = named.decl.name.text, named.decl.glyph
        if not glyph or owners[glyph] is not named:
            letters = [*word, *word.upper(), *"0123456789@$&*+=<>"]
            allowed = (c for c in letters if c.isalnum() or c in "@$&*+=<>")
            glyph = next((c for c in allowed if c not in taken), "?")
        taken.add(glyph)
        glyphs[named.name] = glyph
    return glyphs


def _tags(composition: Composition, reporter: Reporter) -> dict[str, frozenset[int]]:
    elements, names = composition.elements, composition.names
    members: dict[str, set[int]] = {tag: set() for tag in composition.tag_spans}

    def give(pack: str, element: str, tags: Iterable[Scalar]) -> None:
        for scalar in tags:
            word = scalar.text.removesuffix("?")
            tag = names.of(pack, word)
            if tag in members:
                if element in elements:
                    members[tag].add(elements[element].id)
            elif not scalar.text.endswith("?"):
                reporter.error(
                    "PD301",
                    f"unknown tag `{word}`",
                    scalar.span,
                    "no loaded pack declares it",
                    helps=[
                        *suggest(word, members, "tags"),
                        f"if its pack may be absent, write `{word}?`; to make a tag, declare it under `tags:`",
                    ],
                )

    for element, named in composition.element_decls.items():
        give(named.pack, element, named.decl.tags)
    for pack in composition.packs:
        own = pack.name.text
        for also in pack.also:
            word = also.element.text.removesuffix("?")
            name = composition.element(word, own)
            if name is None and not also.element.text.endswith("?"):
                reporter.error(
                    "PD301",
                    f"unknown element `{word}`",
                    also.element.span,
                    "no loaded pack defines it",
                    helps=[
                        *suggest(word, elements, "elements"),
                        f"if its pack may be absent, write `{word}?`",
                    ],
                )
            give(own, name or word, also.tags)
    return {tag: frozenset(ids) for tag, ids in members.items()}
