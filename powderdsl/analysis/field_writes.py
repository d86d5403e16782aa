"""The lines that write each field, and the bounds of its values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from powderdsl.analysis.changes import Found, RuleLine
from powderdsl.model.text import element_name, show_value
from powderdsl.model.types import Assign, Kind, Ruleset

Bounds = tuple[float, float]


@dataclass(frozen=True)
class FieldEntry:
    """A field, a scratch field of a pass, or a property that cells may override.

    `bounds` are the declared ones, for numbers: every write is cut off at them. `fresh_bounds` are kept by a world in
    which they hold once, such as one whose field was never set by hand. `travels`: with the element, else it stays
    with the place.
    """

    name: str
    kind: str
    default: str
    travels: bool
    bounds: Bounds | None
    fresh_bounds: Bounds | None
    writers: tuple[RuleLine, ...]
    reaches: tuple[tuple[RuleLine, float | None, float | None], ...]
    """For each line that writes an integer: how low and how high it can bring it. None: it never lowers or raises."""


def find_fields(ruleset: Ruleset, found: Iterable[Found]) -> tuple[FieldEntry, ...]:
    """All of them: fields in load order, scratch fields by pass, then properties."""
    writes: dict[str, list[tuple[RuleLine, Assign]]] = {}
    for one in found:
        for assign in one.writes:
            writes.setdefault(assign.field, []).append((one.line, assign))
    entries = []
    for item in (*ruleset.fields, *(item for pass_ in ruleset.passes for item in pass_.scratch)):
        default = show_value(ruleset, item.kind, item.default)
        for identity, value in item.own:
            default += f", {element_name(ruleset, identity)} as {show_value(ruleset, item.kind, value)}"
        bounds = (min(item.defaults), max(item.defaults)) if item.kind.name == "int" else None
        entries.append((item.name, item.kind, default, item.at == "element", bounds))
    params = {param.name: param.kind for param in ruleset.params}
    for prop in ruleset.properties:
        if prop.stored:
            kinds = [params[v] if isinstance(v, str) else Kind("int", v, v) for v in prop.values]  # type: ignore[arg-type]  # only numbers are left
            hull = (min(kind.lo for kind in kinds), max(kind.hi for kind in kinds))
            bounds = hull if prop.kind.name == "int" else None
            entries.append((prop.name, prop.kind, "its element has it", True, bounds))
    return tuple(_entry(*entry, writes.get(entry[0], [])) for entry in entries)


def _entry(
    name: str,
    kind: Kind,
    default: str,
    travels: bool,
    fresh: Bounds | None,
    writes: list[tuple[RuleLine, Assign]],
) -> FieldEntry:
    declared = (kind.lo, kind.hi) if kind.name in ("int", "real", "vec2") else None
    reaches: dict[RuleLine, list[tuple[float | None, float | None]]] = {}
    for line, assign in writes if kind.name == "int" else ():
        reaches.setdefault(line, []).append(reach(assign, (kind.lo, kind.hi)))
    lines = tuple((line, *_hull(parts)) for line, parts in reaches.items())
    if fresh is not None:
        low, high = _hull([fresh, *(parts[1:] for parts in lines)])
        assert low is not None
        assert high is not None
        fresh = (low, high)
    writers = tuple(dict.fromkeys(line for line, _ in writes))
    return FieldEntry(name, str(kind), default, travels, declared, fresh, writers, lines)


def reach(assign: Assign, declared: Bounds) -> tuple[float | None, float | None]:
    """How low and how high an assignment may bring an integer; None where it never lowers or never raises it."""
    low, high = assign.value.kind.lo, assign.value.kind.hi
    if assign.op == ":=":
        return min(max(low, declared[0]), declared[1]), min(max(high, declared[0]), declared[1])
    if assign.op == "-=":
        low, high = -high, -low
    return (declared[0] if low < 0 else None), (declared[1] if high > 0 else None)


def _hull(parts: Sequence[tuple[float | None, float | None]]) -> tuple[float | None, float | None]:
    lows = [low for low, _ in parts if low is not None]
    highs = [high for _, high in parts if high is not None]
    return min(lows, default=None), max(highs, default=None)
