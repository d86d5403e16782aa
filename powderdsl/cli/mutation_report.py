"""`powderdsl test --mutate`: put realistic mistakes into packs, list those that nothing notices, and write tests for them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, print_json, progress

if TYPE_CHECKING:
    from powderdsl.testing.mutation.judging import Outcome
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
    from powderdsl.testing.mutation.judging import Original, run_campaign, sampled

    began = monotonic()
    settings = tuple(plan.settings.items())
    original = Original.of(name, settings)
    loaded = [pack.name.text for pack in original.packs]
    unknown = [pack for pack in plan.packs if pack not in loaded]
    if unknown:
        raise BadInput(f"--pack {unknown[0]}: {name} consists of {', '.join(loaded)}")
    mutants = original.mutants(frozenset(plan.packs))
    numbers = sampled(mutants, plan.mutants, plan.seed)
    outcomes: dict[int, Outcome] = {}
    jobs = plan.jobs or os.cpu_count() or 1
    events = run_campaign(name, plan.packs, numbers, jobs, plan.seed, settings=settings)
    interrupt: KeyboardInterrupt | None = None
    with progress(name, len(numbers), lines=True) as show:
        try:
            for outcome in events:
                outcomes[outcome.number] = outcome
                alive = sum(one.verdict.status == "survived" for one in outcomes.values())
                show(len(outcomes), f"{alive} survived")
        except KeyboardInterrupt as caught:
            interrupt = caught
        finally:
            events.close()  # its processes end
    found = [(mutants[number], outcomes[number]) for number in sorted(outcomes)]
    if not plan.as_json:
        _tell(name, found, monotonic() - began, len(numbers), interrupt is not None)
    if plan.write:
        _write(found)
    if interrupt is not None:
        raise interrupt
    return _data(found)


def _tell(
    name: str, found: list[tuple[Mutant, Outcome]], seconds: float, planned: int, interrupted: bool
) -> None:
    for mutant, outcome in found:
        if outcome.verdict.status != "survived":
            continue
        click.echo(f"survived  {mutant.place}: {mutant.operator}")
        click.echo(f"      {mutant.diff}")
        if outcome.size is None:
            reason = f" ({outcome.verdict.detail})" if outcome.verdict.detail else ""
            click.echo(f"      no world was found on which it differs{reason}")
        elif outcome.test is not None:
            click.echo("".join(f"        {line}\n" for line in outcome.test.text.splitlines()), nl=False)
    if interrupted:
        click.echo(f"interrupted after {len(found)} of {counted(planned, 'mutant')}")
    for pack in dict.fromkeys(mutant.pack for mutant, _ in found):
        own = [(mutant, outcome) for mutant, outcome in found if mutant.pack == pack]
        click.echo(f"{pack}: {summary(own)}")
    click.echo(f"{name}: {summary(found)} in {seconds:.0f} s")


def summary(found: Sequence[tuple[Mutant, Outcome]]) -> str:
    """The number of mutants, and what noticed them."""
    from powderdsl.testing.mutation.judging import noticed_share, tally

    counts = tally(outcome for _, outcome in found)
    by = ", ".join(f"{counts[key]} by {words}" for key, words in WORDS.items())
    return (
        f"{counted(counts['mutants'], 'mutant')}, {counts['equivalent']} equivalent,"
        f" {counts['killed']} noticed ({by}), {counts['survived']} survived: {100 * noticed_share(counts):.1f} %"
    )


WORDS = {"check": "`check`", "invariant": "invariants", "test": "tests", "generated": "generated tests"}


def _write(found: list[tuple[Mutant, Outcome]]) -> None:
    from powderdsl.testing.mutation.written import add_tests

    tests: dict[Path, dict[str, GeneratedTest]] = {}
    for mutant, outcome in found:
        if outcome.test is not None:
            body = outcome.test.text.split("\n", 1)[1]  # several mutants may be told apart by one world
            tests.setdefault(Path(mutant.source.name), {}).setdefault(body, outcome.test)
    for path, some in tests.items():
        try:
            add_tests(path, list(some.values()))
        except ValueError as error:
            raise BadInput(str(error)) from None
        click.echo(f"{path}: {counted(len(some), 'generated test')} added", err=True)


def _data(found: list[tuple[Mutant, Outcome]]) -> dict[str, Any]:
    from powderdsl.testing.mutation.judging import tally

    packs = dict.fromkeys(mutant.pack for mutant, _ in found)
    return {
        **tally(outcome for _, outcome in found),
        "packs": {pack: tally(outcome for mutant, outcome in found if mutant.pack == pack) for pack in packs},
        "list": [
            {
                "place": mutant.place,
                "pack": mutant.pack,
                "operator": mutant.operator,
                "change": mutant.diff,
                "status": outcome.verdict.status,
                "by": outcome.verdict.by,
                "detail": outcome.verdict.detail,
                "test": outcome.test.text if outcome.test else None,
                "differs_in": outcome.slot or None,
            }
            for mutant, outcome in found
            if outcome.verdict.status != "invalid"
        ],
    }
