"""`powderdsl test`: run the tests of packs, check their invariants, and list rules that never happened."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, print_json, progress
from powderdsl.compiler import shipped_tests

if TYPE_CHECKING:
    from powderdsl.testing.mutation.judging import Verdict
    from powderdsl.testing.mutation.mutants import Mutant
    from powderdsl.testing.mutation.written import GeneratedTest

MAX_SECONDS = 24 * 3600


@click.command("test")
@click.argument("rules", nargs=-1, metavar="[RULES]...")
@opt.backend(None, "Backend that runs the rules.  [default: wasm]")
@opt.parameters
@opt.option("--examples", (0, 10_000_000), "Random worlds on which each invariant is tried.", 1000)
@opt.option("--seconds", (1, MAX_SECONDS), "Time limit for random worlds, per RULES, in seconds.", 60)
@opt.option("--seed", (0, 2**31 - 1), "Seed of the random worlds.", 0)
@opt.path("--replay", "FILE", "Only try this counterexample again.")
@opt.output("--picture", "FILE", "Draw the first counterexample, before and after, as a .png.", ".png")
@click.option(
    "--keep/--no-keep",
    default=None,
    help="Keep counterexamples in .powderdsl/.  [default: unless $CI is set]",
)
@opt.option("--json", bool, "One JSON object instead of text.", to="as_json")
@opt.option("--mutate", bool, "Put mistakes into the packs, and list those that nothing notices.")
@opt.option("--pack", "PACK", "With --mutate: only mistakes in this pack. May be repeated.", multiple=True)
@opt.option(
    "--mutants", (1, 1_000_000), "With --mutate: maximum number of mutants, of each kind in proportion."
)
@opt.option("--write", bool, "With --mutate: add tests that notice them to their packs.")
@opt.option("--jobs", (1, 256), "With --mutate: number of processes.  [default: one per processor]")
def command(
    rules: tuple[str, ...],
    backend: str | None,
    settings: dict[str, str],
    examples: int,
    seconds: int,
    seed: int,
    replay: Path | None,
    picture: Path | None,
    keep: bool | None,
    as_json: bool,
    mutate: bool,
    **mutation: Any,
) -> int:
    """Run the tests of packs and check their invariants.

    Without RULES, all that come with powderdsl. A test without a seed runs with five. Invariants are proven where that
    is possible, else tried on random worlds; one that breaks is shown by a small world, kept in .powderdsl/, and tried
    first from then on.

    Exit code: 0 if all holds, 1 if something fails, 2 for bad rules.
    """
    for name, value in ({"replay": replay, "picture": picture} if mutate else mutation).items():
        if value:
            raise BadInput(f"--{name} goes {'without' if mutate else 'with'} --mutate")
    if mutate:
        return _mutate(rules or shipped_tests(), as_json, settings=settings, seed=seed, **mutation)
    if replay is not None and len(rules) != 1:
        raise BadInput("--replay takes the one RULES that the counterexample breaks")
    from powderdsl.cli.testing_report import TestingReport
    from powderdsl.testing.properties.search import SearchPlan

    session = TestingReport(backend, SearchPlan(examples, float(seconds), seed), keep, picture, as_json)
    for name in rules or shipped_tests():
        ruleset = opt.load_rules(name, settings)
        if replay is not None:
            session.replay(name, ruleset, replay)
        else:
            session.test(name, ruleset)
    if as_json:
        print_json(session.data)
    return FAILED if session.failed else OK


# Mutants


def _mutate(names: Iterable[str], as_json: bool, **how: Any) -> int:
    """Mutate each of some compositions; the exit code: 1 if a mutant survives."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a process; they inherit it
    data = {}
    try:
        for name in names:
            data[name] = _mutated(name, as_json, **how)
    finally:
        if as_json:
            print_json(data)
    return FAILED if any(one["survived"] for one in data.values()) else OK


def _mutated(
    name: str,
    as_json: bool,
    pack: tuple[str, ...],
    settings: dict[str, str],
    mutants: int | None,
    seed: int,
    jobs: int | None,
    write: bool,
) -> dict[str, Any]:
    """Mutate some packs of a composition alone, up to `mutants`, in `jobs` processes; `write` adds tests to their files."""
    from powderdsl.testing.mutation.judging import Original, run_campaign, sampled, tally

    began = monotonic()
    values = tuple(settings.items())
    original = Original.of(name, values)
    loaded = [pack.name.text for pack in original.packs]
    unknown = [word for word in pack if word not in loaded]
    if unknown:
        raise BadInput(f"--pack {unknown[0]}: {name} consists of {', '.join(loaded)}")
    every = original.mutants(frozenset(pack))
    numbers = sampled(every, mutants, seed)
    verdicts: dict[int, Verdict] = {}
    events = run_campaign(name, pack, numbers, jobs or os.cpu_count() or 1, seed, settings=values)
    interrupt: KeyboardInterrupt | None = None
    with progress(name, len(numbers), lines=True) as show:
        try:
            for number, verdict in events:
                verdicts[number] = verdict
                alive = sum(one.status == "survived" for one in verdicts.values())
                show(len(verdicts), f"{alive} survived")
        except KeyboardInterrupt as caught:
            interrupt = caught
        finally:
            events.close()  # its processes end
    judged = [(every[number], verdicts[number]) for number in sorted(verdicts)]
    by_pack = {
        own: [verdict for mutant, verdict in judged if mutant.pack == own]
        for own in dict.fromkeys(mutant.pack for mutant, _ in judged)
    }
    if not as_json:
        click.echo("".join(f"{line}\n" for line in _survivors(judged)), nl=False)
        if interrupt is not None:
            click.echo(f"interrupted after {len(judged)} of {counted(len(numbers), 'mutant')}")
        for title, own in by_pack.items():
            click.echo(f"{title}: {summary(own)}")
        click.echo(f"{name}: {summary(list(verdicts.values()))} in {monotonic() - began:.0f} s")
    if write:
        _write(judged)
    if interrupt is not None:
        raise interrupt
    return {
        **tally(verdicts.values()),
        "packs": {pack: tally(own) for pack, own in by_pack.items()},
        "list": [_row(mutant, verdict) for mutant, verdict in judged if verdict.status != "invalid"],
    }


def _survivors(judged: Sequence[tuple[Mutant, Verdict]]) -> Iterator[str]:
    """Each mutant that nothing noticed, with a test that would."""
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
    """The number of mutants, and what noticed them."""
    from powderdsl.testing.mutation.judging import noticed_share, tally

    counts = tally(verdicts)
    by = ", ".join(f"{counts[key]} by {words}" for key, words in WORDS.items())
    return (
        f"{counted(counts['mutants'], 'mutant')}, {counts['equivalent']} equivalent,"
        f" {counts['killed']} noticed ({by}), {counts['survived']} survived: {100 * noticed_share(counts):.1f} %"
    )


WORDS = {"check": "`check`", "invariant": "invariants", "test": "tests", "generated": "generated tests"}


def _write(judged: Sequence[tuple[Mutant, Verdict]]) -> None:
    from powderdsl.testing.mutation.written import add_tests

    tests: dict[Path, dict[str, GeneratedTest]] = {}
    for mutant, verdict in judged:
        if verdict.test is not None:
            body = verdict.test.text.split("\n", 1)[1]  # several mutants may be told apart by one world
            tests.setdefault(Path(mutant.source.name), {}).setdefault(body, verdict.test)
    for path, some in tests.items():
        try:
            add_tests(path, list(some.values()))
        except ValueError as error:
            raise BadInput(str(error)) from None
        click.echo(f"{path}: {counted(len(some), 'generated test')} added", err=True)
