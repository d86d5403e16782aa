"""What a random ruleset exercises of the model, of the IR, and of bit planes: all that targets see of the language."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from powderdsl.compiler import lower
from powderdsl.ir.bits import segments
from powderdsl.ir.ops import OPS as IR_OPS
from powderdsl.ir.ops import Node, Program, nodes_of
from powderdsl.model.builtins import KIND_WORDS
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.types import Assign, Expr, Ruleset

Used = frozenset[tuple[str, str]]
"""Rows of the table: (group, name)."""

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
    return {
        "rules": frozenset(
            ["Transform", "Swap", "Move", "Assign", "prove", "drop_both", "first_wins", "overwrite", ":=", "+=", "-="]
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
    """Every node of a program, guards of substeps included."""
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


def constructs(ruleset: Ruleset) -> Iterator[tuple[str, str]]:
    """What a checked model has."""
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
    for substep in (substep for pass_ in ruleset.passes for substep in pass_.substeps):
        yield "rules", substep.policy
        for rule in substep.rules:
            yield "rules", type(rule).__name__
            for update in (rule,) if isinstance(rule, Assign) else rule.effects:
                yield "rules", update.op


def expressions(ruleset: Ruleset) -> Iterator[Expr]:
    """Every expression of a ruleset and every part of it."""
    for pass_ in ruleset.passes:
        for substep in pass_.substeps:
            tops = [let.value for let in substep.lets]
            for rule in substep.rules:
                updates = (rule,) if isinstance(rule, Assign) else rule.effects
                parts = (rule.mask, getattr(rule, "target", None), getattr(rule, "leaving", None))
                tops += [part for part in (*parts, *(update.value for update in updates)) if part is not None]
            for top in tops:
                yield from top.walk()
