"""`powderdsl test`: run the tests of packs, check their invariants, and list rules that never fired."""

from __future__ import annotations

import os
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, print_json, progress
from powderdsl.compiler import shipped_tests
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
    side_by_side,
    write_example,
)
from powderdsl.testing.properties.running import Runner
from powderdsl.testing.properties.search import InvariantSearch, SearchPlan, counterexample

if TYPE_CHECKING:
    from powderdsl.testing.mutation.judging import GeneratedTest, Verdict
    from powderdsl.testing.mutation.operators import Mutant

MAX_SECONDS = 24 * 3600


@click.command("test", cls=opt.Command)
@click.argument("rules", nargs=-1, metavar="[RULES]...")
@opt.backend(None, "Backend that runs the rules.  [default: wasm]")
@opt.parameters
@opt.option("--examples", (0, 10_000_000), "Number of random worlds on which to try each invariant.", 1000)
@opt.option("--seconds", (1, MAX_SECONDS), "Time limit for random worlds, per RULES, in seconds.", 60)
@opt.option("--seed", (0, 2**31 - 1), "Seed of the random worlds.", 0)
@opt.proof
@opt.path("--replay", "FILE", "Only replay this counterexample.")
@opt.output("--picture", "FILE", "Draw the first counterexample, before and after, to a .png file.", ".png")
@click.option(
    "--keep/--no-keep",
    default=None,
    help="Keep counterexamples in .powderdsl/.  [default: unless $CI is set]",
)
@opt.option("--json", bool, "Print one JSON object instead of text.", to="as_json")
@opt.option("--mutate", bool, "Insert mistakes into the packs and list those that no test detects.")
@opt.pack_list("--packs", "With --mutate: mutate only these packs.")
@opt.option(
    "--mutants", (1, 1_000_000), "With --mutate: maximum number of mutants, in proportion for each kind."
)
@opt.option("--write", bool, "With --mutate: add tests that detect them to the packs.")
@opt.option("--jobs", (1, 256), "With --mutate: number of processes.  [default: one per processor]")
def command(
    rules: tuple[str, ...],
    backend: str | None,
    settings: dict[str, str],
    examples: int,
    seconds: int,
    seed: int,
    prove: int,
    replay: Path | None,
    picture: Path | None,
    keep: bool | None,
    as_json: bool,
    mutate: bool,
    **mutation: Any,
) -> int:
    """Run the tests of packs and check their invariants.

    Without RULES, test all shipped rules. A test without a seed runs with five seeds. Invariants are proven if
    possible, and otherwise tried on random worlds. A small world that breaks one is printed, stored in .powderdsl/, and
    tried first in later runs.

    Exit code: 0 if everything passes, 1 if something fails, 2 for bad rules.
    """
    for name, value in ({"replay": replay, "picture": picture} if mutate else mutation).items():
        if value:
            raise BadInput(f"--{name} {'cannot be used with' if mutate else 'requires'} --mutate")
    if mutate:
        return _mutate(rules or shipped_tests(), as_json, settings=settings, seed=seed, **mutation)
    if replay is not None and len(rules) != 1:
        raise BadInput("--replay needs exactly one RULES argument: the rules of the counterexample")
    if keep is None:
        keep = not os.environ.get("CI")  # a disposable CI machine
    session = _Report(backend, SearchPlan(examples, float(seconds), seed, prove), keep, picture, as_json)
    for name in rules or shipped_tests():
        ruleset = opt.load_rules(name, settings)
        if replay is not None:
            session.replay(name, ruleset, replay)
        else:
            session.test(name, ruleset)
    if as_json:
        print_json(session.data)
    return FAILED if session.failed else OK


# Tests and invariants


