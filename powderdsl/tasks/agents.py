"""The `agent:` of a task file: the actions it may take, where, and how often."""

from __future__ import annotations

import re

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.schema import Reader
from powderdsl.model.state import slot_name
from powderdsl.model.types import Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.tasks.drawings import choice_ids
from powderdsl.tasks.task import BLOW, NO_CHANGE, Agent
from powderdsl.worlds.raster import Size
from powderdsl.worlds.scene.read import two_integers
from powderdsl.worlds.scene.statements import read_choice, text_span

Entries = dict[str, tuple[yaml_tree.Scalar, yaml_tree.Node]]

MAX_ACTIONS = 1_000_000
MAX_STEPS = 100_000
ACTS = {"blow": BLOW, "nothing": NO_CHANGE}
"""Words of `may:` that are not elements."""


def read_agent(
    reader: Reader, entry: tuple[yaml_tree.Scalar, yaml_tree.Node] | None, ruleset: Ruleset, size: Size
) -> Agent | None:
    """The agent; None if it is missing or empty, which is reported."""
    if entry is None:
        return None
    entries = reader.mapping(entry[1], "agent", "an agent")
    if not entries:
        return None
    choices = _choices(reader, entries, ruleset)
    speed = _read_speed(reader, entries)
    field = _speed_field(reader, entries, ruleset, BLOW in choices, entry[0].span)
    if BLOW in choices and "speed" not in entries:
        message, helps = "an agent that may blow lacks `speed`", ["`speed: 20` is the paper's"]
        reader.reporter.error("PD109", message, entry[0].span, "how fast?", helps=helps)
    brush, bins = _pair(reader, entries, "brush", 10, size), _pair(reader, entries, "bins", 16, size)
    actions = reader.number(entries, "actions", 1, MAX_ACTIONS)
    steps = reader.number(entries, "steps_per_action", 0, MAX_STEPS)
    free = reader.number(entries, "free_steps", 0, MAX_STEPS)
    return Agent(
        choices,
        brush,
        bins,
        actions or 1,
        1 if steps is None else steps,
        free or 0,
        field,
        speed or 0.0,
    )


def _choices(reader: Reader, entries: Entries, ruleset: Ruleset) -> tuple[int, ...]:
    """Element ids, ascending, then BLOW and NO_CHANGE."""
    found: set[int] = set()
    acts: set[int] = set()
    words = reader.words(entries["may"][1]) if "may" in entries else ()
    for word in words:
        if word.text in ACTS:
            acts.add(ACTS[word.text])
            continue
        span = text_span(word, reader.reporter)
        choice = read_choice(span, reader.reporter) if span else None
        if choice is not None:
            found |= set(choice_ids(choice, ruleset, reader.reporter, {}))
    if "may" in entries and not words:
        label = "nothing is allowed"
        reader.reporter.error("PD804", "an agent that may do nothing", entries["may"][0].span, label)
    return (*sorted(found), *sorted(acts, reverse=True))


def _read_speed(reader: Reader, entries: Entries) -> float | None:
    value = reader.scalar(entries, "speed")
    if value is None:
        return None
    if not re.fullmatch(r"-?[0-9]{1,7}(\.[0-9]{1,6})?", value.text) or float(value.text) == 0:
        reader.reporter.error("PD110", "`speed` must be a number other than 0", value.span, "such as `20`")
        return None
    return float(value.text)


def _speed_field(
    reader: Reader,
    entries: Entries,
    ruleset: Ruleset,
    blows: bool,
    span: Span,
) -> str | None:
    """The vector that blowing sets: the one named, or the only one there is."""
    vectors = [one.name for one in ruleset.fields if one.kind.name == "vec2" and not one.resets]
    named = reader.scalar(entries, "speed_field")
    if named is not None and slot_name(ruleset, named.text) not in vectors:
        helps = suggest(named.text, vectors, "vectors of these rules")
        message = f"`{named.text}` is not a vector field"
        reader.reporter.error("PD804", message, named.span, "blowing sets a vector", helps=helps)
        return None
    if not blows:
        return None
    if named is not None:
        return slot_name(ruleset, named.text)
    if not vectors:
        message, helps = (
            "these rules have no field that blowing could set",
            ("load a pack with a vector field",),
        )
        reader.reporter.error("PD804", message, span, "no vector", helps=helps)
    elif len(vectors) > 1:
        message, helps = "blowing could set several fields", (f"`speed_field`: one of {', '.join(vectors)}",)
        reader.reporter.error("PD804", message, span, "which one?", helps=helps)
    return vectors[0] if len(vectors) == 1 else None


def _pair(
    reader: Reader,
    entries: Entries,
    key: str,
    usual: int,
    size: Size,
) -> Size:
    """Rows and columns: one number for both, or a list of two."""
    if key not in entries:
        return min(usual, size[0]), min(usual, size[1])
    node = entries[key][1]
    pair = two_integers(
        yaml_tree.Sequence((node, node), node.span) if isinstance(node, yaml_tree.Scalar) else node
    )
    if pair is None or not all(1 <= one <= most for one, most in zip(pair, size, strict=True)):
        label = f"one number, or [rows, columns], from 1 to {size[0]} and {size[1]}"
        reader.reporter.error("PD804", f"`{key}` does not fit the world", node.span, label)
        return min(usual, size[0]), min(usual, size[1])
    return pair
