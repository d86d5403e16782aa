"""Where channels stand: in an order that further packs do not disturb.

First comes what a ruleset's own packs hold, as its `matrix:` says, with one channel for each of its ids; without a
ruleset the first pack stands in its place. Then, for each further pack in load order: its elements, the properties that
its rules are the first to assign, and its fields. So channels stay where they are when packs are added.
"""

from __future__ import annotations

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.composition.compose import Composition
from powderdsl.model.expressions.symbols import Symbols
from powderdsl.model.types import Assign, MatrixChannel, Pass
from powderdsl.syntax.yaml_tree import Scalar

COMPONENTS = ("row", "column")


def lay_out(
    symbols: Symbols, passes: tuple[Pass, ...], reporter: Reporter
) -> tuple[tuple[str, ...], tuple[MatrixChannel, ...]]:
    """The names of all that a cell holds besides its element, in order, and the channels of `World.matrix()`.

    Reports names in a ruleset's `matrix:` that no loaded pack has.
    """
    composition = symbols.composition
    blocks = _blocks(symbols, passes)
    order = tuple(name for block in blocks for name in block)
    elements = composition.elements.values()
    names = {element.id: element.name for element in elements}
    size = own_slots(composition)
    first = [MatrixChannel(names.get(number, ""), id=number) for number in range(size)]
    written = composition.ruleset.placing.matrix if composition.ruleset else ()
    channels = [] if written else [*first, *_holding(blocks[0], symbols)]
    for scalar in written:
        channels += first if scalar.word == "elements" else _written(scalar, symbols, reporter)
    if written and all(scalar.word != "elements" for scalar in written):
        return order, tuple(channels)  # a ruleset that shows no elements shows none of further packs either
    for (pack,), block in zip(composition.groups[1:], blocks[1:], strict=True):
        added = [element for element in elements if element.pack == pack and element.id >= size]
        channels += [MatrixChannel(element.name, id=element.id) for element in added]
        channels += _holding(block, symbols)
    return order, tuple(channels)


def own_slots(composition: Composition) -> int:
    """How many ids the first packs have room for."""
    if composition.ruleset is not None and composition.ruleset.placing.slots:
        return composition.ruleset.placing.slots
    own = composition.groups[0]
    ids = [element.id for element in composition.elements.values() if element.pack in own]
    return max([*ids, *composition.reserved], default=-1) + 1


def _blocks(symbols: Symbols, passes: tuple[Pass, ...]) -> list[list[str]]:
    """Stored properties and fields, by group of packs."""
    groups = symbols.composition.groups
    place = {pack: number for number, group in enumerate(groups) for pack in group}
    blocks: list[list[str]] = [[] for _ in groups]
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


def _written(scalar: Scalar, symbols: Symbols, reporter: Reporter) -> list[MatrixChannel]:
    """The channels that a name under `matrix:` stands for: of a field, a property or a component, plain or qualified.

    One that is always 0 if its pack is not loaded.
    """
    composition, word = symbols.composition, scalar.word
    base, _, part = word.rpartition(".")
    name, component = (base, part) if part in COMPONENTS and base else (word, "")
    pack, point, own = name.rpartition(".")
    name = (composition.names.qualified(pack, own) if point else None) or name
    if name in symbols.properties or name in symbols.fields:
        channels = [one for one in _channels(name, symbols) if not component or one.part == component]
        if channels:
            return channels
    if not scalar.is_optional and composition.left_out.isdisjoint(word.split(".")):
        known = ["elements", *symbols.properties, *symbols.fields]
        helps = suggest(word.partition(".")[0], known, "channels")
        reporter.error(
            "PD310", f"unknown channel `{scalar.text}`", scalar.span, "not a field or property",
            helps=[*helps, f"if its pack may be absent, write `{word}?`"],
        )  # fmt: skip
    return [MatrixChannel(word)]
