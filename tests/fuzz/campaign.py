"""Fuzzing at length: many seeds in several processes; what fails is made small and saved."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from tempfile import gettempdir

import torch

from powderdsl.system.writing import scratch_folder
from tests.fuzz.cases import Case, write_case
from tests.fuzz.crew import Done, Lost, work_through
from tests.fuzz.differential import Finding, Outcome, Plan, run_seed, seeded_starts, still_fails
from tests.fuzz.reducer import reduce_case
from tests.fuzz.rulemaker import random_ruleset_text
from tests.semantics.texts import load_text

SEED_LIMIT = 600
"""Seconds that a seed may take before it counts as one that hangs."""

REDUCE_SECONDS = 120.0
MOST_FINDINGS = 20
"""So many are enough: they have one cause, more often than not."""


@dataclass
class Tally:
    """What has been done. `files`: names of the files with what failed."""

    rulesets: int = 0
    refused: int = 0
    worlds: int = 0
    used: Counter[tuple[str, str]] = field(default_factory=Counter)
    files: list[str] = field(default_factory=list)

    def count(self, outcome: Outcome) -> None:
        """Add the outcome of a seed."""
        self.refused += outcome.refused
        self.rulesets += not outcome.refused
        self.worlds += outcome.worlds
        self.used.update(outcome.used)


def run_campaign(
    plan: Plan, tally: Tally, seeds: Iterator[int], jobs: int, folder: Path, until: float
) -> Generator[Outcome | Path, None, None]:
    """Compare on seeds until they or the time are over; each outcome of a seed, and each file with a finding.

    Findings are saved as they are found, and again when they have been made smaller.

    Args:
        seeds: the seeds that are left.
        until: the end, on `time.monotonic`'s clock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tasks: deque[int | Finding] = deque(islice(seeds, 2 * jobs))
    with scratch_folder(Path(gettempdir())) as scratch:
        work = partial(perform, plan, scratch)
        for heard in work_through(tasks, work, jobs, SEED_LIMIT):
            findings: tuple[Finding, ...] = ()
            if isinstance(heard, Lost):
                findings = () if isinstance(heard.task, Finding) else (_lost(plan, scratch, heard),)
            elif isinstance(heard.result, Outcome):
                tally.count(heard.result)
                findings = heard.result.findings
                yield heard.result
            else:
                write_case(folder / file_name(heard.result), heard.result.case, heard.result.problem)
            for finding in findings:
                path = folder / file_name(finding)
                write_case(path, finding.case, finding.problem)
                tally.files.append(path.name)
                if isinstance(heard, Done):
                    tasks.appendleft(finding)
                yield path
            if time.monotonic() < until and len(tally.files) < MOST_FINDINGS:
                tasks.extend(islice(seeds, max(0, 2 * jobs - len(tasks))))
            else:
                for task in [task for task in tasks if not isinstance(task, Finding)]:
                    tasks.remove(task)


def file_name(finding: Finding) -> str:
    return f"seed{finding.seed}-{finding.case.backend}.yaml"


def perform(plan: Plan, scratch: Path, task: int | Finding) -> Outcome | Finding:
    """What a process does with a task: runs a seed, or makes a finding small."""
    torch.set_num_threads(1)
    folder = scratch / str(os.getpid())  # each its own, so that none removes what another has just built
    folder.mkdir(exist_ok=True)
    how = replace(plan.building, folder=folder)
    if isinstance(task, int):
        note = _note(scratch, task)
        outcome = run_seed(task, replace(plan, building=how), lambda at: note.write_text(f"{at[0]} {at[1]}"))
        note.unlink(missing_ok=True)
        return outcome
    end = time.monotonic() + REDUCE_SECONDS
    fails = still_fails(task, how)
    return replace(task, case=reduce_case(task.case, lambda case: time.monotonic() < end and fails(case)))


def _note(scratch: Path, seed: int) -> Path:
    """Where a process writes the backend and the start that it runs, in case it dies of them."""
    return scratch / f"seed{seed}.txt"


def _lost(plan: Plan, scratch: Path, lost: Lost) -> Finding:
    """What a process was at when it died or was ended, as a finding: not made small, since it would die again."""
    text = random_ruleset_text(lost.task)
    note = _note(scratch, lost.task)
    backend, number = note.read_text().split() if note.exists() else (plan.backends[0], "0")
    starts = list(seeded_starts(load_text(text), lost.task, plan.worlds))
    return Finding(lost.task, Case(text, starts[int(number)], plan.steps, backend), "lost", lost.reason)
