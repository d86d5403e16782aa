"""Declarations of several packs -> one composition, with unique names, ids of elements, and ordered passes.

Ids are assigned here, or recorded in a palette: the qualified name of the element of each id, or None for a free id.
Worlds, datasets and checkpoints store one, so that ids keep their meaning whatever is loaded later.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import chain, pairwise
from math import lcm
from operator import attrgetter
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, Reporter, Source, Span, suggest
from powderdsl.model.builtins import RESERVED
from powderdsl.model.composition.names import (
    Names,
    needed_first,
    order_passes,
    report_unknown,
    with_stand_ins,
)
from powderdsl.model.declarations import (
    SHARED,
    AlsoDecl,
    ElementDecl,
    FieldDecl,
    PackDecl,
    ParamDecl,
    PassDecl,
    PropertyDecl,
    RulesetDecl,
    TagDecl,
)
from powderdsl.model.types import (
    Element,
    Field,
    MatrixChannel,
    Param,
    Pass,
    Property,
    Stream,
    substeps,
    writes_of,
)
from powderdsl.syntax.parse import Syntax, reserved_words
from powderdsl.syntax.yaml_tree import Scalar

if TYPE_CHECKING:
    from powderdsl.model.expressions.operators import Operand

MAX_ELEMENTS = 256
"""Ids fit into a byte."""

NO_SOURCE = Source("", "")
NO_PLACE = Span(NO_SOURCE, 0, 0)
NO_RULESET = RulesetDecl(name=Scalar("", NO_PLACE, NO_PLACE, "plain"), source=NO_SOURCE)

Palette = Sequence[str | None]
"""By id: an element's qualified name, or None."""


