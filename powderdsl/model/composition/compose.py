"""Declarations of several packs -> one composition: every name defined once, passes in order."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from math import lcm
from typing import Any, TypeVar

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.builtins import RESERVED
from powderdsl.model.composition.claim_scopes import ClaimScopes, names_left_out, title_of, with_waiting
from powderdsl.model.composition.names import (
    NameBook,
    Named,
    Names,
    needed_first,
    report_unknown,
    with_stand_ins,
)
from powderdsl.model.composition.palette import Claim, Palette, composed_ids, recorded_ids, report_ids
from powderdsl.model.composition.pass_order import order_passes
from powderdsl.model.declarations import (
    AlsoDecl,
    Definition,
    ElementDecl,
    FieldDecl,
    KernelDecl,
    PackDecl,
    ParamDecl,
    PassDecl,
    PropertyDecl,
    RulesetDecl,
    SetDecl,
    StreamDecl,
    TagDecl,
)
from powderdsl.model.types import Element
from powderdsl.syntax.parse import reserved_words
from powderdsl.syntax.yaml_tree import Scalar

T = TypeVar("T", bound=Definition | ParamDecl)


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
    tag_decls: dict[str, Named[TagDecl]]
    properties: dict[str, Named[PropertyDecl]]
    fields: dict[str, Named[FieldDecl]]
    streams: dict[str, Named[StreamDecl]]
    params: dict[str, Named[ParamDecl]]
    kernels: dict[str, Named[KernelDecl]]
    sets: dict[str, Named[SetDecl]]
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
        """The scopes of invariants and tests."""
        return ClaimScopes(self.packs, self.ruleset, self.names)

    @cached_property
    def definitions(self) -> Mapping[str, Named[Any]]:
        """Everything that has a global name, parameters and passes left out."""
        tables = (
            self.element_decls,
            self.tag_decls,
            self.properties,
            self.fields,
            self.streams,
            self.sets,
            self.kernels,
        )
        return ChainMap(*tables)

    @cached_property
    def lineage(self) -> tuple[RulesetDecl, ...]:
        """The rulesets that are loaded, what inherits after what it extends."""
        return self.ruleset.lineage if self.ruleset else ()

    def entries(self) -> Iterator[tuple[str, str, ElementDecl | AlsoDecl]]:
        """The entries of all elements: the pack or ruleset, the element's global name (as written if absent), the entry.

        In rising precedence: the elements' own entries, then those under `also`, each pack after those that it needs. A
        ruleset comes after its packs, and packs that are added to it come last.
        """
        for name, named in self.element_decls.items():
            yield named.pack, name, named.decl
        members = {name for one in self.lineage for name in one.members}
        ordered = needed_first(self.packs)
        gone = names_left_out(self.ruleset) - self.names.owners.keys()
        of_rulesets = [(one.name.text, with_waiting(also, gone)) for one in self.lineage for also in one.also]
        of_packs = [(pack.name.text, also) for pack in ordered for also in pack.also]
        own = [entry for entry in of_packs if entry[0] in members]
        for giver, also in (*own, *of_rulesets, *(entry for entry in of_packs if entry[0] not in members)):
            yield giver, self.element(also.name.word, giver) or also.name.word, also

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
    packs = with_stand_ins(packs)
    _check_needs(packs, reporter)
    reporter.raise_if_errors()  # every name of a missing pack would be reported too
    renames = ruleset.renames if ruleset else ()
    book = NameBook(packs, renames, reporter, RESERVED | reserved_words() | {"elements"})
    passes_book = NameBook(packs, renames, reporter)

    def table(kind: str, decls_of: Callable[[PackDecl], Sequence[T]]) -> dict[str, Named[T]]:
        """The declarations of a kind by global name."""
        found = [book.define(decl, kind, pack.name.text) for pack in packs for decl in decls_of(pack)]
        return {named.name: named for named in found if named}

    versions = _versions(packs, book, reporter)
    groups = _groups(packs, ruleset)
    claims = _claims(groups, ruleset is not None, versions)
    natural = composed_ids(claims)
    ids = natural if palette is None else recorded_ids(claims, palette)
    report_ids(claims, ids, reporter, recorded=palette is not None)
    elements = _elements([found[0] for found in versions.values()], ids, reporter)
    tag_decls = table("tag", lambda pack: pack.tags)
    properties = table("property", lambda pack: pack.properties)
    fields = table("field", lambda pack: pack.fields)
    streams = table("stream", lambda pack: pack.streams)
    kernels = table("kernel", lambda pack: pack.kernels)
    sets = table("set", lambda pack: pack.sets)
    passes = _passes(packs, passes_book, reporter)
    params = [Named(p.name.text, decl, f"{p.name.text}.{decl.name.text}") for p in packs for decl in p.params]
    for param in params:
        book.check_word(param.decl.name, "parameter")
    names = book.finish()
    _check_renamed(ruleset, book.renamed | passes_book.renamed, reporter)
    composition = Composition(
        name=title_of(packs, ruleset),
        about=ruleset.about if ruleset else (packs[0].about if len(packs) == 1 else ""),
        packs=tuple(packs),
        ruleset=ruleset,
        elements=elements,
        element_decls={name: versions[name][0] for name in elements},
        slots=max(_slots(ruleset, elements, palette, reporter), *(number + 1 for number in ids.values()), 1),
        tags={},
        tag_decls=tag_decls,
        properties=properties,
        fields=fields,
        streams=streams,
        params={param.name: param for param in params},
        kernels=kernels,
        sets=sets,
        passes=order_passes(passes, passes_book.finish(), reporter),
        names=names,
        order={number: natural.get(word, number) for word, number in ids.items()},
        side_multiple=lcm(*(pack.side_multiple for pack in packs)),
        groups=tuple(tuple(pack.name.text for pack in group) for group in groups),
        reserved=tuple(ids[claim.name] for claim in claims if claim.name in ids and not claim.is_loaded),
    )
    return replace(composition, tags=_tags(composition, reporter), elements=_colored(composition))


def _slots(
    ruleset: RulesetDecl | None, elements: Mapping[str, Element], palette: Palette | None, reporter: Reporter
) -> int:
    """How many ids a ruleset or a palette asks for. Reports an id of the ruleset's own packs beyond its slots."""
    wanted = (ruleset.placing.slots if ruleset else None) or 0
    # The packs of the ruleset that declares `slots` must fit; packs loaded on top of them add slots.
    own = ruleset.placed if ruleset and wanted else ()
    top = max((e for e in elements.values() if e.pack in own), key=lambda element: element.id, default=None)
    if top and ruleset and palette is None and top.id >= wanted:
        reporter.error(
            "PD402", f"element `{top.name}` has id {top.id}, but the ruleset has {wanted} slots", top.span,
            helps=[f"say `slots: {top.id + 1}` in {ruleset.placing.source.name}"],
        )  # fmt: skip
    return max(wanted, len(palette or ()))


