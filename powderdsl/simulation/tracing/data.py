"""A trace as plain data for JSON. `SCHEMA` increases when a key changes its meaning or is removed."""

from __future__ import annotations

from typing import Any

from powderdsl.diagnostics import Span
from powderdsl.model.text import one_line
from powderdsl.model.types import Ruleset
from powderdsl.simulation.provenance import NumberedRule
from powderdsl.simulation.tracing.trace import Cause, Miss, Part, Trace, plain

SCHEMA = 1


def trace_data(trace: Trace) -> dict[str, Any]:
    """Rows and columns count from 0, steps, lines, columns of text, rules and substeps from 1."""
    return {
        "schema": SCHEMA,
        "ruleset": trace.ruleset.name,
        "world": trace.world,
        "cell": trace.cell,
        "step": trace.step,
        "slots": {
            slot.name: {
                "before": plain(trace.ruleset, slot.kind, trace.before[slot.name]),
                "after": plain(trace.ruleset, slot.kind, trace.after[slot.name]),
                "writer": _rule_data(trace.writer(slot.name)),
            }
            for slot in trace.slots
            if slot.name in trace.after
        },
        "writes": [_cause_data(trace.ruleset, one) for one in trace.causes],
        "almost": [_miss_data(one) for one in trace.misses],
    }


def _cause_data(ruleset: Ruleset, cause: Cause) -> dict[str, Any]:
    write = cause.write
    return {
        "slot": write.slot.name,
        "before": plain(ruleset, write.slot.kind, write.before),
        "after": plain(ruleset, write.slot.kind, write.after),
        "how": write.how,
        "rule": _rule_data(write.rule),
        "cell": write.cell,
        "source": write.source,
        "parts": [_part_data(part) for part in cause.parts],
    }


def _miss_data(miss: Miss) -> dict[str, Any]:
    return {
        "rule": _rule_data(miss.rule),
        "cell": miss.cell,
        "failed": [_part_data(part) for part in miss.failed],
        "held": [_part_data(part) for part in miss.parts if part.holds],
        "gave_way": miss.policy if not miss.failed else None,
    }


def _rule_data(rule: NumberedRule | None) -> dict[str, Any] | None:
    if rule is None:
        return None
    return {
        "number": rule.number,
        "pack": rule.pack,
        "pass": rule.pass_name,
        "moment": rule.moment + 1,
        "label": rule.label,
        "text": one_line(rule.span),
        **_place(rule.span),
    }


def _part_data(part: Part) -> dict[str, Any]:
    return {
        "text": part.text,
        "holds": part.holds,
        "let": part.of or None,
        **_place(part.span),
        "reads": [
            {name: value for name, value in vars(read).items() if name != "shown"} for read in part.reads
        ],
    }


def _place(span: Span | None) -> dict[str, Any]:
    if span is None:
        return {"file": None, "line": None, "column": None}
    return {"file": span.source.name, "line": span.line, "column": span.column}
