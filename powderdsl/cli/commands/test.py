"""`powderdsl test`: the tests and the invariants of packs, and which rules never happened meanwhile."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.exits import FAILED, OK, BadInput, counted
from powderdsl.cli.options import Integer, backend_option, check_writable, load_rules, set_option
from powderdsl.compiler import shipped_tests
from powderdsl.model.text import one_line, place_of

if TYPE_CHECKING:
    from powderdsl.model.types import Ruleset
    from powderdsl.testing.pack_tests.runner import ExampleResult
    from powderdsl.testing.properties.outcomes import Result
    from powderdsl.testing.properties.search import SearchPlan

MAX_SECONDS = 24 * 3600


@click.command("test")
@click.argument("rules", nargs=-1, metavar="[RULES]...")
@backend_option("arrays")
@set_option
@click.option("--examples", type=Integer(0, 10_000_000), default=1000,
              help="Random worlds that each invariant is tried on.")  # fmt: skip
@click.option("--drawn", type=Integer(0, 1_000_000), default=100,
              help="More worlds, drawn by Hypothesis.")  # fmt: skip
@click.option("--seconds", type=Integer(1, MAX_SECONDS), default=60,
              help="Time limit for random worlds, per RULES, in seconds.")  # fmt: skip
@click.option("--seed", type=Integer(0, 2**31 - 1), default=0,
              help="Other worlds for another seed, the same for the same.")  # fmt: skip
@click.option(
    "--replay", type=click.Path(dir_okay=False, path_type=Path), help="Only try this counterexample again."
)
@click.option("--picture", type=click.Path(dir_okay=False, path_type=Path),
              help="Draw the first counterexample, before and after, as a .png.")  # fmt: skip
@click.option(
    "--keep/--no-keep",
    default=None,
    help="Keep counterexamples in .powderdsl/.  [default: unless $CI is set]",
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of text.")
@click.option(
    "--mutate", is_flag=True, help="Put mistakes into the packs, and list those that nothing notices."
)
@click.option("--pack", "packs", multiple=True, metavar="PACK",
              help="With --mutate: only mistakes in this pack. May be repeated.")  # fmt: skip
@click.option("--mutants", type=Integer(1, 1_000_000), metavar="N",
              help="With --mutate: maximum number of mutants, of each kind in proportion.")  # fmt: skip
@click.option("--write", is_flag=True, help="With --mutate: add a test for each of them to its pack.")
@click.option("--jobs", type=Integer(1, 256), metavar="N",
              help="With --mutate: processes.  [default: one a processor]")  # fmt: skip
def command(
    rules: tuple[str, ...],
    backend: str,
    settings: dict[str, str],
    examples: int,
    drawn: int,
    seconds: int,
    seed: int,
    replay: Path | None,
    picture: Path | None,
    keep: bool | None,
    as_json: bool,
    mutate: bool,
    packs: tuple[str, ...],
    mutants: int | None,
    write: bool,
    jobs: int | None,
) -> int:
    """Run the tests of packs, and hold their invariants against the rules.

    Without RULES, all that come with powderdsl. A test without a seed runs with five. Invariants are proven where that
    is possible, else tried on random worlds; one that breaks is shown by a small world, kept in .powderdsl/, and tried
    first from then on.

    Exit code: 0 if all holds, 1 if something fails, 2 for bad rules.
    """
    only_mutate = {"--pack": packs, "--mutants": mutants, "--write": write, "--jobs": jobs}
    never_mutate = {"--set": settings, "--replay": replay, "--picture": picture}
    for option, value in (never_mutate if mutate else only_mutate).items():
        if value:
            raise BadInput(f"{option} goes {'without' if mutate else 'with'} --mutate")
    if mutate:
        from powderdsl.cli.mutation_report import MutationPlan, report_mutants

        chosen = MutationPlan(packs, mutants, seed, jobs, write, as_json)
        return report_mutants(rules or tuple(shipped_tests()), chosen)
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise BadInput(f"--picture must end in .png, not `{picture}`")
        check_writable(picture)
    if replay is not None and len(rules) != 1:
        raise BadInput("--replay takes the one RULES that the counterexample breaks")
    from powderdsl.testing.properties.keep import is_kept
    from powderdsl.testing.properties.search import SearchPlan

    plan = SearchPlan(examples, float(seconds), seed)
    session = _Session(backend, plan, drawn, is_kept() if keep is None else keep, picture, as_json)
    for name in rules or shipped_tests():
        ruleset = load_rules(name, settings)
        if replay is not None:
            session.replay(name, ruleset, replay)
        else:
            session.test(name, ruleset)
    if as_json:
        click.echo(json.dumps(session.data, indent=2, ensure_ascii=False))
    return FAILED if session.failed else OK


class _Session:
    """One call of the command: what is asked, and what came of it so far."""

    def __init__(
        self, backend: str, plan: SearchPlan, drawn: int, keep: bool, picture: Path | None, as_json: bool
    ):
        self.backend, self.plan, self.drawn, self.keep = backend, plan, drawn, keep
        self.picture, self.as_json = picture, as_json
        self.failed = False
        self.data: dict[str, Any] = {}

    def say(self, *lines: str) -> None:
        if not self.as_json:
            click.echo("".join(f"{line}\n" for line in lines), nl=False)

    def test(self, name: str, ruleset: Ruleset) -> None:
        """Tests, invariants, coverage of one ruleset."""
        from powderdsl.testing.pack_tests.runner import run_examples
        from powderdsl.testing.properties.differences import difference_of_test
        from powderdsl.testing.properties.outcomes import difference_lines
        from powderdsl.testing.properties.running import Runner

        start = monotonic()
        runner = Runner(ruleset, self.backend)
        tests = run_examples(ruleset, sim=runner.sim, seen=lambda world: runner.note(world.state))
        for test in tests:
            self.say(f"{_word(test)}  {test.example.pack}: {test.example.name}")
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
        told = [f"{changed} come out differently with added packs"] if changed > 1 else []
        told = ["1 comes out differently with added packs"] if changed == 1 else told
        self.say(
            f"{ruleset.name}: {', '.join([*parts, *(bad or told or ['all passed']), *(told if bad else [])])}"
        )
        self.failed |= bool(bad)
        self.data[name] = _data(tests, results, runner.lines, missed)

    def _properties(self, name: str, runner: Any) -> list[Result]:
        from powderdsl.testing.properties.drawn import has_hypothesis, try_drawn
        from powderdsl.testing.properties.keep import file_of, kept_examples, write_example
        from powderdsl.testing.properties.search import InvariantSearch

        search = InvariantSearch.of(runner, self.plan)
        properties = {trial.prop.text: trial.prop for trial in search.trials}
        if self.keep:
            for prop, sample, steps in kept_examples(runner.ruleset, properties, name):
                search.try_sample(sample, steps)
                self.say(f"tried again: {prop.owner}: {prop.text}")
        search.try_random()
        if has_hypothesis():
            try_drawn(search, self.drawn)
        else:
            self.say("Hypothesis is not installed: only random worlds were tried")
        results = search.finish()
        for result in results:
            self._tell(result, runner.ruleset)
            if result.counterexample is not None and not result.holds and self.keep:
                path = file_of(name, result.prop)
                write_example(path, name, result.prop, result.counterexample)
                self.say(f"      again: powderdsl test {name} --replay {path}")
        return results

    def _tell(self, result: Result, ruleset: Ruleset) -> None:
        from powderdsl.testing.properties.outcomes import (
            counterexample_lines,
            difference_lines,
            picture,
            result_line,
        )

        if result.prop.owner == "automatic" and result.holds:
            return
        self.say(result_line(result))
        found = result.counterexample
        if result.difference is not None:
            self.say(*(f"      {line}" for line in difference_lines(result.difference)))
        if found is not None:
            self.say(*(f"      {line}" for line in counterexample_lines(found, ruleset)))
            if self.picture is not None:
                from powderdsl.simulation.media import write_png

                write_png(self.picture, picture(found, ruleset))
                self.say(f"      drawn: {self.picture}")
                self.picture = None

    def replay(self, name: str, ruleset: Ruleset, path: Path) -> None:
        """Try one counterexample again, as it is."""
        from powderdsl.testing.properties.breaks import breaks
        from powderdsl.testing.properties.keep import read_example
        from powderdsl.testing.properties.outcomes import Result, result_data
        from powderdsl.testing.properties.running import Runner
        from powderdsl.testing.properties.search import as_it_is, find_property, told_apart

        text, sample, steps = read_example(path, ruleset)
        prop = find_property(ruleset, text)
        if prop is None:
            raise BadInput(f"{path}: {ruleset.name} has no invariant `{text}`")
        runner = Runner(ruleset, self.backend)
        broken = bool(breaks(prop.claim, runner, sample, steps).first.any())
        found = as_it_is(prop.claim, runner, sample, steps) if broken else None
        result = Result(prop, "broken" if broken else "tested", 1, "", found)
        if broken:
            (result,) = told_apart([result], runner, self.plan)
        self._tell(result, ruleset)
        self.failed |= not result.holds
        self.data[name] = {"properties": [result_data(result)]}


def _data(
    tests: Sequence[ExampleResult], results: Sequence[Result], lines: Sequence[Any], missed: Sequence[Any]
) -> dict[str, Any]:
    from powderdsl.testing.properties.outcomes import result_data

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


def _word(result: ExampleResult) -> str:
    return "ok  " if result.passed else "FAIL" if result.failed else "differs"


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