@dataclass
class Composition:
    """Merged packs and their global names. Dictionaries are by global name, in load order."""

    packs: dict[str, PackDecl]
    ruleset: RulesetDecl
    """`NO_RULESET` for packs without one."""
    names: Names
    passes: dict[str, PassDecl]
    """In the order in which they run."""
    param_decls: dict[str, ParamDecl]
    """By qualified name."""
    elements: dict[str, Element]
    """By ascending id."""
    slots: int
    order: dict[int, int]
    """The position of each id in loops over elements, as without a palette."""
    group: dict[str, int]
    """By pack: the number of the group of its elements and channels. The first group is placed as if it were alone."""
    own_slots: int
    """The number of ids reserved for the first group, including packs that are left out."""
    properties: dict[str, Property] = field(default_factory=dict)
    """This and the following attributes are set by `check.resolve_names`."""
    fields: dict[str, Field] = field(default_factory=dict)
    streams: dict[str, Stream] = field(default_factory=dict)
    params: dict[str, Param] = field(default_factory=dict)
    constants: dict[str, Operand] = field(default_factory=dict)
    """Elements, tags, sets, kernels, directions."""

    @cached_property
    def names_by_id(self) -> dict[int, str]:
        return {element.id: name for name, element in self.elements.items()}

    @property
    def first_id(self) -> int:
        """The default of fields of kind ``element``."""
        return min(self.names_by_id, key=self.order.__getitem__)

    def is_declared(self, name: str, pack: str) -> bool:
        """True if some pack declares the name, even incorrectly."""
        return self.names.of(pack, name) in self.names.versions or f"{pack}.{name}" in self.param_decls

    @cached_property
    def side_multiple(self) -> int:
        """The least common multiple of the packs' `side_multiple`."""
        return lcm(*map(attrgetter("side_multiple"), self.packs.values()))

    @cached_property
    def left_out(self) -> frozenset[str]:
        """Names of packs that a ruleset leaves out: its own lines may use them as if they ended in `?`."""
        words: set[str] = set()
        for pack in self.ruleset.left_out.values():
            for section in SHARED:
                words.update(decl.name.text for decl in getattr(pack, section))
        return frozenset(words)

    def scope(self, author: str | RulesetDecl, words: Iterable[str] = ()) -> tuple[str, ...]:
        """The packs in the scope of a pack or ruleset, in load order. All others were added.

        These are a ruleset's packs, or the pack and those of the ruleset that lists it; the packs that define some
        words that the author uses; and all that these need.
        """
        if isinstance(author, RulesetDecl):
            known, speaker = [*author.members], ""
        else:
            known, speaker = [author], author
            for ruleset in self.ruleset.lineage:
                if author in ruleset.members:
                    known += ruleset.members[author].members
                    break
        for word in words:
            pack = self.names.pack(self.names.of(speaker, word)) or word.rpartition(".")[0]  # of a parameter
            known += [pack] if pack else []
        reached = set[str]().union(*(self.names.needs.get(pack, (pack,)) for pack in known))
        return tuple(pack for pack in self.packs if pack in reached)

    @cached_property
    def entries(self) -> list[tuple[str, ElementDecl | AlsoDecl]]:
        """The entries of all elements, each with its element's global name (as written if absent).

        In rising precedence: the elements' own entries, then those under `also`, each pack after those that it needs. A
        ruleset comes after its packs, and packs that are added to it come last.
        """
        own: list[AlsoDecl] = []
        added: list[AlsoDecl] = []
        for pack in needed_first(self.packs):
            is_own = any(pack in ruleset.members for ruleset in self.ruleset.lineage)
            (own if is_own else added).extend(self.packs[pack].also)
        for ruleset in self.ruleset.lineage:
            own += [_mark_optional(decl, self.left_out) for decl in ruleset.also]
        entries: list[tuple[str, ElementDecl | AlsoDecl]] = [*self.names.declared(ElementDecl).items()]
        for decl in (*own, *added):
            entries.append((self.names.of(decl.pack, decl.name.word), decl))
        return entries

    def given_values(self) -> Iterator[tuple[str, str, str, Scalar, Syntax]]:
        """Every value of a single element, in rising precedence: those of entries, then those beside the property or field.

        Each is a pack, a property or field and an element by global name (one that is absent as written), key and value.
        """
        for element, entry in self.entries:
            for key, syntax in entry.values:
                yield entry.pack, self.names.of(entry.pack, key.word), element, key, syntax
        typed = [*self.names.declared(PropertyDecl).items(), *self.names.declared(FieldDecl).items()]
        for name, decl in typed:
            for key, syntax in decl.values:
                yield decl.pack, name, self.names.of(decl.pack, key.word), key, syntax

    def glyphs_alone(self, packs: Sequence[str]) -> dict[str, str]:
        """The glyphs of elements, by global name, if only some packs are loaded."""
        alone = {}
        for pack in packs:
            for decl in self.packs[pack].elements:
                alone[self.names.of(pack, decl.name.text)] = decl
        return _glyphs(alone)

    def element(self, word: str, pack: str) -> str | None:
        """The global name of the element that a pack means by a plain or qualified name."""
        name = self.names.of(pack, word)
        return name if name in self.elements else None


def _mark_optional(also: AlsoDecl, names: frozenset[str]) -> AlsoDecl:
    """The addition of a ruleset to an element, with a `?` after some names."""

    def optional(scalar: Scalar) -> Scalar:
        return replace(scalar, text=f"{scalar.text}?") if scalar.text in names else scalar

    tags = tuple(map(optional, also.tags))
    values = tuple((optional(key), value) for key, value in also.values)
    return replace(also, name=optional(also.name), tags=tags, values=values)


def with_optional(syntax: Syntax, names: frozenset[str]) -> Syntax:
    """The expression with a `?` after some names."""
    kind = "optional_name" if syntax.kind == "name" and syntax.text in names else syntax.kind
    return replace(
        syntax, kind=kind, children=tuple(with_optional(child, names) for child in syntax.children)
    )


