"""`powderdsl test`: the tests that stand in packs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from powderdsl.cli.exits import FAILED, OK, counted
from powderdsl.cli.options import backend_option, load_rules, rules_argument, set_option
from powderdsl.model.text import place_of

if TYPE_CHECKING:
    from powderdsl.pack_tests import ExampleResult


@click.command("test")
@rules_argument
@backend_option("reference")
@set_option
def command(rules: str, backend: str, settings: dict[str, str]) -> int:
    """Run the tests that stand in packs.

    A test without a seed runs with five. Exit code: 0 if all pass, 1 if one fails, 2 for bad rules.
    """
    ruleset = load_rules(rules, settings)
    if not ruleset.tests:
        click.echo(f"{ruleset.name}: no tests")
        return OK
    from powderdsl.pack_tests import run_examples

    results = run_examples(ruleset, backend=backend)
    for result in results:
        click.echo(f"{'ok  ' if result.passed else 'FAIL'}  {result.example.pack}: {result.example.name}")
        if not result.passed:
            click.echo("\n".join(f"      {line}".rstrip() for line in _failure_lines(result)))
    failed = sum(not result.passed for result in results)
    outcome = f"{failed} failed" if failed else "all passed"
    click.echo(f"{ruleset.name}: {counted(len(results), 'test')}, {outcome}")
    return FAILED if failed else OK


def _failure_lines(result: ExampleResult) -> Iterator[str]:
    """What is wrong, and the worlds side by side."""
    example = result.example
    steps = f"{result.step} step{'' if result.step == 1 else 's'}"
    yield f"{place_of(example.span)}: {result.problem} (seed {result.seed}, after {steps})"
    columns = [("given", example.given), ("expected", example.expect or ()), ("found", result.after)]
    drawn = [[title, *(" ".join(row) for row in rows)] for title, rows in columns if rows]
    width = max(len(line) for lines in drawn for line in lines) + 3
    for lines in zip(*drawn, strict=True):
        yield "".join(line.ljust(width) for line in lines)
