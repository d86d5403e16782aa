"""Where channels stand: in an order that further packs do not disturb.

First comes what a ruleset's own packs hold, as its `matrix:` says, with one channel for each of its ids; without a
ruleset the first pack stands in its place. Then, for each further pack in load order: its elements, the properties that
its rules are the first to assign, and its fields. So channels stay where they are when packs are added.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.composition.claim_scopes import names_left_out
from powderdsl.model.composition.compose import Composition
from powderdsl.model.expressions.symbols import Symbols
from powderdsl.model.types import Element, MatrixChannel, Move, Pass, Swap, Transform

COMPONENTS = ("row", "column")


def state_order(composition: Composition, symbols: Symbols, passes: tuple[Pass, ...]) -> tuple[str, ...]:
    """The names of all that a cell holds besides its element: stored properties and fields, block by block."""
    return tuple(name for block in _blocks(composition, symbols, passes) for name in block)


def matrix_channels(
    composition: Composition, symbols: Symbols, passes: tuple[Pass, ...], reporter: Reporter
) -> tuple[MatrixChannel, ...]:
    """The channels of `World.matrix()`. Reports names in a ruleset's `matrix:` that no loaded pack has."""
    own, *others = _blocks(composition, symbols, passes)
    elements = composition.elements
    by_id = {element.id: element for element in elements.values()}
    channels: list[MatrixChannel] = []
    size = own_slots(composition)
    first = [MatrixChannel(by_id[n].name if n in by_id else "", id=n) for n in range(size)]
    written = composition.ruleset.placing.matrix if composition.ruleset else ()
    gone = names_left_out(composition.ruleset)
    if written:
        for scalar in written:
            name = scalar.word
            if name == "elements":
                channels += first
                continue
            found = _named(name, composition, symbols)
            waits = scalar.is_optional or not gone.isdisjoint(name.split("."))
            if not found and not waits:
                known = ["elements", *symbols.properties, *symbols.fields]
                helps = [
                    *suggest(name.partition(".")[0], known, "channels"),
                    f"if its pack may be absent, write `{name}?`",
                ]
                reporter.error(
                    "PD310", f"unknown channel `{scalar.text}`", scalar.span, "not a field or property", helps=helps
                )  # fmt: skip
            channels += found or [MatrixChannel(name)]
        if all(scalar.word != "elements" for scalar in written):
            return tuple(channels)  # a ruleset that shows no elements shows none of further packs either
    else:
        channels += [*first, *_holding(own, symbols)]
    for (pack,), block in zip(composition.groups[1:], others, strict=True):
        channels += [
            MatrixChannel(element.name, id=element.id)
            for element in _elements_of(pack, elements)
            if element.id >= size
        ]
        channels += _holding(block, symbols)
    return tuple(channels)


def own_slots(composition: Composition) -> int:
    """How many ids the first packs have room for."""
    if composition.ruleset is not None and composition.ruleset.placing.slots:
        return composition.ruleset.placing.slots
    own = composition.groups[0]
    kept = [element.id for element in composition.elements.values() if element.pack in own]
    return max([*kept, *composition.reserved], default=-1) + 1


def _blocks(composition: Composition, symbols: Symbols, passes: tuple[Pass, ...]) -> list[list[str]]:
    """Stored properties and fields, by group of packs."""
    place = {pack: number for number, group in enumerate(composition.groups) for pack in group}
    blocks: list[list[str]] = [[] for _ in composition.groups]
    first: dict[str, int] = {}
    for name, pack in _assignments(passes):
        first[name] = min(place[pack], first.get(name, place[pack]))
    for name, prop in symbols.properties.items():
        if prop.stored:
            blocks[max(first.get(name, 0), place[prop.pack])].append(name)
    for name, field in symbols.fields.items():
        blocks[place[field.pack]].append(name)
    return blocks


def _assignments(passes: tuple[Pass, ...]) -> Iterator[tuple[str, str]]:
    """What is assigned, and the pack whose rule does it."""
    for pass_ in passes:
        for moment in pass_.moments:
            for rule in moment.rules:
                updates = rule.effects if isinstance(rule, (Transform, Swap, Move)) else (rule,)
                yield from ((update.field, pass_.pack) for update in updates)


def _elements_of(pack: str, elements: Mapping[str, Element]) -> list[Element]:
    return [element for element in elements.values() if element.pack == pack]


def _holding(names: list[str], symbols: Symbols) -> list[MatrixChannel]:
    """The channels of what lasts from step to step."""
    lasting = [name for name in names if name not in symbols.fields or not symbols.fields[name].resets]
    return [channel for name in lasting for channel in _channels(name, symbols)]


def _channels(name: str, symbols: Symbols) -> list[MatrixChannel]:
    field = symbols.fields.get(name)
    if field is not None and field.kind.name == "vec2":
        return [MatrixChannel(f"{name}.{part}", name, part=part) for part in COMPONENTS]
    return [MatrixChannel(name, name)]


def _named(name: str, composition: Composition, symbols: Symbols) -> list[MatrixChannel]:
    """The channels of a field, a property or a component, by its plain or qualified name."""
    base, _, part = name.rpartition(".")
    if part in COMPONENTS and base:
        channels = _named(base, composition, symbols)
        return [channel for channel in channels if channel.part == part]
    if base:
        name = composition.names.qualified(base, part) or name
    if name not in symbols.properties and name not in symbols.fields:
        return []
    return _channels(name, symbols)