def compose(
    packs: Sequence[PackDecl], ruleset: RulesetDecl | None, reporter: Reporter, palette: Palette | None = None
) -> Composition:
    """Merge packs in the order given. Reports clashes of names and ids, missing packs, and cycles of passes.

    `palette` has recorded ids.
    """
    ruleset = ruleset or NO_RULESET
    loaded = with_stand_ins(packs)
    _check_needs(loaded, ruleset.left_out, reporter)
    reporter.raise_if_errors()  # every name of a missing pack would be reported too
    names = Names(loaded, SHARED, ruleset.renames, reporter, RESERVED | reserved_words() | {"elements"})
    params = {}
    for pack in loaded.values():
        for param in pack.params:
            names.check_word(param.name, ParamDecl.NOUN)
            params[param.qualified] = param
    passes = Names(loaded, ("passes",), ruleset.renames, reporter)
    for name, (old, _) in ruleset.renames.items():
        if name not in names.renamed | passes.renamed and name.partition(".")[0] not in ruleset.left_out:
            reporter.error(
                "PD310", f"nothing is named `{name}`", old.span, "no loaded pack defines this",
                helps=["write the pack's name, a point, and the name that it defines: `pack.word`"],
            )  # fmt: skip
    declared = names.declared(ElementDecl)
    if not declared:
        reporter.error(
            "PD109", "no element is defined", packs[0].name.span if packs else None, "a world needs elements",
            helps=["define `elements:`, or load `core` too"],
        )  # fmt: skip
    groups = _groups(loaded, ruleset)
    requests = [_id_requests(group, names, reporter) for group in groups]
    natural = _ids(requests, names, ruleset is not NO_RULESET)
    ids = _ids(requests, names, ruleset is not NO_RULESET, palette) if palette else natural
    _report_ids([*chain.from_iterable(requests)], ids, names, reporter, recorded=palette is not None)
    elements = _elements(declared, ids, reporter)
    wanted = ruleset.layout_ruleset.slots or 0
    own = max((ids.get(decl.qualified, -1) for decl in requests[0]), default=-1) + 1 if requests else 0
    # The packs of the ruleset that declares `slots` must fit; packs loaded on top of them add slots.
    beyond = [e for e in elements.values() if 0 < wanted <= e.id and e.pack in ruleset.leading_packs]
    if palette is None and beyond:
        top = beyond[-1]
        reporter.error(
            "PD402", f"element `{top.name}` has id {top.id}, but the ruleset has {wanted} slots", top.span,
            helps=[f"write `slots: {top.id + 1}` in {ruleset.layout_ruleset.source.name}"],
        )  # fmt: skip
    composition = Composition(
        packs=loaded,
        ruleset=ruleset,
        names=names,
        passes=order_passes(passes, reporter),
        param_decls=params,
        elements=elements,
        slots=max(wanted, len(palette or ()), 1 + max(ids.values(), default=0)),
        order={number: natural.get(name, number) for name, number in ids.items()},
        group={pack.name.text: number for number, group in enumerate(groups) for pack in group},
        own_slots=wanted or own,
    )
    _add_entries(composition, reporter)
    return composition


def title(loaded: Collection[str], ruleset: RulesetDecl) -> str:
    """The title of what is loaded: a ruleset, packs left out of it, packs added: ``ruleset-pack+pack``."""
    members = ruleset.members
    gone = [f"-{name}" for name in members if name not in loaded]
    added = [f"+{name}" for name in loaded if name not in members]
    return "".join([ruleset.name.text, *gone, *added]).removeprefix("+")


def _check_needs(loaded: Mapping[str, PackDecl], left_out: Collection[str], reporter: Reporter) -> None:
    """Report packs that cannot be loaded together, and required packs that are not loaded."""
    stands_in: dict[str, PackDecl] = {}
    missing: dict[str, dict[str, Span]] = {}
    for name, pack in loaded.items():
        for need in pack.needs:
            if need.text == name:
                reporter.error(
                    "PD307", f"pack `{name}` needs itself", need.span, "this pack", helps=["remove it"]
                )
            if need.text not in loaded:
                missing.setdefault(need.text, {})[name] = need.span
        for other in (*pack.conflicts, *pack.provides):
            rival = loaded.get(other.text)
            if other in pack.provides:
                rival = rival or stands_in.get(other.text)
                stands_in.setdefault(other.text, pack)
            if rival is not None:
                reporter.error(
                    "PD306", f"packs `{name}` and `{rival.name.text}` cannot be loaded together",
                    other.span, "declared here", secondary=[Label(rival.name.span, "loaded too")],
                    helps=["leave one of them out"],
                )  # fmt: skip
    for name, needing in missing.items():
        first, *others = needing
        count = f" and {len(others)} others need" if others else " needs"
        fix = f"no such pack is shipped: put `{name}.yaml` into the folder of `{loaded[first].source.name}`"
        if close := get_close_matches(name, sorted(loaded.keys() - needing.keys()), n=1, cutoff=0.75):
            fix = f"did you mean `{close[0]}`?"
        elif name in left_out:
            fix = f"also leave out the packs that need it: {', '.join(f'`-{pack}`' for pack in needing)}"
        reporter.error(
            "PD305", f"pack `{first}`{count} `{name}`, which is not loaded", needing[first], "not loaded",
            secondary=[Label(needing[pack], "needed here too") for pack in others[:3]], helps=[fix],
        )  # fmt: skip


