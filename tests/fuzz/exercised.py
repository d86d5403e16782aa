"""What a random ruleset exercises: constructs of the language, operations of the model, of the IR, of bit planes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from powderdsl.compiler import lower
from powderdsl.diagnostics import Reporter, Source
from powderdsl.ir.ops import OPS as IR_OPS
from powderdsl.ir.ops import Node, Program, nodes_of
from powderdsl.ir.segments import segments
from powderdsl.model.builtins import COORDINATES, DIRECTION_SETS, DIRECTIONS, KERNELS, KIND_WORDS
from powderdsl.model.operations import FUNCTIONS, OPERATIONS
from powderdsl.model.schema import RECORDS, keys_of
from powderdsl.model.types import Assign, Expr, Ruleset
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_text, parser
from powderdsl.syntax.yaml_tree import Mapping, Scalar, Sequence, parse_yaml
from powderdsl.syntax.yaml_tree import Node as Tree

Used = frozenset[tuple[str, str]]
"""Rows of the table: (group, name)."""

SECTIONS = {
    "properties": "property",
    "fields": "field",
    "streams": "stream",
    "params": "param",
    "kernels": "kernel",
    "elements": "element",
}
"""Sections of a pack whose entries have keys of their own."""

NOT_RUN = {
    "pack": {
        "about",
        "needs",
        "provides",
        "conflicts",
        "also",
        "tests",
        "invariants",
        "side_multiple",
    },  # how packs meet is decided before the IR
    "element": {"glyph", "about", "override", "color_by"},
    **{context: {"about"} for context in ("property", "stream", "param")},
    "field": {"about", "tint"},
    "pass": {"about", "override"},
}
"""Keys that say nothing about what a step does."""

OF_INVARIANTS = frozenset(
    {"never", "trend", "stays", "reach", "agree", "total", "without", "duration", "word"}
)
"""Syntax that only invariants have: they say nothing about what a step does either."""

ON_CELLS = ("passes", "on cells")
"""Noted for a ruleset with passes that planes cannot carry."""

ON_NUMBERS = frozenset({"below", "in_set", "table", "count", "mod", "quotient", "to_real"})
"""IR operations that take or make whole numbers only: none is left on bit planes."""

KINDS = ("flag", "int", "element", "direction", "real", "vec2")
KINDS_OF = {
    **dict.fromkeys(("look", "choose", "field", "let"), KINDS),
    "const": ("flag", "int", "element", "real"),
    "sum": ("int", "real", "vec2"),
    "add": ("int", "real", "vec2", "draw"),
}
"""Operations of the model that every backend does in another way for another kind."""

NOT_IN_THE_MODEL = frozenset({"at", "clamp", "counterclockwise", "pick"})
"""Functions that the checker writes out in terms of others."""

FOR_PLANES = frozenset({"chance", "below_planes"})
"""IR operations that only the lowering to bit planes makes."""

OF_SCHEDULES = frozenset({"load"})
"""IR operations that only the planner makes, after all lowering: no pass has them before."""


def expected() -> dict[str, frozenset[str]]:
    """Everything that random rulesets should exercise, by group. Derived from the compiler's own tables."""
    keys = {
        f"{context}.{key}"
        for context in ("pack", *SECTIONS.values(), "pass", "block")
        for key in keys_of(RECORDS[context]).keys() - NOT_RUN.get(context, set())
    }
    keys |= {
        f"{context}.{prefix.strip()}"
        for context, kind in RECORDS.items()
        if context in ("pass", "block")
        for prefix in kind.PREFIXES
    }
    return {
        "keys": frozenset(keys),
        "syntax": frozenset(
            str(rule.alias or rule.origin.name)
            for rule in parser().rules
            if (rule.alias or not rule.options.expand1) and not str(rule.origin.name).startswith("_")
        )
        - OF_INVARIANTS,
        "words": frozenset([*DIRECTIONS, *DIRECTION_SETS, *KERNELS, *FUNCTIONS, *COORDINATES]),
        "rules": frozenset(
            ["Transform", "Swap", "Move", "Assign", "prove", "drop_both", "first_wins", "overwrite", ":=", "+=", "-=", "mirror", "rotations", "all"]
        ),
        "fields and properties": frozenset(
            [f"field {kind}" for kind in ("int", *KIND_WORDS) if kind != "chance"]
            + [f"property {kind}" for kind in ("int", "flag", "chance")]
            + [f"param {kind}" for kind in ("int", "flag", "chance", "real")]
        ),
        "model": frozenset(OPERATIONS) - NOT_IN_THE_MODEL | {f"{op} {kind}" for op, kinds in KINDS_OF.items() for kind in kinds},
        "IR": frozenset(IR_OPS) - FOR_PLANES - OF_SCHEDULES,
        "bit planes": frozenset(IR_OPS) - ON_NUMBERS - OF_SCHEDULES,
    }  # fmt: skip


