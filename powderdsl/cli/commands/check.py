"""`powderdsl check`: report every mistake in rule files and every easily broken invariant."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BAD_INPUT, FAILED, OK
from powderdsl.cli.output import counted, print_json, write_diagnostics
from powderdsl.compiler import load_with_diagnostics, lower
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.diagnostics.diagnostic import diagnostic_data
from powderdsl.model.types import Ruleset
from powderdsl.syntax.sources import OPEN, shipped
from powderdsl.system.cache import persistent
from powderdsl.system.reports import table
from powderdsl.system.writing import write_text
from powderdsl.tasks.shipped import is_task

if TYPE_CHECKING:
    from powderdsl.analysis.costs import PassCost
    from powderdsl.analysis.ledger import Ledger
    from powderdsl.tasks.task import Task


ALWAYS_SHOWN = ("PD515", "PD518")
"""Codes of notes that are always printed, one line each: effects of added packs, undecided invariants."""


@dataclass(frozen=True)
class Checked:
    """The result for one RULES. `loaded` is None if there are errors; `cost` and `ledger` only if they were requested."""

    name: str
    diagnostics: tuple[Diagnostic, ...]
    loaded: Ruleset | Task | None = None
    cost: tuple[PassCost, ...] | None = None
    ledger: Ledger | None = None
    claims: tuple[dict[str, Any], ...] = ()
    """The verdicts on invariants as JSON, and the line that shows each."""

    def number(self, severity: Severity) -> int:
        return sum(diagnostic.severity is severity for diagnostic in self.diagnostics)


@click.command("check")
@click.argument("rules", nargs=-1, required=True, metavar="RULES...")
@opt.option("--json", bool, "One JSON list instead of text.", to="as_json")
@opt.option("--fix", bool, "Fix misspelled words if that reduces the number of errors.")
@opt.option("--notes", bool, "Also list notes, such as inactive rules.")
@opt.option("--warnings-as-errors", bool, "Exit with 1 if there are warnings.")
@opt.option("--quick", bool, "Check only the rules, not invariants.")
@opt.proof
@opt.option("--claims", bool, "Also list each invariant: proven, refuted or tested; in JSON as a key.")
@opt.option("--cost", bool, "Also report the cost of each pass; in JSON as a key.")
@opt.option("--ledger", bool, "Also report what rules create, destroy and move; in JSON as a key.")
def command(
    rules: tuple[str, ...],
    as_json: bool,
    fix: bool,
    notes: bool,
    warnings_as_errors: bool,
    quick: bool,
    prove: int,
    claims: bool,
    cost: bool,
    ledger: bool,
) -> int:
    """Find all mistakes in rule files and tasks, and invariants that do not hold.

    Invariants are proven if possible, and otherwise tried on a few small worlds.

    Each RULES is checked separately; join packs that belong together by `+`: core+my/pack.yaml. A task is the name of a
    shipped one, or a file that begins with `task:`.

    Exit code: 0 without errors, 1 for warnings with --warnings-as-errors, 2 for errors.
    """
    checks = [partial(_check, name, None if quick else prove, cost, ledger) for name in rules]
    results = [check() for check in checks]
    for number, check in enumerate(checks) if fix else ():
        while better := _corrected(results[number], check, as_json):
            results[number] = better
    # Compositions share packs: a dictionary has each diagnostic once.
    shown = dict.fromkeys(
        diagnostic
        for result in results
        for diagnostic in result.diagnostics
        if notes or diagnostic.severity is not Severity.NOTE or (as_json and diagnostic.code in ALWAYS_SHOWN)
    )
    if as_json:
        data: Any = [diagnostic_data(diagnostic) for diagnostic in shown]
        if cost or ledger or claims:
            data = {"diagnostics": data}
        if claims:
            data["claims"] = {result.name: result.claims for result in results}
        if cost:
            data["cost"] = {result.name: result.cost for result in results if result.cost is not None}
        if ledger:
            from powderdsl.analysis.ledger import ledger_data

            data["ledger"] = {result.name: ledger_data(result.ledger) for result in results if result.ledger}
        print_json(data)
    elif shown:
        write_diagnostics(shown, sys.stdout)
        click.echo()
    if not as_json:
        click.echo("\n".join(line for result in results for line in _lines(result, notes, claims)))
    if any(result.number(Severity.ERROR) for result in results):
        return BAD_INPUT
    warned = any(result.number(Severity.WARNING) for result in results)
    return FAILED if warned and warnings_as_errors else OK


def _lines(result: Checked, notes: bool, claims: bool) -> Iterator[str]:
    """The summary of one RULES, its invariants, its cost and its ledger."""
    yield _summary(result, notes)
    for diagnostic in () if notes else result.diagnostics:
        if diagnostic.code in ALWAYS_SHOWN:
            yield f"  {diagnostic.message}"
    if claims and result.claims:
        yield from ("", *(claim["line"] for claim in result.claims))
    if result.cost is not None:
        yield from ("", *_cost_lines(result.cost))
    if result.ledger is not None:
        from powderdsl.analysis.ledger import ledger_text

        yield from ("", ledger_text(result.ledger))


def _check(name: str, prove: int | None, cost: bool, ledger: bool) -> Checked:
    try:
        if is_task(name):
            from powderdsl.tasks.file import task_under
            from powderdsl.tasks.shipped import load_task_with_diagnostics  # brings numpy

            task, diagnostics = load_task_with_diagnostics(name)
            for split in task.splits:  # those in between are of the same kind
                for rules in dict.fromkeys(split.rulesets[:1] + split.rulesets[-1:]):
                    task_under(task, rules)
            return Checked(name, diagnostics, task)
        ruleset, diagnostics = load_with_diagnostics(name)
    except CompileError as error:
        return Checked(name, error.diagnostics)
    claims: tuple[dict[str, Any], ...] = ()
    if ruleset.invariants and prove is not None:
        title, key = f"invariants of {ruleset.name}", f"{prove} {ruleset.text_key}"
        broken, claims = persistent(title, key, lambda: _judged(ruleset, prove))
        diagnostics = (*diagnostics, *broken)
    expenses = balance = None
    if cost:
        from powderdsl.analysis.costs import costs

        expenses = costs(lower(ruleset))
    if ledger:
        from powderdsl.analysis.ledger import ledger as ledger_of

        balance = ledger_of(ruleset)
    return Checked(name, diagnostics, ruleset, expenses, balance, claims)


def _corrected(result: Checked, check: Callable[[], Checked], quiet: bool) -> Checked | None:
    """Fix misspelled words. Return the new result, or None (and leave the files unchanged) without fewer errors."""
    wrong = [diagnostic for diagnostic in result.diagnostics if diagnostic.fix]
    keys = [diagnostic for diagnostic in wrong if diagnostic.code == "PD108"]  # names depend on keys
    fixes = dict(diagnostic.fix for diagnostic in keys or wrong if diagnostic.fix)
    ours = shipped("rules").parent.resolve()
    texts: dict[Path, str] = {}
    for span in sorted(fixes, key=lambda span: -span.start):
        path = Path(span.source.name).resolve()
        if ours not in path.parents:
            text = texts.get(path, span.source.text)
            texts[path] = text[: span.start] + fixes[span] + text[span.end :]
    OPEN.update(texts)
    better = check() if texts else result
    OPEN.clear()
    if better.number(Severity.ERROR) >= result.number(Severity.ERROR):
        return None
    for path, text in texts.items():
        write_text(path, text)
    for span, word in fixes.items() if not quiet else ():
        if Path(span.source.name).resolve() in texts:
            click.echo(f"fixed {span.place}: `{span.text}` is now `{word}`")
    return better


def _judged(ruleset: Ruleset, prove: int) -> tuple[tuple[Diagnostic, ...], tuple[dict[str, Any], ...]]:
    """Diagnostics about invariants, and the verdict on each."""
    from powderdsl.testing.properties.outcomes import result_data, result_line
    from powderdsl.testing.properties.search import quick_results, refuted  # brings numpy

    results = quick_results(ruleset, prove)
    claims = tuple({**result_data(result), "line": result_line(result)} for result in results)
    return refuted(ruleset, results), claims


def _cost_lines(passes: tuple[PassCost, ...]) -> Iterator[str]:
    """A table, a line for each pass that does not run on bit planes, and an explanation of the numbers."""
    numbers = ("substeps", "gates", "shifts", "moves", "random bits", "float operations", "neighbors")
    rows = [["pass", "form", "share (%)", *numbers]]
    for cost in passes:
        values = (str(getattr(cost, name.replace(" ", "_"))) for name in numbers)
        rows.append([cost.name, cost.form, f"{100 * cost.share:.0f}", *values])
    yield from table(rows)
    for cost in passes:
        if cost.form == "cells":
            yield f"{cost.name}: {cost.dense:,} operations on cells, not on planes: {cost.why} ({cost.place})"
    yield "Per cell and step, if no pass is skipped. Shares are estimates."


def _summary(result: Checked, notes: bool) -> str:
    """`name: 14 elements, 12 passes, no errors`, and the numbers of warnings and notes."""
    loaded, parts = result.loaded, []
    if isinstance(loaded, Ruleset):
        parts += [counted(len(loaded.elements), "element"), counted(len(loaded.passes), "pass", "passes")]
    elif loaded is not None:
        parts.append(counted(len(loaded.splits), "split"))
        if held_out := [split.name for split in loaded.splits if loaded.is_held_out(split)]:
            parts.append(f"laws of {', '.join(held_out)} held out of train")
    if result.claims:
        verdicts = Counter(claim["status"] for claim in result.claims)
        numbers = ", ".join(f"{number} {status}" for status, number in verdicts.items())
        all_proven = verdicts["proven"] == len(result.claims)
        parts.append(
            f"{counted(len(result.claims), 'invariant')} ({'all proven' if all_proven else numbers})"
        )
    parts.append(counted(result.number(Severity.ERROR), "error"))
    if warnings := result.number(Severity.WARNING):
        parts.append(counted(warnings, "warning"))
    if number := result.number(Severity.NOTE):
        parts.append(counted(number, "note") + ("" if notes else " (--notes shows them)"))
    return f"{loaded.name if loaded else result.name}: {', '.join(parts)}"