# Ids


def _groups(packs: Mapping[str, PackDecl], ruleset: RulesetDecl) -> list[list[PackDecl]]:
    """Groups of packs whose elements and channels are placed together.

    A ruleset's own packs come first, including those that it leaves out, whose positions stay reserved. Each further
    pack forms a group after those that it needs, so that the order in which packs are named matters little.
    """
    own = ruleset.leading_packs
    groups = [
        [packs.get(name) or ruleset.left_out[name] for name in own if name in packs.keys() | ruleset.left_out]
    ]
    for name in needed_first(packs):
        if name not in own:
            groups.append([packs[name]])
    return groups if groups[0] else groups[1:]


def _id_requests(group: Sequence[PackDecl], names: Names, reporter: Reporter) -> list[ElementDecl]:
    """The elements of some packs in the order in which ids are assigned, those that request an id first.

    An element that overrides another requests the same id; another id in its file is a warning.
    Elements of packs that are left out keep their ids reserved.
    """
    requests: list[ElementDecl] = []
    others: list[ElementDecl] = []
    for decl in chain.from_iterable(pack.elements for pack in group):
        versions = names.versions.get(names.known.get(decl.qualified, ""), [decl])
        if versions[-1] is not decl or (decl.override and decl.qualified not in names.known):
            continue
        asking = [version for version in versions if version.id]
        for new, old in pairwise(asking):
            if new.number != old.number:
                reporter.report(
                    "PD318", f"`{new.name.text}` gets the id {new.number} instead of {old.number}", new.id.span,
                    "its channel moves too", secondary=[Label(old.id.span, "the id of the element that it replaces")],
                    helps=["omit `id`: an element that overrides another keeps its id"],
                )  # fmt: skip
        if asking:
            requests.append(replace(versions[0], id=asking[0].id))
        else:
            others.append(versions[0])
    return requests + others


def _ids(
    groups: Sequence[Sequence[ElementDecl]], names: Names, of_ruleset: bool, palette: Palette = ()
) -> dict[str, int]:
    """Ids by qualified name. Earlier groups come first, so that further packs do not change them.

    An element gets the id that a palette has for it or for the element that it overrides, or else the id in its file,
    unless that is taken or beyond the palette. All others get the lowest free id: above those of the ruleset's packs
    (the first group) or, without a ruleset, above all ids so far; with a palette, anywhere.
    """
    recorded = {name: number for number, name in enumerate(palette) if name is not None}
    ids: dict[str, int] = {}
    free = [number for number in range(MAX_ELEMENTS) if number not in recorded.values()]
    highest = -1
    for place, group in enumerate(groups):
        for decl in group:
            versions = names.versions.get(names.known.get(decl.qualified, ""), [decl])
            number = next((recorded[v.qualified] for v in versions if v.qualified in recorded), None)
            if number is None and free:
                number = decl.number
                if number not in free or 0 < len(palette) <= number:
                    number = next((n for n in free if n > highest), free[0])
                free.remove(number)
                if not palette and (place == 0 or not of_ruleset):
                    highest = max(highest, number)
            if number is not None:
                ids[decl.qualified] = number
    return ids


