"""What `powderdsl test` prints: the results of tests and invariants, and the rules that never happened."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import click

from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import counted
from powderdsl.model.text import one_line, place_of
from powderdsl.model.types import Ruleset
from powderdsl.testing.pack_tests.runner import ExampleResult, run_examples
from powderdsl.testing.properties.blame import difference_of_test
from powderdsl.testing.properties.breaks import breaks
from powderdsl.testing.properties.outcomes import (
    Result,
    counterexample_lines,
    difference_lines,
    file_of,
    kept_examples,
    picture,
    read_example,
    result_data,
    result_line,
    write_example,
)
from powderdsl.testing.properties.running import Runner
from powderdsl.testing.properties.search import InvariantSearch, SearchPlan, counterexample


@dataclass
class TestingReport:
    """One call of the command: what was asked for, and what came of it so far.

    `keep`: whether counterexamples are kept; None: the usual. `picture`: where the first counterexample is drawn.
    """

    backend: str | None
    plan: SearchPlan
    keep: bool | None
    picture: Path | None
    as_json: bool
    failed: bool = False
    data: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.keep is None:
            self.keep = not os.environ.get("CI")  # a machine that runs tests and is thrown away

    def say(self, *lines: str) -> None:
        if not self.as_json:
            click.echo("".join(f"{line}\n" for line in lines), nl=False)

    def test(self, name: str, ruleset: Ruleset) -> None:
        """Tests, invariants, coverage of one ruleset."""
        start = monotonic()
        runner = Runner(ruleset, self.backend)
        tests = run_examples(ruleset, sim=runner.sim, seen=lambda world: runner.note(world.state))
        for test in tests:
            outcome = "ok  " if test.passed else "FAIL" if test.failed else "differs"
            self.say(f"{outcome}  {test.example.pack}: {test.example.name}")
            if not test.passed:
                found = difference_of_test(test, runner)
                words = [found.with_packs, *difference_lines(found)] if found else []
                self.say(*(f"      {line}".rstrip() for line in [*words, *_failure_lines(test)]))
        results = self._properties(name, runner)
        missed = [span for span in runner.lines if span not in runner.happened]
        for span in missed:
            self.say(f"never happened: {place_of(span)}: {one_line(span)}")
        self.say(
            f"{ruleset.name}: {len(runner.lines) - len(missed)} of {counted(len(runner.lines), 'rule')} happened"
            f" on {runner.worlds_run:,} worlds in {monotonic() - start:.0f} s"
        )
        broken = sum(not result.holds for result in results)
        failed = sum(test.failed for test in tests)
        changed = sum(bool(test.added) for test in tests)
        changed += sum(result.status == "differs" for result in results)
        declared = [result for result in results if result.prop.owner != "automatic"]
        parts = [counted(len(tests), "test")]
        parts += [counted(len(declared), "invariant")] if declared else []
        bad = [f"{number} {word}" for number, word in ((failed, "failed"), (broken, "broken")) if number]
        come = "comes" if changed == 1 else "come"
        differ = [f"{changed} {come} out differently with added packs"] if changed else []
        self.say(f"{ruleset.name}: {', '.join([*parts, *(bad + differ or ['all passed'])])}")
        self.failed |= bool(bad)
        self.data[name] = _data(tests, results, runner.lines, missed)

    def _properties(self, name: str, runner: Runner) -> list[Result]:
        search = InvariantSearch.of(runner, self.plan)
        properties = {trial.prop.text: trial.prop for trial in search.waiting}
        if self.keep:
            for prop, sample, steps in kept_examples(runner.ruleset, properties, name):
                search.try_sample(sample, steps)
                self.say(f"tried again: {prop.owner}: {prop.text}")
        search.try_random()
        results = search.finish()
        for result in results:
            self._tell(result, runner.ruleset)
            if result.counterexample is not None and not result.holds and self.keep:
                path = file_of(name, result.prop)
                write_example(path, name, result.prop, result.counterexample)
                self.say(f"      again: powderdsl test {name} --replay {path}")
        return results

    def _tell(self, result: Result, ruleset: Ruleset) -> None:
        if result.prop.owner == "automatic" and result.holds:
            return
        self.say(result_line(result))
        found = result.counterexample
        if result.difference is not None:
            self.say(*(f"      {line}" for line in difference_lines(result.difference)))
        if found is not None:
            self.say(*(f"      {line}" for line in counterexample_lines(found, ruleset)))
            if self.picture is not None:
                from powderdsl.simulation.media import write_png  # brings Pillow

                write_png(self.picture, picture(found, ruleset))
                self.say(f"      drawn: {self.picture}")
                self.picture = None

    def replay(self, name: str, ruleset: Ruleset, path: Path) -> None:
        """Try one counterexample again, as it is."""
        text, sample, steps = read_example(path, ruleset)
        runner = Runner(ruleset, self.backend)
        search = InvariantSearch.of(runner, self.plan)
        prop = next((trial.prop for trial in search.trials if trial.prop.text == text), None)
        if prop is None:
            raise BadInput(f"{path}: {ruleset.name} has no invariant `{text}`")
        result = Result(prop, "tested", 1, "")
        if breaks(prop.claim, runner, sample, steps).first.any():
            example = counterexample(prop.claim, runner, sample, steps)
            (result,) = search.told_apart([Result(prop, "broken", 1, "", example)])
        self._tell(result, ruleset)
        self.failed |= not result.holds
        self.data[name] = {"properties": [result_data(result)]}


def _data(
    tests: Sequence[ExampleResult], results: Sequence[Result], lines: Sequence[Any], missed: Sequence[Any]
) -> dict[str, Any]:
    return {
        "tests": [
            {
                "test": one.example.name,
                "pack": one.example.pack,
                "place": place_of(one.example.span),
                "passed": one.passed,
                "added": list(one.added),
                "problem": one.problem,
                "seed": one.seed,
                "steps": one.step,
            }
            for one in tests
        ],
        "properties": [result_data(result) for result in results],
        "rules": {"all": len(lines), "never": [place_of(span) for span in missed]},
    }


def _failure_lines(result: ExampleResult) -> Iterator[str]:
    """What is wrong, and the worlds side by side."""
    example = result.example
    steps = f"{result.step} step{'' if result.step == 1 else 's'}"
    yield f"{place_of(example.span)}: {result.problem} (seed {result.seed}, after {steps})"
    columns = [("given", example.given), ("expected", example.expect or ()), ("found", result.after)]
    drawn = [[title, *(" ".join(row) for row in rows)] for title, rows in columns if rows]
    if result.field_after:
        drawn.append([f"{result.field} found", *result.field_after])
    width = max(len(line) for lines in drawn for line in lines) + 3
    for lines in zip(*drawn, strict=True):
        yield "".join(line.ljust(width) for line in lines)
