"""Where channels stand: in an order that further packs do not disturb.

First comes what a ruleset's own packs hold, as its `matrix:` says, with one channel for each of its ids; without a
ruleset the first pack stands in its place. Then, for each further pack in load order: its elements, the properties that
its rules are the first to assign, and its fields. So channels stay where they are when packs are added.
"""

from __future__ import annotations

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.composition.claim_scopes import names_left_out
from powderdsl.model.composition.compose import Composition
from powderdsl.model.expressions.symbols import Symbols
from powderdsl.model.types import Assign, MatrixChannel, Pass
from powderdsl.syntax.yaml_tree import Scalar

COMPONENTS = ("row", "column")


def state_order(composition: Composition, symbols: Symbols, passes: tuple[Pass, ...]) -> tuple[str, ...]:
    """The names of all that a cell holds besides its element: stored properties and fields, block by block."""
    return tuple(name for block in _blocks(composition, symbols, passes) for name in block)


def matrix_channels(
    composition: Composition, symbols: Symbols, passes: tuple[Pass, ...], reporter: Reporter
) -> tuple[MatrixChannel, ...]:
    """The channels of `World.matrix()`. Reports names in a ruleset's `matrix:` that no loaded pack has."""
    own, *others = _blocks(composition, symbols, passes)
    elements = composition.elements.values()
    names = {element.id: element.name for element in elements}
    size = own_slots(composition)
    first = [MatrixChannel(names.get(number, ""), id=number) for number in range(size)]
    written = composition.ruleset.placing.matrix if composition.ruleset else ()
    channels: list[MatrixChannel] = []
    for scalar in written:
        channels += first if scalar.word == "elements" else _written(scalar, composition, symbols, reporter)
    if written and all(scalar.word != "elements" for scalar in written):
        return tuple(channels)  # a ruleset that shows no elements shows none of further packs either
    if not written:
        channels = [*first, *_holding(own, symbols)]
    for (pack,), block in zip(composition.groups[1:], others, strict=True):
        added = [element for element in elements if element.pack == pack and element.id >= size]
        channels += [MatrixChannel(element.name, id=element.id) for element in added]
        channels += _holding(block, symbols)
    return tuple(channels)


def _written(
    scalar: Scalar, composition: Composition, symbols: Symbols, reporter: Reporter
) -> list[MatrixChannel]:
    """The channels that a name under `matrix:` stands for; always 0 if its pack is not loaded."""
    name = scalar.word
    found = _named(name, composition, symbols)
    waits = scalar.is_optional or not names_left_out(composition.ruleset).isdisjoint(name.split("."))
    if not found and not waits:
        known = ["elements", *symbols.properties, *symbols.fields]
        helps = [
            *suggest(name.partition(".")[0], known, "channels"),
            f"if its pack may be absent, write `{name}?`",
        ]
        message, label = f"unknown channel `{scalar.text}`", "not a field or property"
        reporter.error("PD310", message, scalar.span, label, helps=helps)
    return found or [MatrixChannel(name)]


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
    for pass_ in passes:
        for rule in (rule for moment in pass_.moments for rule in moment.rules):
            for update in (rule,) if isinstance(rule, Assign) else rule.effects:
                first[update.field] = min(place[pass_.pack], first.get(update.field, place[pass_.pack]))
    for name, prop in symbols.properties.items():
        if prop.stored:
            blocks[max(first.get(name, 0), place[prop.pack])].append(name)
    for name, field in symbols.fields.items():
        blocks[place[field.pack]].append(name)
    return blocks


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