@dataclass
class _Report:
    """One call of the command: its options and its results so far.

    `keep`: store counterexamples. `picture`: where to draw the first one. `own`: the files that RULES name, if each
    part names one or some are paths, else all; of other files, only failures are shown.
    """

    backend: str | None
    plan: SearchPlan
    keep: bool
    picture: Path | None
    as_json: bool
    failed: bool = False
    own: Collection[str] = ()
    data: dict[str, Any] = field(default_factory=dict)

    def say(self, *lines: str) -> None:
        if not self.as_json:
            click.echo("".join(f"{line}\n" for line in lines), nl=False)

    def test(self, name: str, ruleset: Ruleset) -> None:
        start = monotonic()
        runner = Runner(ruleset, self.backend)
        tests = run_examples(ruleset, sim=runner.sim, seen=lambda world: runner.note(world.state))
        parts = name.split("+")
        files = {span.source.name for span in (*runner.lines, *(test.span for test in ruleset.tests))}
        named = {file for file in files if file in parts or Path(file).stem in parts}
        self.own = named & {*parts} or (named if len(named) == len(parts) else files)
        mine = [test for test in tests if test.example.span.source.name in self.own]
        for test in (*mine, *(test for test in tests if not (test.passed or test in mine))):
            outcome = "ok  " if test.passed else "FAIL" if test.failed else "differs"
            self.say(f"{outcome}  {test.example.pack}: {test.example.name}")
            if not test.passed:
                difference = difference_of_test(test, runner)
                words = [difference.with_packs, *difference_lines(difference)] if difference else []
                self.say(*(f"      {line}".rstrip() for line in [*words, *_failure_lines(test)]))
        if passed := sum(test.passed for test in tests if test not in mine):
            self.say(f"ok    other packs: {counted(passed, 'test')}")
        results = self._properties(name, runner)
        lines = [span for span in runner.lines if span.source.name in self.own]
        missed = [span for span in lines if span not in runner.happened]
        for span in missed:
            self.say(f"never fired: {place_of(span)}: {one_line(span)}")
        title = ruleset.name if self.own == files else ", ".join(sorted(self.own))
        self.say(
            f"{title}: {len(lines) - len(missed)} of {counted(len(lines), 'rule')} fired"
            f" in {runner.worlds_run:,} worlds in {monotonic() - start:.0f} s"
        )
        declared = [result for result in results if result.prop.owner != "automatic"]
        totals = [counted(len(tests), "test")]
        totals += [counted(len(declared), "invariant")] if declared else []
        counts = {
            "failed": sum(test.failed for test in tests),
            "broken": sum(not result.holds for result in results),
            "different with added packs": sum(bool(test.added) for test in tests)
            + sum(result.status == "differs" for result in results),
        }
        faults = [f"{number} {word}" for word, number in counts.items() if number]
        self.say(f"{ruleset.name}: {', '.join([*totals, *(faults or ['all passed'])])}")
        self.failed |= bool(counts["failed"] or counts["broken"])
        self.data[name] = _data(tests, results, lines, missed)

    def _properties(self, name: str, runner: Runner) -> list[Result]:
        search = InvariantSearch.of(runner, self.plan)
        properties = {trial.prop.text: trial.prop for trial in search.undecided}
        if self.keep:
            for prop, sample, steps in kept_examples(runner.ruleset, properties, name):
                search.try_sample(sample, steps)
                self.say(f"tried again: {prop.owner}: {prop.text}")
        search.try_random()
        results = search.finish()
        for result in results:
            span = result.prop.span
            if span is None or span.source.name in self.own or not result.holds or result.difference:
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
        counterexample = result.counterexample
        if result.difference is not None:
            self.say(*(f"      {line}" for line in difference_lines(result.difference)))
        if counterexample is not None:
            self.say(*(f"      {line}" for line in counterexample_lines(counterexample, ruleset)))
            if self.picture is not None:
                from powderdsl.worlds.media import write_png  # brings Pillow

                write_png(self.picture, picture(counterexample, ruleset))
                self.say(f"      drawn: {self.picture}")
                self.picture = None

    def replay(self, name: str, ruleset: Ruleset, path: Path) -> None:
        """Replay one counterexample unmodified."""
        text, sample, steps = read_example(path, ruleset)
        runner = Runner(ruleset, self.backend)
        search = InvariantSearch.of(runner, self.plan)
        result = next((trial for trial in search.trials if trial.prop.text == text), None)
        if result is None:
            raise BadInput(f"{path}: {ruleset.name} has no invariant `{text}`")
        search.trials = [result]
        result.reason, result.proof, result.worlds = "", "", 1
        if breaks(result.prop.claim, runner, sample, steps).first.any():
            result.sample, result.steps = sample, steps
            result.counterexample = counterexample(result.prop.claim, runner, sample, steps)
            search.report_differences()
        self._tell(result, ruleset)
        self.failed |= not result.holds
        self.data[name] = {"properties": [result_data(result)]}


def _data(
    tests: Sequence[ExampleResult], results: Sequence[Result], lines: Sequence[Any], missed: Sequence[Any]
) -> dict[str, Any]:
    return {
        "tests": [
            {
                "test": test.example.name,
                "pack": test.example.pack,
                "place": place_of(test.example.span),
                "passed": test.passed,
                "added": list(test.added),
                "problem": test.problem,
                "seed": test.seed,
                "steps": test.step,
            }
            for test in tests
        ],
        "properties": [result_data(result) for result in results],
        "rules": {"all": len(lines), "never": [place_of(span) for span in missed]},
    }


def _failure_lines(result: ExampleResult) -> Iterator[str]:
    """Describe a failure, with the worlds side by side."""
    example = result.example
    steps = f"{result.step} step{'' if result.step == 1 else 's'}"
    yield f"{place_of(example.span)}: {result.problem} (seed {result.seed}, after {steps})"
    columns = [("given", example.given), ("expected", example.expect or ()), ("found", result.after)]
    drawn = [[title, *(" ".join(row) for row in rows)] for title, rows in columns if rows]
    if result.field_after:
        drawn.append([f"{result.field} found", *result.field_after])
    yield from side_by_side(drawn)


# Mutants


