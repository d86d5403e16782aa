"""`powderdsl test`: the tests and the invariants of packs, and which rules never happened meanwhile."""

from __future__ import annotations

from pathlib import Path

import click

from powderdsl.cli.exits import FAILED, OK, BadInput, print_json
from powderdsl.cli.options import Integer, backend_option, check_writable, load_rules, set_option
from powderdsl.compiler import shipped_tests

MAX_SECONDS = 24 * 3600


@click.command("test")
@click.argument("rules", nargs=-1, metavar="[RULES]...")
@backend_option("arrays")
@set_option
@click.option("--examples", type=Integer(0, 10_000_000), default=1000,
              help="Random worlds on which each invariant is tried.")  # fmt: skip
@click.option("--drawn", type=Integer(0, 1_000_000), default=100,
              help="Additional worlds, drawn by Hypothesis.")  # fmt: skip
@click.option("--seconds", type=Integer(1, MAX_SECONDS), default=60,
              help="Time limit for random worlds, per RULES, in seconds.")  # fmt: skip
@click.option("--seed", type=Integer(0, 2**31 - 1), default=0,
              help="Seed of the random worlds.")  # fmt: skip
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
@click.option("--write", is_flag=True, help="With --mutate: add tests that notice them to their packs.")
@click.option("--jobs", type=Integer(1, 256), metavar="N",
              help="With --mutate: number of processes.  [default: one per processor]")  # fmt: skip
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
    from powderdsl.cli.testing_report import TestingReport
    from powderdsl.testing.properties.search import SearchPlan

    session = TestingReport(
        backend, SearchPlan(examples, float(seconds), seed), drawn, keep, picture, as_json
    )
    for name in rules or shipped_tests():
        ruleset = load_rules(name, settings)
        if replay is not None:
            session.replay(name, ruleset, replay)
        else:
            session.test(name, ruleset)
    if as_json:
        print_json(session.data)
    return FAILED if session.failed else OK