def _check_renamed(ruleset: RulesetDecl | None, renamed: AbstractSet[str], reporter: Reporter) -> None:
    """Report names under `rename:` that no pack defines. Those of packs that are left out may wait."""
    waiting = {pack.name.text for pack in ruleset.left_out} if ruleset else ()
    for old, _ in ruleset.renames if ruleset else ():
        if old.text not in renamed and old.text.partition(".")[0] not in waiting:
            reporter.error(
                "PD310", f"nothing is called `{old.text}`", old.span, "no loaded pack defines this",
                helps=["write the pack's name, a point, and the name that it defines: `pack.word`"],
            )  # fmt: skip


def _check_needs(packs: Sequence[PackDecl], reporter: Reporter) -> None:
    """Report packs that cannot be loaded together, and packs that are needed and not loaded."""
    loaded = {pack.name.text: pack for pack in packs}
    stands_in: dict[str, PackDecl] = {}
    missing: dict[str, dict[str, Span]] = {}
    for pack in packs:
        for need in pack.needs:
            if need.text not in loaded:
                missing.setdefault(need.text, {})[pack.name.text] = need.span
        for other in (*pack.conflicts, *pack.provides):
            rival = loaded.get(other.text)
            if other in pack.provides:
                rival = rival or stands_in.get(other.text)
                stands_in.setdefault(other.text, pack)
            if rival is not None:
                message = f"packs `{pack.name.text}` and `{rival.name.text}` cannot be loaded together"
                secondary = [Label(rival.name.span, "loaded too")]
                helps = ["leave one of them out"]
                reporter.error(
                    "PD306", message, other.span, "declared here", secondary=secondary, helps=helps
                )
    for name, needing in missing.items():
        first, *others = needing
        count = f" and {len(others)} others need" if others else " needs"
        close = get_close_matches(name, sorted(loaded.keys() - needing.keys()), n=1, cutoff=0.75)
        fix = f"load it too, as in `{name}+{first}`"
        if close:
            fix = f"did you mean `{close[0]}`?"
        elif others:
            fix = (
                f"load `{name}` too, or leave out what needs it: {', '.join(f'`{pack}`' for pack in needing)}"
            )
        reporter.error(
            "PD305", f"pack `{first}`{count} `{name}`, which is not loaded", needing[first], "not loaded",
            secondary=[Label(needing[pack], "needed here too") for pack in others[:3]], helps=[fix],
        )  # fmt: skip