def _report_ids(
    requests: Sequence[ElementDecl],
    ids: Mapping[str, int],
    names: Names,
    reporter: Reporter,
    *,
    recorded: bool,
) -> None:
    """Report elements without an id, two elements of one pack with the same id, and ids that differ from the file."""
    loaded = [decl for decl in requests if decl.qualified in names.known]
    for decl in loaded:
        if decl.qualified not in ids:
            label = f"the limit is {MAX_ELEMENTS}"
            reporter.error("PD508", f"{len(loaded)} elements", decl.span, label, helps=["load fewer packs"])
            break
    holders = dict(zip(ids.values(), ids, strict=True))
    by_number: dict[tuple[str, int], ElementDecl] = {}
    for decl in loaded:
        if decl.id is None or decl.number is None:
            continue
        name, wanted = decl.qualified, decl.number
        first = by_number.setdefault((decl.pack, wanted), decl)
        if first is not decl:
            reporter.error(
                "PD303", f"elements `{first.name.text}` and `{decl.name.text}` have the same id {wanted}",
                decl.id.span, "already taken", secondary=[Label(first.span, "by this one")],
                helps=["omit `id:`: the element gets a free one"],
            )  # fmt: skip
        elif not recorded and ids.get(name, wanted) != wanted:
            reporter.report(
                "PD313", f"`{name}` has id {ids[name]} here, not {wanted}",
                decl.id.span, f"`{holders[wanted]}` has id {wanted}",
                notes=["saved worlds, datasets and checkpoints refer to elements by name, not by id"],
            )  # fmt: skip


# Elements


def _elements(
    declared: Mapping[str, ElementDecl], ids: Mapping[str, int], reporter: Reporter
) -> dict[str, Element]:
    """The elements by ascending id. A glyph that another element already has is replaced by a free one."""
    owners: dict[str, ElementDecl] = {}
    for decl in declared.values():
        first = owners.setdefault(decl.glyph, decl) if decl.glyph else decl
        if first is not decl and first.pack == decl.pack:
            reporter.error(
                "PD302", f"elements `{first.name.text}` and `{decl.name.text}` have the same glyph `{decl.glyph}`",
                decl.span, "this one", secondary=[Label(first.span, "and this one")], helps=["give one of them another glyph"],
            )  # fmt: skip
    glyphs = _glyphs(declared)
    elements = []
    for name, decl in declared.items():
        number, word = ids.get(decl.qualified, MAX_ELEMENTS), decl.name.text if decl.name.text != name else ""
        elements.append(
            Element(
                name, decl.pack, number, decl.color, glyphs[name], decl.about, frozenset(), decl.span, word
            )
        )
    return {element.name: element for element in sorted(elements, key=attrgetter("id"))}


def _glyphs(elements: Mapping[str, ElementDecl]) -> dict[str, str]:
    """A glyph for each global name: glyphs of files first, then free letters in the order of the elements."""
    owners: dict[str, ElementDecl] = {}
    for decl in elements.values():
        if decl.glyph:
            owners.setdefault(decl.glyph, decl)
    taken = set(owners)
    glyphs: dict[str, str] = {}
    for name, decl in elements.items():
        word, glyph = decl.name.text, decl.glyph
        if not glyph or owners[glyph] is not decl:
            signs = "@$&*+=<>"
            letters = [*word, *word.upper(), *"0123456789", *signs]
            allowed = (c for c in letters if c.isalnum() or c in signs)
            glyph = next((c for c in allowed if c not in taken), "?")
        taken.add(glyph)
        glyphs[name] = glyph
    return glyphs


def _add_entries(composition: Composition, reporter: Reporter) -> None:
    """Give elements the tags and colors of entries. Reports tags and elements that nothing defines."""
    elements, tags = composition.elements, composition.names.declared(TagDecl)
    for name, entry in composition.entries:
        element = elements.get(name)
        if isinstance(entry, AlsoDecl) and element is None:
            report_unknown("element", entry.name, elements, reporter)
        known_tags = set()
        for scalar in entry.tags:
            tag = composition.names.of(entry.pack, scalar.word)
            if tag in tags:
                known_tags.add(tag)
            else:
                more = "; to make a tag, declare it under `tags:`"
                report_unknown("tag", scalar, tags, reporter, more=more)
        if element is not None:
            tags_of = element.tags | known_tags
            elements[name] = replace(element, color=entry.color or element.color, tags=tags_of)


