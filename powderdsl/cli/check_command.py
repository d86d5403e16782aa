"""`powderdsl check`: every mistake in rule files, without running anything."""

from __future__ import annotations

import sys
from collections import Counter

import click

from powderdsl.cli.exits import BAD_INPUT, FAILED, OK, counted, write_diagnostics
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.diagnostics.render import render_json, render_short
from powderdsl.model.types import Ruleset


@click.command("check")
@click.argument("rules", nargs=-1, required=True, metavar="RULES...")
@click.option(
    "--format",
    "layout",
    type=click.Choice(("text", "short", "json")),
    default="text",
    show_default=True,
    help="Full text with carets, one line each, or one JSON list.",
)
@click.option("--notes", is_flag=True, help="Also list what is worth knowing, such as rules that are asleep.")
@click.option("--warnings-as-errors", is_flag=True, help="Exit with 1 if there are warnings.")
def command(rules: tuple[str, ...], layout: str, notes: bool, warnings_as_errors: bool) -> int:
    """Find the mistakes in rule files, all at once.

    Each RULES is checked by itself; packs that belong together are joined by `+`: core+my/pack.yaml.

    Exit code: 0 without errors, 1 with warnings under --warnings-as-errors, 2 with errors.
    """
    found: dict[Diagnostic, None] = {}
    lines = []
    errors = warnings = 0
    for name in rules:
        ruleset, diagnostics = _check(name)
        counts = Counter(one.severity for one in diagnostics)
        errors += counts[Severity.ERROR]
        warnings += counts[Severity.WARNING]
        found |= dict.fromkeys(one for one in diagnostics if notes or one.severity is not Severity.NOTE)
        lines.append(_summary(name, ruleset, counts, notes))
    if layout == "json":
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


def _check(name: str) -> tuple[Ruleset | None, tuple[Diagnostic, ...]]:
    try:
        return load_with_diagnostics(name)
    except CompileError as error:
        return None, error.diagnostics


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