def _mutate(names: Iterable[str], as_json: bool, **how: Any) -> int:
    """Mutate each of some compositions; return exit code 1 if a mutant survives."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread per process; they inherit it
    data = {}
    try:
        for name in names:
            data[name] = _mutated(name, as_json, **how)
    finally:
        if as_json:
            print_json(data)
    return FAILED if any(totals["survived"] for totals in data.values()) else OK


def _mutated(
    name: str,
    as_json: bool,
    packs: tuple[str, ...],
    settings: dict[str, str],
    mutants: int | None,
    seed: int,
    jobs: int | None,
    write: bool,
) -> dict[str, Any]:
    """Mutate some packs of a composition, up to `mutants`, in `jobs` processes; `write` adds tests to their files."""
    from powderdsl.testing.mutation.judging import Original, run_campaign, sampled, tally

    began = monotonic()
    values = tuple(settings.items())
    original = Original.of(name, values)
    loaded = [pack.name.text for pack in original.packs]
    unknown = [word for word in packs if word not in loaded]
    if unknown:
        raise BadInput(f"--packs {unknown[0]}: {name} consists of {', '.join(loaded)}")
    every = original.mutants(frozenset(packs))
    numbers = sampled(every, mutants, seed)
    events = run_campaign(name, packs, numbers, jobs or os.cpu_count() or 1, seed, settings=values)
    verdicts, interrupt = _collect(name, events, len(numbers))
    judged = [(every[number], verdicts[number]) for number in sorted(verdicts)]
    by_pack: dict[str, list[Verdict]] = {}
    for mutant, verdict in judged:
        by_pack.setdefault(mutant.pack, []).append(verdict)
    if not as_json:
        lines = [*_survivors(judged)]
        if interrupt is not None:
            lines.append(f"interrupted after {len(judged)} of {counted(len(numbers), 'mutant')}")
        lines += [f"{title}: {summary(own)}" for title, own in by_pack.items()]
        click.echo(
            "\n".join([*lines, f"{name}: {summary(list(verdicts.values()))} in {monotonic() - began:.0f} s"])
        )
    if write:
        _write(judged)
    if interrupt is not None:
        raise interrupt
    return {
        **tally(verdicts.values()),
        "packs": {pack: tally(own) for pack, own in by_pack.items()},
        "list": [_row(mutant, verdict) for mutant, verdict in judged if verdict.status != "invalid"],
    }


def _collect(
    title: str, events: Generator[tuple[int, Verdict]], total: int
) -> tuple[dict[int, Verdict], KeyboardInterrupt | None]:
    """The verdicts of mutants by number, and the interrupt that ended the campaign early."""
    verdicts: dict[int, Verdict] = {}
    with progress(title, total, lines=True) as show:
        try:
            for number, verdict in events:
                verdicts[number] = verdict
                alive = sum(verdict.status == "survived" for verdict in verdicts.values())
                show(len(verdicts), f"{alive} survived")
        except KeyboardInterrupt as interrupt:
            return verdicts, interrupt
        finally:
            events.close()  # its processes end
    return verdicts, None


def _survivors(judged: Sequence[tuple[Mutant, Verdict]]) -> Iterator[str]:
    """Each mutant that no test detected, with a test that would."""
    for mutant, verdict in judged:
        if verdict.status == "survived":
            yield f"survived  {mutant.place}: {mutant.operator}"
            yield f"      {mutant.diff}"
            if verdict.test is None:
                yield "      no world was found on which it differs"
            else:
                yield from (f"        {line}" for line in verdict.test.text.splitlines())


def _row(mutant: Mutant, verdict: Verdict) -> dict[str, Any]:
    return {
        "place": mutant.place,
        "pack": mutant.pack,
        "operator": mutant.operator,
        "change": mutant.diff,
        **vars(verdict),
        "test": verdict.test and verdict.test.text,
    }


def summary(verdicts: Sequence[Verdict]) -> str:
    """The number of mutants, and what detected them."""
    from powderdsl.testing.mutation.judging import noticed_share, tally

    counts = tally(verdicts)
    by = ", ".join(f"{counts[key]} by {words}" for key, words in WORDS.items())
    return (
        f"{counted(counts['mutants'], 'mutant')}, {counts['equivalent']} equivalent,"
        f" {counts['killed']} noticed ({by}), {counts['survived']} survived: {100 * noticed_share(counts):.1f} %"
    )


WORDS = {"check": "`check`", "invariant": "invariants", "test": "tests", "generated": "generated tests"}


def _write(judged: Sequence[tuple[Mutant, Verdict]]) -> None:
    from powderdsl.testing.mutation.judging import add_tests

    tests: dict[Path, dict[str, GeneratedTest]] = {}
    for mutant, verdict in judged:
        if verdict.test is not None:
            body = verdict.test.text.split("\n", 1)[1]  # one world may detect several mutants
            tests.setdefault(Path(mutant.source.name), {}).setdefault(body, verdict.test)
    for path, some in tests.items():
        try:
            add_tests(path, list(some.values()))
        except ValueError as error:
            raise BadInput(str(error)) from None
        click.echo(f"{path}: {counted(len(some), 'generated test')} added", err=True)