def _versions(
    packs: Sequence[PackDecl], book: NameBook, reporter: Reporter
) -> dict[str, list[Named[ElementDecl]]]:
    """The declarations of each element by global name, in load order: the effective one first, then the overridden ones."""
    found: dict[str, list[Named[ElementDecl]]] = {}
    for pack in packs:
        for decl in pack.elements:
            known = book.override(decl.name.text, pack.name.text, "element") if decl.override else None
            if known is not None:
                _check_same_id(decl, found[known], reporter)
                found[known].insert(0, Named(pack.name.text, decl, known))
                continue
            if decl.override:
                _report_no_base(decl.name, reporter)
            if named := book.define(decl, "element", pack.name.text):
                found[named.name] = [named]
    if not found:
        reporter.error(
            "PD109", "no element is defined", packs[0].name.span if packs else None, "a world needs elements",
            helps=["define `elements:`, or load `core` too"],
        )  # fmt: skip
    return found


def _report_no_base(name: Scalar, reporter: Reporter) -> None:
    reporter.error(
        "PD301", f"`{name.text}` overrides nothing", name.span, "no pack before this one defines it",
        helps=["remove `override`, or load the other pack first"],
    )  # fmt: skip


def _passes(packs: Sequence[PackDecl], book: NameBook, reporter: Reporter) -> dict[str, Named[PassDecl]]:
    """The passes by global name. One that overrides another has its name, and its place in the order."""
    found: dict[str, Named[PassDecl]] = {}
    for pack in packs:
        for decl in pack.passes:
            known = book.override(decl.name.text, pack.name.text, "pass") if decl.override else None
            if known is not None:
                old = found[known].decl
                decl = replace(decl, after=(*old.after, *decl.after), before=(*old.before, *decl.before))
                found[known] = Named(pack.name.text, decl, known, "pass")
                continue
            if decl.override:
                _report_no_base(decl.name, reporter)
            if named := book.define(decl, "pass", pack.name.text):
                found[named.name] = named
    return found


def _asking(versions: Sequence[Named[ElementDecl]]) -> ElementDecl | None:
    """The latest declaration of an element that asks for an id."""
    return next((one.decl for one in versions if one.decl.id is not None), None)


def _check_same_id(decl: ElementDecl, before: Sequence[Named[ElementDecl]], reporter: Reporter) -> None:
    """Warn if an element that overrides asks for another id than the one it replaces."""
    old = _asking(before)
    if old and old.id_scalar and decl.id_scalar and decl.id != old.id:
        reporter.report(
            "PD318", f"`{decl.name.text}` gets the id {decl.id} instead of {old.id}", decl.id_scalar.span,
            "its channel moves too", secondary=[Label(old.id_scalar.span, "the id of the element that it replaces")],
            helps=["leave out `id`: an element that overrides another keeps its id"],
        )  # fmt: skip


def _groups(packs: Sequence[PackDecl], ruleset: RulesetDecl | None) -> list[list[PackDecl]]:
    """The packs whose elements and channels are placed together, one group after the other.

    A ruleset's own packs come first, packs that it leaves out included, because their positions stay reserved. Each
    further pack follows by itself, after the packs that it needs: the order in which packs are named matters little.
    """
    own = ruleset.placed if ruleset else ()
    left_out = ruleset.left_out if ruleset else ()
    first = [pack for pack in (*packs, *left_out) if pack.name.text in own]
    first.sort(key=lambda pack: own.index(pack.name.text))
    others = needed_first([pack for pack in packs if pack.name.text not in own])
    return [*([first] if first else []), *([pack] for pack in others)]


