"""The order of the matrix's channels, which further packs do not disturb.

First comes what a ruleset's own packs hold, as its `matrix:` says, with one channel for each of its ids; without a
ruleset the first pack stands in its place. Then, for each further pack in load order: its elements, the properties that
its rules are the first to assign, and its fields. So channels stay where they are when packs are added.
"""

from __future__ import annotations

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.composition.compose import Composition
from powderdsl.model.types import MatrixChannel, Pass, substeps, writes_of
from powderdsl.syntax.yaml_tree import Scalar

COMPONENTS = ("row", "column")

Channels = dict[str, list[MatrixChannel]]
"""By the name of a property or field."""


def lay_out(
    composition: Composition, passes: tuple[Pass, ...], reporter: Reporter
) -> tuple[tuple[str, ...], tuple[MatrixChannel, ...]]:
    """The names of all that a cell holds besides its element, in order, and the channels of `World.matrix()`.

    Reports names in a ruleset's `matrix:` that no loaded pack has.
    """
    fields, names, size = composition.fields, composition.names_by_id, composition.own_slots
    known: Channels = {name: [MatrixChannel(name, name)] for name in (*composition.properties, *fields)}
    for name, field in fields.items():
        if field.kind.name == "vec2":
            known[name] = [MatrixChannel(f"{name}.{part}", name, part=part) for part in COMPONENTS]
    blocks = _blocks(composition, passes)
    parts: list[list[MatrixChannel]] = [[] for _ in range(2 * len(blocks))]
    """The channels of elements and those of what lasts from step to step, in turn, by group of packs."""
    for number in sorted({*range(size), *names}):
        group = composition.group[composition.elements[names[number]].pack] if number >= size else 0
        parts[2 * group].append(MatrixChannel(names.get(number, ""), id=number))
    for group, block in enumerate(blocks):
        for name in block:
            if name not in fields or not fields[name].resets:
                parts[2 * group + 1] += known[name]
    written = composition.ruleset.placing.matrix
    if written:
        own = [_named_channels(scalar, known, composition, reporter) for scalar in written]
        shown = [parts[0] if channels is None else channels for channels in own]
        # A ruleset that shows no elements shows none of further packs either.
        parts = [*shown, *parts[2:]] if None in own else shown
    order = tuple(name for block in blocks for name in block)
    return order, tuple(channel for part in parts for channel in part)


def _blocks(composition: Composition, passes: tuple[Pass, ...]) -> list[list[str]]:
    """Stored properties and fields, by group of packs."""
    place = composition.group
    blocks: list[list[str]] = [[] for _ in range(max(place.values()) + 1)]
    first: dict[str, int] = {}
    for pass_, moment in substeps(passes):
        for rule in moment.rules:
            for write in writes_of(rule):
                first[write.field] = min(place[pass_.pack], first.get(write.field, place[pass_.pack]))
    for name, prop in composition.properties.items():
        if prop.stored:
            blocks[max(first.get(name, 0), place[prop.pack])].append(name)
    for name, field in composition.fields.items():
        blocks[place[field.pack]].append(name)
    return blocks


def _named_channels(
    scalar: Scalar, known: Channels, composition: Composition, reporter: Reporter
) -> list[MatrixChannel] | None:
    """The channels that a name under `matrix:` stands for: of a field, a property or a component, plain or qualified.

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
