"""Counts which mutants of the shipped packs and examples are noticed, for the table in docs/testing.md.

`python docs/mutation_table.py` judges all of them (minutes) and writes docs/mutation.json and the table;
`python docs/mutation_table.py life water` only those of some compositions or packs; the others' counts stay. What has
been counted is written after each pack. `--jobs N` sets the number of processes. `--survivors` judges only those again
that survived, after tests have been added below the rules.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout that is not installed

from powderdsl.compiler import read, shipped_tests, shipped_variants
from powderdsl.diagnostics import Reporter

if TYPE_CHECKING:
    from powderdsl.testing.mutation.operators import Mutant

DOCS = Path(__file__).resolve().parent
RESULTS = DOCS / "mutation.json"

EXAMPLES = {
    "core+water+docs/examples/beetle.yaml": ("beetle",),
    "core+docs/examples/electricity.yaml": ("electricity",),
    "core+sand+water+docs/examples/salt.yaml": ("salt",),
    "core+water+fire+lava+docs/examples/steam.yaml": ("steam",),
}
"""Compositions of the examples, and which of their packs are mutated."""


@cache
def compositions() -> dict[str, tuple[str, ...]]:
    """What is judged: rules, and which of their packs, each in the first rules that load it."""
    chosen: dict[str, tuple[str, ...]] = {}
    for rules in shipped_tests():
        if rules not in shipped_variants():
            known = {pack for packs in chosen.values() for pack in packs}
            names = [pack.name.text for pack in read([rules], Reporter())[0]]
            chosen[rules] = tuple(name for name in names if name not in known)
    return {**chosen, **EXAMPLES}


Counts = dict[str, dict[str, int]]
"""Tallies by pack."""

Survivors = dict[str, list[str]]
"""The mutants that survive, by pack: their lines, kinds and changes."""


def packs_of(rules: str) -> list[str]:
    """The packs of a composition that are mutated, in their order."""
    return list(compositions()[rules])


def words_of(mutant: Mutant) -> str:
    """A mutant as the table's file names it: the same while no line before it changes."""
    return f"{mutant.place.removeprefix(mutant.source.name).lstrip(':')} {mutant.operator} {mutant.diff}"


def count(
    rules: str, packs: Sequence[str], jobs: int, only: Survivors | None = None
) -> Iterator[tuple[Counts, Survivors]]:
    """Tallies and survivors of some packs of a composition, each as soon as all of its mutants are judged.

    `only`: mutants that are judged, instead of all. Raises ValueError if there is none like one of them.
    """
    from powderdsl.testing.mutation.judging import Original, Verdict, run_campaign, tally

    mutants = Original.of(rules).mutants(frozenset(packs))
    numbers = list(range(len(mutants)))
    if only is not None:
        numbers = [n for n in numbers if words_of(mutants[n]) in only.get(mutants[n].pack, ())]
        if len(numbers) != sum(len(only.get(pack, ())) for pack in packs):
            raise ValueError(f"the rules of {', '.join(packs)} have changed: judge all of their mutants")
    left = Counter(mutants[number].pack for number in numbers)
    found: dict[str, dict[int, Verdict]] = {pack: {} for pack in left}
    for number, verdict in run_campaign(rules, tuple(packs), numbers, jobs, 0):
        pack = mutants[number].pack
        found[pack][number] = verdict
        left[pack] -= 1
        if sys.stderr.isatty():
            print(f"\r{rules}: {left.total()} left", end=" ", file=sys.stderr, flush=True)
        if not left[pack]:
            alive = [words_of(mutants[n]) for n, v in sorted(found[pack].items()) if v.status == "survived"]
            yield {pack: tally(found[pack].values())}, {pack: alive}


def record(measured: dict[str, Any], rules: str, counts: Counts, survivors: Survivors) -> dict[str, Any]:
    """What has been measured with some more counts, in the order of the compositions and of their packs."""
    entry = measured.get(rules, {})
    known, alive = {**entry.get("packs", {}), **counts}, {**entry.get("survivors", {}), **survivors}
    order = packs_of(rules)
    ordered = {pack: known[pack] for pack in order if pack in known}
    some = {pack: alive[pack] for pack in order if alive.get(pack)}
    merged = {**measured, rules: {"packs": ordered, **({"survivors": some} if some else {})}}
    return {name: merged[name] for name in compositions() if name in merged}


def judged_again(before: Counts, counts: Counts) -> Counts:
    """The counts of whole packs, after their survivors alone have been judged again."""
    sums = {pack: Counter(before[pack]) for pack in counts}
    for pack, more in counts.items():
        sums[pack].update({key: more[key] for key in more if key != "mutants"})
        sums[pack]["survived"] -= more["mutants"]
    return {pack: {key: sums[pack][key] for key in before[pack]} for pack in counts}


def main(arguments: list[str]) -> int:
    """Judge, write the counts after each pack, write the table."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a process; they inherit it
    os.environ["XDG_CACHE_HOME"] = os.devnull  # nobody compiles a mutant again
    jobs = os.cpu_count() or 1
    if "--jobs" in arguments:
        place = arguments.index("--jobs")
        jobs = int(arguments[place + 1])
        arguments = arguments[:place] + arguments[place + 2 :]
    again = "--survivors" in arguments
    arguments = [argument for argument in arguments if argument != "--survivors"]
    known = {rules: packs_of(rules) for rules in compositions()}
    unknown = set(arguments) - set(known) - {pack for packs in known.values() for pack in packs}
    if unknown:
        print(f"neither a composition nor a pack: {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    measured = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    for rules, packs in known.items():
        asked = [pack for pack in packs if not arguments or rules in arguments or pack in arguments]
        if not asked:
            continue
        began = time.monotonic()
        entry = measured.get(rules, {})
        only = entry.get("survivors", {}) if again else None
        for counts, survivors in count(rules, asked, jobs, only):
            counts = judged_again(entry["packs"], counts) if again else counts
            measured = record(measured, rules, counts, survivors)
            RESULTS.write_text(json.dumps(measured, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(f"{rules}: {time.monotonic() - began:.0f} s", flush=True)
    import generate

    return generate.main([])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