def constructs(text: str, ruleset: Ruleset) -> Used:
    """What the text of a pack uses of the language, and its checked model of the model."""
    root = parse_yaml(Source("text", text), Reporter())
    assert isinstance(root, Mapping)
    found: set[tuple[str, str]] = set()
    for key, value in root.entries:
        found.add(("keys", f"pack.{key.text}"))
        if isinstance(value, Mapping) and key.text in SECTIONS:
            context = SECTIONS[key.text]
            found |= {
                ("keys", f"{context}.{inner.text}")
                for _, entry in value.entries
                if isinstance(entry, Mapping)
                for inner, _ in entry.entries
                if inner.text in keys_of(RECORDS[context])
            }
        if key.text == "passes" and isinstance(value, Mapping):
            for _, entry in value.entries:
                found |= set(_of_block(entry, "pass"))
        if key.text == "sets" and isinstance(value, Mapping):
            for _, entry in value.entries:
                found |= set(_of_line(entry, ("expression",)))
    return frozenset(found | set(_of_model(ruleset)))


def operations(ruleset: Ruleset) -> Used:
    """The operations that the program of a ruleset has, on numbers and on bit planes; and passes that stay on cells."""
    program = lower(ruleset)
    found = {("IR", node.op) for node in program_nodes(program)}
    for segment in segments(program):
        if segment.planes is None:
            found.add(ON_CELLS)
        else:
            found |= {("bit planes", node.op) for node in program_nodes(segment.planes)}
    return frozenset(found)


def program_nodes(program: Program) -> Iterator[Node]:
    """Every node of a program, guards of moments included."""
    for pass_ in program.passes:
        yield from nodes_of(pass_)


def missing(used: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """What was expected and not exercised, by group."""
    seen = set(used)
    gaps = {
        group: sorted(name for name in names if (group, name) not in seen)
        for group, names in expected().items()
    }
    return {group: names for group, names in gaps.items() if names}


def coverage_table(counts: Counter[tuple[str, str]]) -> list[tuple[str, str, str, str]]:
    """Rows for people: group, how much of it was exercised, the rarest with the rulesets that had them, what is missing."""
    rows = []
    for group, names in expected().items():
        seen = sorted((counts[group, name], name) for name in names if counts[group, name])
        rarest = ", ".join(f"{name} {count}" for count, name in seen[:4])
        lacking = ", ".join(sorted(names - {name for _, name in seen}))
        rows.append((group, f"{len(seen)} of {len(names)}", rarest, lacking or "nothing"))
    return rows


def _of_block(node: Tree, context: str) -> Iterator[tuple[str, str]]:
    """Keys and lines of a pass or block, and of the blocks in it."""
    if isinstance(node, Scalar):
        yield from _of_line(node, ("rule", "expression"))
    elif isinstance(node, Sequence):
        for item in node.items:
            yield from _of_block(item, "block")
    else:
        for key, value in node.entries:
            prefix = next((p for p in RECORDS[context].PREFIXES if key.text.startswith(p)), None)
            yield "keys", f"{context}.{prefix.strip() if prefix else key.text}"
            if prefix:
                yield from _of_line(key, ("header",))
            if prefix or key.text in ("do", "then"):
                yield from _of_block(value, "block")
            elif key.text == "let" and isinstance(value, Mapping):
                for _, line in value.entries:
                    yield from _of_line(line, ("expression",))
            elif key.text == "symmetry" and isinstance(value, Scalar):
                yield "rules", value.text


def _of_line(node: Tree, starts: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Kinds of syntax in a line, and the words of the language in it."""
    if not isinstance(node, Scalar):
        return
    span = node.content
    for start in starts:
        syntax = parse_text(span, start, Reporter())
        if syntax is not None:
            yield from _of_syntax(syntax)
            return


def _of_syntax(syntax: Syntax) -> Iterator[tuple[str, str]]:
    yield "syntax", syntax.kind
    for word in syntax.text.split():
        yield "words", word
    for child in syntax.children:
        yield from _of_syntax(child)


def _of_model(ruleset: Ruleset) -> Iterator[tuple[str, str]]:
    for name, table in (
        ("field", ruleset.fields),
        ("property", ruleset.properties),
        ("param", ruleset.params),
    ):
        for item in table:
            yield "fields and properties", f"{name} {item.kind.name}"
    for expr in expressions(ruleset):
        yield "model", expr.op
        yield "model", f"{expr.op} {expr.kind.name}"
    for moment in (moment for pass_ in ruleset.passes for moment in pass_.moments):
        yield "rules", moment.policy
        for rule in moment.rules:
            yield "rules", type(rule).__name__
            for update in (rule,) if isinstance(rule, Assign) else rule.effects:
                yield "rules", update.op


def expressions(ruleset: Ruleset) -> Iterator[Expr]:
    """Every expression of a ruleset and every part of it."""
    for pass_ in ruleset.passes:
        for moment in pass_.moments:
            tops = [let.value for let in moment.lets]
            for rule in moment.rules:
                updates = (rule,) if isinstance(rule, Assign) else rule.effects
                parts = (rule.mask, getattr(rule, "target", None), getattr(rule, "leaving", None))
                tops += [part for part in (*parts, *(update.value for update in updates)) if part is not None]
            for top in tops:
                yield from top.walk()
