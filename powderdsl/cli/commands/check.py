"""`powderdsl check`: every mistake in rule files, and every invariant that is easily broken."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import click

from powderdsl.analysis.account import ledger_data, ledger_text
from powderdsl.analysis.ledger import Ledger
from powderdsl.analysis.ledger import ledger as make_ledger
from powderdsl.cli import options as opt
from powderdsl.cli.exits import BAD_INPUT, FAILED, OK
from powderdsl.cli.output import counted, print_json, write_diagnostics
from powderdsl.compiler import load_with_diagnostics, lower
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.diagnostics.render import diagnostic_data, render_json, render_short
from powderdsl.model.types import Ruleset
from powderdsl.system.reports import table
from powderdsl.tasks.shipped import is_task

if TYPE_CHECKING:
    from powderdsl.ir.cost import PassCost
    from powderdsl.tasks.task import Task


ALWAYS_TOLD = ("PD515", "PD518")
"""Notes that are always printed, a line each below the summary: effects of added packs, undecided invariants."""


@dataclass(frozen=True)
class Checked:
    """What was found in one RULES. `loaded` is None if there are errors; `cost` and `ledger` are what was asked for."""

    name: str
    diagnostics: tuple[Diagnostic, ...]
    loaded: Ruleset | Task | None = None
    cost: tuple[PassCost, ...] | None = None
    ledger: Ledger | None = None

    def number(self, severity: Severity) -> int:
        """How many diagnostics have this severity."""
        return sum(one.severity is severity for one in self.diagnostics)


@click.command("check")
@click.argument("rules", nargs=-1, required=True, metavar="RULES...")
@opt.layouts("One JSON list instead of text.", ("short", "One line for each mistake, without carets."))
@opt.flag("--notes", "Also list notes, such as inactive rules.")
@opt.flag("--warnings-as-errors", "Exit with 1 if there are warnings.")
@opt.flag("--quick", "Check only the rules themselves; do not try invariants.")
@opt.flag("--cost", "Also report what each pass costs; in JSON as a second key.")
@opt.flag("--ledger", "Also report what rules create, destroy and move; in JSON as a key.")
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
    checked = [_check(name, quick, cost, ledger) for name in rules]
    found: dict[Diagnostic, None] = {}
    lines: list[str] = []
    for one in checked:
        shown = [each for each in one.diagnostics if notes or each.severity is not Severity.NOTE]
        differences = [each for each in one.diagnostics if each.code in ALWAYS_TOLD and not notes]
        found |= dict.fromkeys(shown if layout == "text" else [*shown, *differences])
        lines.append(_summary(one, notes))
        if layout == "text":
            lines += [f"  {each.message}" for each in differences]
        if one.cost is not None:
            lines += ["", *_cost_lines(one.cost)]
        if one.ledger is not None:
            lines += ["", ledger_text(one.ledger)]
    if layout == "json" and (cost or ledger):
        data: dict[str, Any] = {"diagnostics": [*map(diagnostic_data, found)]}
        if cost:
            data["cost"] = {one.name: [*map(asdict, one.cost)] for one in checked if one.cost is not None}
        if ledger:
            data["ledger"] = {one.name: ledger_data(one.ledger) for one in checked if one.ledger}
        print_json(data)
    elif layout == "json":
        click.echo(render_json(found))
    elif layout == "short":
        click.echo("".join(f"{render_short(one)}\n" for one in found) + "\n".join(lines))
    else:
        if found:
            write_diagnostics(found, sys.stdout)
            click.echo()
        click.echo("\n".join(lines))
    if any(one.number(Severity.ERROR) for one in checked):
        return BAD_INPUT
    warned = any(one.number(Severity.WARNING) for one in checked)
    return FAILED if warned and warnings_as_errors else OK


def _check(name: str, quick: bool, cost: bool, ledger: bool) -> Checked:
    try:
        if is_task(name):
            from powderdsl.tasks.shipped import load_task_with_diagnostics  # brings numpy

            task, remarks = load_task_with_diagnostics(name)
            return Checked(name, remarks, task)
        ruleset, remarks = load_with_diagnostics(name)
    except CompileError as error:
        return Checked(name, error.diagnostics)
    book = None
    if ruleset.invariants and not quick:
        from powderdsl.testing.properties.refute import refuted  # brings numpy

        book = make_ledger(ruleset)
        remarks = (*remarks, *refuted(ruleset, book))
    expenses = None
    if cost:
        from powderdsl.ir.cost import costs

        expenses = costs(lower(ruleset))
    return Checked(name, remarks, ruleset, expenses, (book or make_ledger(ruleset)) if ledger else None)


def _cost_lines(passes: tuple[PassCost, ...]) -> Iterator[str]:
    """A table, a line for each pass that planes do not carry, and what the numbers are."""
    numbers = ("moments", "gates", "shifts", "moves", "random bits", "reals", "neighbors")
    rows = [["pass", "form", "share (%)", *numbers]]
    for one in passes:
        values = (str(getattr(one, name.replace(" ", "_"))) for name in numbers)
        rows.append([one.name, one.form, f"{100 * one.share:.0f}", *values])
    yield from table(rows)
    for one in passes:
        if one.form == "cells":
            yield f"{one.name}: {one.dense:,} operations on cells, not on planes: {one.why} ({one.place})"
    yield "For every cell and step, if nothing is skipped. Shares are estimates."


def _summary(one: Checked, notes: bool) -> str:
    """`name: 14 elements, 12 passes, no errors`, and how many warnings and notes there are."""
    parts = [counted(one.number(Severity.ERROR), "error")]
    if isinstance(one.loaded, Ruleset):
        passes = len(one.loaded.passes)
        passes_text = "1 pass" if passes == 1 else f"{passes or 'no'} passes"
        parts = [counted(len(one.loaded.elements), "element"), passes_text, *parts]
    elif one.loaded is not None:
        parts = [counted(len(one.loaded.splits), "split"), *parts]
    if warnings := one.number(Severity.WARNING):
        parts.append(counted(warnings, "warning"))
    if number := one.number(Severity.NOTE):
        parts.append(counted(number, "note") + ("" if notes else " (--notes shows them)"))
    return f"{one.loaded.name if one.loaded else one.name}: {', '.join(parts)}"