def _claims(
    groups: Sequence[Sequence[PackDecl]], own: bool, versions: Mapping[str, list[Named[ElementDecl]]]
) -> list[Claim]:
    """All elements in the order in which ids are decided. In each group, elements that ask for an id come first.

    `own` says that the first group is a ruleset's.
    """
    by_decl = {id(found[-1].decl): found for found in versions.values()}
    claims: list[Claim] = []
    for number, group in enumerate(groups):
        listed = not own or number == 0
        decls = [(pack.name.text, decl) for pack in group for decl in pack.elements]
        found = [_claim(pack, decl, by_decl.get(id(decl)), listed) for pack, decl in decls]
        claims += sorted(filter(None, found), key=lambda claim: claim.decl.id is None)
    return claims


def _claim(
    pack: str, decl: ElementDecl, versions: Sequence[Named[ElementDecl]] | None, own: bool
) -> Claim | None:
    """The claim of an element, as its last override states it; None for a declaration that is an override itself."""
    if versions is None:
        qualified = f"{pack}.{decl.name.text}"  # defined by a pack that is left out: the id stays reserved
        return None if decl.override else Claim(f"-{qualified}", qualified, pack, decl, own, is_loaded=False)
    names = [f"{one.pack}.{one.decl.name.text}" for one in versions]
    final, asking = versions[0], _asking(versions) or versions[0].decl
    asked = replace(final.decl, id=asking.id, id_scalar=asking.id_scalar)
    return Claim(final.name, names[0], final.pack, asked, own, tuple(names[1:]))


def _elements(
    declared: Sequence[Named[ElementDecl]], ids: Mapping[str, int], reporter: Reporter
) -> dict[str, Element]:
    """The elements by ascending id. A glyph that another element has already is replaced by a free one."""
    owners: dict[str, Named[ElementDecl]] = {}
    for named in declared:
        glyph = named.decl.glyph
        first = owners.setdefault(glyph, named) if glyph else named
        if first is not named and first.pack == named.pack:
            reporter.error(
                "PD302", f"elements `{first.decl.name.text}` and `{named.decl.name.text}` have the same glyph `{glyph}`",
                named.span, "this one", secondary=[Label(first.span, "and this one")], helps=["give one of them another glyph"],
            )  # fmt: skip
    declared = [named for named in declared if named.name in ids]
    glyphs = _glyphs(declared)
    return {
        named.name: Element(
            named.name,
            named.pack,
            ids[named.name],
            named.decl.color,
            glyphs[named.name],
            named.decl.about,
            frozenset(),
            named.span,
            named.word,
        )
        for named in sorted(declared, key=lambda named: ids[named.name])
    }


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


def _colored(composition: Composition) -> dict[str, Element]:
    """The elements, with the colors that `also` gives them."""
    colors = {
        name: entry.color
        for _, name, entry in composition.entries()
        if isinstance(entry, AlsoDecl) and entry.color is not None
    }
    return {
        name: replace(element, color=colors.get(name, element.color))
        for name, element in composition.elements.items()
    }


def _tags(composition: Composition, reporter: Reporter) -> dict[str, frozenset[int]]:
    """The ids of the elements that carry each tag. Reports tags and elements that no pack defines."""
    elements = composition.elements
    members: dict[str, set[int]] = {tag: set() for tag in composition.tag_decls}
    for pack, element, entry in composition.entries():
        if isinstance(entry, AlsoDecl) and element not in elements and not entry.name.is_optional:
            report_unknown("element", entry.name, elements, reporter)
        for scalar in entry.tags:
            tag = composition.names.of(pack, scalar.word)
            if tag in members:
                members[tag] |= {elements[element].id} if element in elements else set()
            elif not scalar.is_optional:
                more = "; to make a tag, declare it under `tags:`"
                report_unknown("tag", scalar, members, reporter, more=more)
    return {tag: frozenset(ids) for tag, ids in members.items()}
