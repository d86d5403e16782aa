"""`powderdsl test --mutate`: put realistic mistakes into packs, list those that nothing notices, and write tests for them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, print_json, progress

if TYPE_CHECKING:
    from powderdsl.testing.mutation.judging import Verdict
    from powderdsl.testing.mutation.mutants import Mutant
    from powderdsl.testing.mutation.written import GeneratedTest


@dataclass(frozen=True)
class MutationPlan:
    """What is mutated: `packs` alone, up to `mutants`, in `jobs` processes; `write` adds tests to the packs' files."""

    packs: tuple[str, ...]
    settings: dict[str, str]
    mutants: int | None
    seed: int
    jobs: int | None
    write: bool
    as_json: bool


def report_mutants(names: Sequence[str], plan: MutationPlan) -> int:
    """Mutate each of some compositions; the exit code: 1 if a mutant survives."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a process; they inherit it
    data = {}
    try:
        for name in names:
            data[name] = _report(name, plan)
    finally:
        if plan.as_json:
            print_json(data)
    return FAILED if any(one["survived"] for one in data.values()) else OK


def _report(name: str, plan: MutationPlan) -> dict[str, Any]:
    from powderdsl.testing.mutation.judging import Original, run_campaign, sampled, tally

    began = monotonic()
    settings = tuple(plan.settings.items())
    original = Original.of(name, settings)
    loaded = [pack.name.text for pack in original.packs]
    unknown = [pack for pack in plan.packs if pack not in loaded]
    if unknown:
        raise BadInput(f"--pack {unknown[0]}: {name} consists of {', '.join(loaded)}")
    mutants = original.mutants(frozenset(plan.packs))
    numbers = sampled(mutants, plan.mutants, plan.seed)
    verdicts: dict[int, Verdict] = {}
    jobs = plan.jobs or os.cpu_count() or 1
    events = run_campaign(name, plan.packs, numbers, jobs, plan.seed, settings=settings)
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
    judged = [(mutants[number], verdicts[number]) for number in sorted(verdicts)]
    packs = {
        pack: [verdict for mutant, verdict in judged if mutant.pack == pack]
        for pack in dict.fromkeys(mutant.pack for mutant, _ in judged)
    }
    if not plan.as_json:
        click.echo("".join(f"{line}\n" for line in _survivors(judged)), nl=False)
        if interrupt is not None:
            click.echo(f"interrupted after {len(judged)} of {counted(len(numbers), 'mutant')}")
        for pack, own in packs.items():
            click.echo(f"{pack}: {summary(own)}")
        click.echo(f"{name}: {summary(list(verdicts.values()))} in {monotonic() - began:.0f} s")
    if plan.write:
        _write(judged)
    if interrupt is not None:
        raise interrupt
    return {
        **tally(verdicts.values()),
        "packs": {pack: tally(own) for pack, own in packs.items()},
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
