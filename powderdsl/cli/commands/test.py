"""`powderdsl test`: run the tests of packs, check their invariants, and list rules that never happened."""

from __future__ import annotations

from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import print_json
from powderdsl.compiler import shipped_tests

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
@opt.option(
    "--pack", "PACK", "With --mutate: only mistakes in this pack. May be repeated.", to="packs", multiple=True
)
@opt.option(
    "--mutants",
    (1, 1_000_000),
    "With --mutate: maximum number of mutants, of each kind in proportion.",
    metavar="N",
)
@opt.option("--write", bool, "With --mutate: add tests that notice them to their packs.")
@opt.option(
    "--jobs", (1, 256), "With --mutate: number of processes.  [default: one per processor]", metavar="N"
)
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
    packs: tuple[str, ...],
    mutants: int | None,
    write: bool,
    jobs: int | None,
) -> int:
    """Run the tests of packs and check their invariants.

    Without RULES, all that come with powderdsl. A test without a seed runs with five. Invariants are proven where that
    is possible, else tried on random worlds; one that breaks is shown by a small world, kept in .powderdsl/, and tried
    first from then on.

    Exit code: 0 if all holds, 1 if something fails, 2 for bad rules.
    """
    only_mutate = {"--pack": packs, "--mutants": mutants, "--write": write, "--jobs": jobs}
    never_mutate = {"--replay": replay, "--picture": picture}
    for option, value in (never_mutate if mutate else only_mutate).items():
        if value:
            raise BadInput(f"{option} goes {'without' if mutate else 'with'} --mutate")
    if mutate:
        from powderdsl.cli.mutation_report import MutationPlan, report_mutants

        chosen = MutationPlan(packs, settings, mutants, seed, jobs, write, as_json)
        return report_mutants(rules or tuple(shipped_tests()), chosen)
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