# Channels, in an order that further packs do not disturb

COMPONENTS = ("row", "column")

Channels = dict[str, list[MatrixChannel]]
"""By the name of a property or field."""


def lay_out(
    composition: Composition, passes: tuple[Pass, ...], reporter: Reporter
) -> tuple[tuple[str, ...], tuple[MatrixChannel, ...]]:
    """The names of all that a cell stores besides its element, in order, and the channels of `World.matrix()`.

    The packs of a ruleset come first, as its `matrix:` lists them, with a channel for each of its ids; without a ruleset
    the first pack does. For each further pack follow, in load order, its elements, the properties that its rules are the
    first to assign, and its fields. So channels keep their place when packs are added.

    Reports names in a ruleset's `matrix:` that no loaded pack defines.
    """
    fields, names, size = composition.fields, composition.names_by_id, composition.own_slots
    known: Channels = {name: [MatrixChannel(name, name)] for name in (*composition.properties, *fields)}
    for name, declared in fields.items():
        if declared.kind.name == "vec2":
            known[name] = [MatrixChannel(f"{name}.{part}", name, part=part) for part in COMPONENTS]
    blocks = _blocks(composition, passes)
    parts: list[list[MatrixChannel]] = [[] for _ in range(2 * len(blocks))]
    """The channels of elements, and those of persistent fields and properties, in turn, by group of packs."""
    for number in sorted({*range(size), *names}):
        group = composition.group[composition.elements[names[number]].pack] if number >= size else 0
        parts[2 * group].append(MatrixChannel(names.get(number, ""), id=number))
    for group, block in enumerate(blocks):
        for name in block:
            if name not in fields or not fields[name].resets:
                parts[2 * group + 1] += known[name]
    written = composition.ruleset.layout_ruleset.matrix
    if written:
        own = [_named_channels(scalar, known, composition, reporter) for scalar in written]
        shown = [parts[0] if channels is None else channels for channels in own]
        # A ruleset without channels of elements has none for further packs either.
        parts = [*shown, *parts[2:]] if None in own else shown
    order = tuple(name for block in blocks for name in block)
    return order, tuple(channel for part in parts for channel in part)


def _blocks(composition: Composition, passes: tuple[Pass, ...]) -> list[list[str]]:
    """Stored properties and fields, by group of packs."""
    place = composition.group
    blocks: list[list[str]] = [[] for _ in range(max(place.values()) + 1)]
    first: dict[str, int] = {}
    for pass_, substep in substeps(passes):
        for rule in substep.rules:
            for write in writes_of(rule):
                first[write.field] = min(place[pass_.pack], first.get(write.field, place[pass_.pack]))
    for name, prop in composition.properties.items():
        if prop.stored:
            blocks[max(first.get(name, 0), place[prop.pack])].append(name)
    for name, declared in composition.fields.items():
        blocks[place[declared.pack]].append(name)
    return blocks


def _named_channels(
    scalar: Scalar, known: Channels, composition: Composition, reporter: Reporter
) -> list[MatrixChannel] | None:
    """The channels of a name under `matrix:`, the plain or qualified name of a field, a property or a component.

    None for all elements; one channel that is always 0 if its pack is not loaded.
    """
    word = scalar.word
    if word == "elements":
        return None
    base, _, part = word.rpartition(".")
    name, component = (base, part) if part in COMPONENTS and base else (word, "")
    name = composition.names.known.get(name, name)
    channels = [channel for channel in known.get(name, ()) if not component or channel.part == component]
    if not channels and not scalar.is_optional and composition.left_out.isdisjoint(word.split(".")):
        helps = suggest(word.partition(".")[0], ["elements", *known], "channels")
        reporter.error(
            "PD310", f"unknown channel `{scalar.text}`", scalar.span, "not a field or property",
            helps=[*helps, f"if its pack may be absent, write `{word}?`"],
        )  # fmt: skip
    return channels or [MatrixChannel(word)]
