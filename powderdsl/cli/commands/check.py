"""`powderdsl check`: every mistake in rule files, and every invariant that is easily broken."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from powderdsl.analysis.ledger.account import ledger_data, ledger_text
from powderdsl.analysis.ledger.book import Ledger
from powderdsl.analysis.ledger.book import ledger as make_ledger
from powderdsl.cli.exits import BAD_INPUT, FAILED, OK, counted, write_diagnostics
from powderdsl.cli.options import layout_options
from powderdsl.cli.plain_table import table
from powderdsl.compiler import load_with_diagnostics, lower
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.diagnostics.render import diagnostic_data, render_json, render_short
from powderdsl.model.types import Ruleset
from powderdsl.tasks.names import is_task

if TYPE_CHECKING:
    from powderdsl.ir.cost import PassCost
    from powderdsl.tasks.task import Task


ALWAYS_TOLD = ("PD515", "PD518")
"""Notes below the summary without `--notes` too, in a line each: what added packs change, what was not decided."""


@click.command("check")
@click.argument("rules", nargs=-1, required=True, metavar="RULES...")
@layout_options("One JSON list instead of text.", ("short", "One line for each mistake, without carets."))
@click.option("--notes", is_flag=True, help="Also list notes, such as inactive rules.")
@click.option("--warnings-as-errors", is_flag=True, help="Exit with 1 if there are warnings.")
@click.option("--quick", is_flag=True, help="Do not try invariants: only what the rules themselves say.")
@click.option("--cost", is_flag=True, help="Also say what each pass costs; in JSON as a second key.")
@click.option(
    "--ledger", is_flag=True, help="Also say what rules create, destroy and move; in JSON as a key."
)
def command(
    rules: tuple[str, ...],
    layout: str,
    notes: bool,
    warnings_as_errors: bool,
    quick: bool,
    cost: bool,
    ledger: bool,
) -> int:
    """Find the mistakes in rule files and tasks, all at once, and invariants that do not hold.

    Each RULES is checked by itself; packs that belong together are joined by `+`: core+my/pack.yaml. A task is
    a shipped one by name, or a file that begins with `task:`.

    Exit code: 0 without errors, 1 with warnings under --warnings-as-errors, 2 with errors.
    """
    found: dict[Diagnostic, None] = {}
    lines = []
    expenses: dict[str, tuple[PassCost, ...]] = {}
    ledgers: dict[str, Ledger] = {}
    errors = warnings = 0
    for name in rules:
        found_task = _check_task(name) if is_task(name) else None
        ruleset, diagnostics, book = (
            _check(name, quick) if found_task is None else (None, found_task[1], None)
        )
        counts = Counter(one.severity for one in diagnostics)
        errors += counts[Severity.ERROR]
        warnings += counts[Severity.WARNING]
        shown = [one for one in diagnostics if notes or one.severity is not Severity.NOTE]
        differences = [one for one in diagnostics if one.code in ALWAYS_TOLD and not notes]
        found |= dict.fromkeys(shown if layout == "text" else [*shown, *differences])
        if found_task is not None:
            lines.append(_task_summary(name, found_task[0], counts))
            continue
        lines.append(_summary(name, ruleset, counts, notes))
        if layout == "text":
            lines += [f"  {one.message}" for one in differences]
        if cost and ruleset is not None:
            expenses[name] = _costs(ruleset)
            lines += ["", *_cost_lines(expenses[name])]
        if ledger and ruleset is not None:
            ledgers[name] = book or make_ledger(ruleset)
            lines += ["", ledger_text(ledgers[name])]
    if layout == "json" and (cost or ledger):
        data: dict[str, Any] = {"diagnostics": [*map(diagnostic_data, found)]}
        if cost:
            data["cost"] = {name: [asdict(one) for one in passes] for name, passes in expenses.items()}
        if ledger:
            data["ledger"] = {name: ledger_data(one) for name, one in ledgers.items()}
        click.echo(json.dumps(data, indent=2, ensure_ascii=False))
    elif layout == "json":
        click.echo(render_json(found))
    elif layout == "short":
        click.echo("".join(f"{render_short(one)}\n" for one in found) + "\n".join(lines))
    else:
        if found:
            write_diagnostics(found, sys.stdout)
            click.echo()
        click.echo("\n".join(lines))
    if errors:
        return BAD_INPUT
    return FAILED if warnings and warnings_as_errors else OK


def _check(name: str, quick: bool) -> tuple[Ruleset | None, tuple[Diagnostic, ...], Ledger | None]:
    """The rules if they can be loaded, all that is wrong with them, and their ledger if their invariants needed it."""
    try:
        ruleset, remarks = load_with_diagnostics(name)
    except CompileError as error:
        return None, error.diagnostics, None
    if quick or not ruleset.invariants:
        return ruleset, remarks, None
    from powderdsl.testing.properties.refute import refuted  # brings numpy

    book = make_ledger(ruleset)
    return ruleset, (*remarks, *refuted(ruleset, book)), book


def _check_task(name: str) -> tuple[Task | None, tuple[Diagnostic, ...]]:
    from powderdsl.tasks.shipped import load_task_with_diagnostics  # brings numpy

    try:
        return load_task_with_diagnostics(name)
    except CompileError as error:
        return None, error.diagnostics


def _task_summary(name: str, task: Task | None, counts: Counter[Severity]) -> str:
    """`name: 3 splits, no errors`."""
    parts = [counted(counts[Severity.ERROR], "error")]
    if task is not None:
        parts = [counted(len(task.splits), "split"), *parts]
    if counts[Severity.WARNING]:
        parts.append(counted(counts[Severity.WARNING], "warning"))
    return f"{task.name if task else name}: {', '.join(parts)}"


def _costs(ruleset: Ruleset) -> tuple[PassCost, ...]:
    from powderdsl.ir.cost import costs

    return costs(lower(ruleset))


def _cost_lines(passes: tuple[PassCost, ...]) -> Iterator[str]:
    """A table, a line for each pass that planes do not carry, and what the numbers are."""
    heading = [
        "pass",
        "form",
        "share (%)",
        "moments",
        "gates",
        "shifts",
        "moves",
        "random bits",
        "reals",
        "neighbors",
    ]
    rows = [heading]
    for one in passes:
        numbers = (one.moments, one.gates, one.shifts, one.moves, one.random_bits, one.reals, one.neighbors)
        rows.append([one.name, one.form, f"{100 * one.share:.0f}", *map(str, numbers)])
    yield from table(rows)
    for one in passes:
        if one.form == "cells":
            yield f"{one.name}: {one.dense:,} operations on cells, not on planes: {one.why} ({one.place})"
    yield "For every cell and step, if nothing is skipped. Shares are estimates."


def _summary(name: str, ruleset: Ruleset | None, counts: Counter[Severity], notes: bool) -> str:
    """`name: 14 elements, 12 passes, no errors`, and what else there is."""
    parts = [f"{counted(counts[Severity.ERROR], 'error')}"]
    if ruleset is not None:
        parts = [counted(len(ruleset.elements), "element"), _passes(len(ruleset.passes)), *parts]
    if counts[Severity.WARNING]:
        parts.append(counted(counts[Severity.WARNING], "warning"))
    if counts[Severity.NOTE]:
        parts.append(counted(counts[Severity.NOTE], "note") + ("" if notes else " (--notes shows them)"))
    return f"{ruleset.name if ruleset else name}: {', '.join(parts)}"


def _passes(number: int) -> str:
    return "1 pass" if number == 1 else f"{number or 'no'} passes"
