"""Counts which mutants of the shipped packs and examples are noticed, for the table in docs/testing.md.

`python docs/mutation_table.py` judges all of them (minutes) and writes docs/mutation.json and the table;
`python docs/mutation_table.py life steam` only those of some packs. `--jobs N` sets the number of processes.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # runs from a checkout that is not installed

from powderdsl.compiler import shipped_tests

DOCS = Path(__file__).resolve().parent
RESULTS = DOCS / "mutation.json"

EXAMPLES = {
    "core+water+docs/examples/beetle.yaml": ("beetle",),
    "core+docs/examples/electricity.yaml": ("electricity",),
    "core+water+docs/examples/salt.yaml": ("salt",),
    "core+water+fire+lava+docs/examples/steam.yaml": ("steam",),
}
"""Compositions of the examples, and which of their packs are mutated."""


def compositions() -> dict[str, tuple[str, ...]]:
    """What is judged: rules, and which of their packs; none for all of them."""
    return {**dict.fromkeys(shipped_tests(), ()), **EXAMPLES}


def count(rules: str, packs: tuple[str, ...], jobs: int, worlds: bool = False) -> dict[str, Any]:
    """The tallies of a composition's packs. `worlds`: also look for worlds that show survivors, which takes longer."""
    from powderdsl.mutation.mutation_run import run_campaign
    from powderdsl.mutation.original import Original
    from powderdsl.mutation.tally import tally

    mutants = Original.of(rules).mutants(frozenset(packs))
    began = time.monotonic()
    found = []
    for outcome in run_campaign(rules, packs, list(range(len(mutants))), jobs, 0, worlds):
        found.append(outcome)
        if sys.stderr.isatty():
            print(f"\r{rules}: {len(found)} of {len(mutants)}", end="", file=sys.stderr, flush=True)
    seconds = round(time.monotonic() - began)
    names = dict.fromkeys(mutant.pack for mutant in mutants)
    tallies = {name: tally(one for one in found if mutants[one.number].pack == name) for name in names}
    return {"packs": tallies, "seconds": seconds}


def main(arguments: list[str]) -> int:
    """Judge, write the counts, write the table."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a process; they inherit it
    jobs = os.cpu_count() or 1
    if "--jobs" in arguments:
        place = arguments.index("--jobs")
        jobs = int(arguments[place + 1])
        arguments = arguments[:place] + arguments[place + 2 :]
    measured = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
    for rules, packs in compositions().items():
        if not arguments or rules in arguments or set(packs) & set(arguments):
            measured[rules] = count(rules, packs, jobs)
            print(f"{rules}: {measured[rules]['seconds']} s", flush=True)
            ordered = {name: measured[name] for name in compositions() if name in measured}
            RESULTS.write_text(json.dumps(ordered, indent=1) + "\n", "utf-8")
    import generate

    return generate.main([])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
