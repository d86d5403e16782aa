"""One random ruleset, some random worlds: does every backend give the reference's worlds, bit for bit?

`run_seed` makes the rules and worlds of a seed and compares; `check_case` repeats one comparison.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any
from weakref import finalize

from powderdsl.diagnostics import CompileError
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.targets.cpp.build import Building, building
from powderdsl.testing.generators.cases import Choices, Start, random_start
from tests.fuzz import EMULATED, PORTABLE, STARTS_AT_ONCE
from tests.fuzz.cases import Case, fitted
from tests.fuzz.compare import find_difference
from tests.fuzz.cuda_emulation import EmulatedSimulator
from tests.fuzz.exercised import Used, constructs, operations
from tests.fuzz.rulemaker import random_ruleset_text
from tests.semantics.texts import load_text

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator

State = Mapping[str, Any]

ORACLE = "reference"

WIDTHS = (7, 8, 16, 31, 32, 33, 63, 64, 64, 64, 65, 97, 128, 130)
"""Columns of wide worlds: the words of native code, their borders, more words than one, and the width of most worlds."""

STRIPS = 8
"""Strips that native code cuts a world into, unless its words are narrow; it does so if they have equally many rows."""

MANY = 9
"""More worlds than native code runs side by side; one seed in eight has so many."""


@dataclass(frozen=True)
class Plan:
    """What is compared for a seed: backends, the worlds of a ruleset, steps, and how native code is built."""

    backends: tuple[str, ...] = STARTS_AT_ONCE
    worlds: int = 4
    steps: int = 3
    building: Building = field(default_factory=lambda: Building("-O0"))


@dataclass(frozen=True)
class Finding:
    """A case that fails. `kind`: `differs`, or the name of an exception; then what happened, in a few lines."""

    seed: int
    case: Case
    kind: str
    problem: str


@dataclass(frozen=True)
class Outcome:
    """What came of a seed. `refused`: the static checks did not accept the text."""

    seed: int
    refused: bool = False
    worlds: int = 0
    findings: tuple[Finding, ...] = ()
    used: Used = field(default_factory=frozenset)


def seeded_starts(ruleset: Ruleset, seed: int, worlds: int) -> Iterator[Start]:
    """The start worlds of a seed: all but one of them tiny, one wide; now and then more than a register holds, or one
    that native code cuts into strips."""
    choices = Choices.seeded(seed * 2 + 1)
    batch = max(1, worlds - 1)
    yield random_start(ruleset, choices, (batch, choices.integer(1, 5), choices.integer(1, 5)))
    if worlds > 1:
        sides = [choices.integer(1, 3), choices.pick(WIDTHS)]
        yield random_start(ruleset, choices, (1, *(sides if choices.maybe(80) else sides[::-1])))
    if seed % 8 == 0:
        yield random_start(
            ruleset, choices, (MANY + choices.below(MANY), choices.integer(1, 3), choices.integer(1, 9))
        )
    if seed % 8 == 4:
        yield random_start(ruleset, choices, (1, STRIPS * choices.integer(1, 3), choices.pick(WIDTHS)))


def run_seed(
    seed: int, plan: Plan, tell: Callable[[tuple[str, int]], object] = lambda place: None
) -> Outcome:
    """Compare all backends of a plan on the rules and worlds of a seed.

    Args:
        tell: is called with a backend and the number of a start before that is run, for a caller who wants to know
            what a process died of.
    """
    text = random_ruleset_text(seed)
    try:
        ruleset = load_text(text, f"seed{seed}.yaml")
    except CompileError:
        return Outcome(seed, refused=True)
    starts = list(seeded_starts(ruleset, seed, plan.worlds))
    expected: list[list[State]] = []
    findings: list[Finding] = []
    for backend in (ORACLE, *plan.backends):
        simulator: Simulator | None = None
        for number, start in enumerate(starts):
            tell((backend, number))
            kind, problem = "differs", None
            try:
                simulator = simulator or _compiled(ruleset, backend, plan.building, threads=1 + seed % 2)
                if backend == ORACLE:
                    expected.append(_states(simulator, start, plan.steps))
                else:
                    problem = _problem(simulator, start, expected[number])
            except Exception as error:  # whatever a backend raises is a finding
                kind, problem = type(error).__name__, _told(error)
            if problem is not None:
                findings.append(Finding(seed, Case(text, start, plan.steps, backend), kind, problem))
                break
        _forget(plan.building.folder)
        if len(expected) < len(starts):
            break
    worlds = sum(len(start.ids) for start in starts)
    used = frozenset(constructs(ruleset)) | (frozenset() if findings else operations(ruleset))
    return Outcome(seed, False, worlds, tuple(findings), used)


def check_case(case: Case, how: Building) -> tuple[str, str] | None:
    """Kind and text of what is wrong with a case, or None: the backend agrees.

    Raises:
        CompileError: the rules are refused. ValueError, TypeError: the worlds are none of these rules.
    """
    oracle = _oracle(case.text)
    start = fitted(case.start, oracle.ruleset)
    start.world(oracle)
    try:
        expected = _states(oracle, start, case.steps)
        problem = _problem(_simulator(case.text, case.backend, how), start, expected)
    except Exception as error:  # as above
        return type(error).__name__, _told(error)
    finally:
        _forget(how.folder)
    return None if problem is None else ("differs", problem)


def still_fails(finding: Finding, how: Building) -> Callable[[Case], bool]:
    """Whether another case fails in the way that a finding does, for `reducer.reduce_case`."""

    def fails(case: Case) -> bool:
        try:
            found = check_case(case, how)
        except (CompileError, ValueError, TypeError, KeyError):  # no longer rules, or no longer their worlds
            return False
        return found is not None and found[0] == finding.kind

    return fails


@lru_cache(maxsize=1)  # a reducer tries many worlds with the same rules
def _oracle(text: str) -> Simulator:
    return compile_ruleset(load_text(text, "case.yaml"), backend=ORACLE)


@lru_cache(maxsize=1)
def _simulator(text: str, backend: str, how: Building) -> Simulator:
    return _compiled(load_text(text, "case.yaml"), backend, how, threads=2)


def _compiled(ruleset: Ruleset, backend: str, how: Building, threads: int) -> Simulator:
    if backend == EMULATED:
        return _emulated(ruleset, how.folder, order=threads % 2)
    if backend == PORTABLE:
        return portable(compile_ruleset(ruleset, backend="torch"))
    with building(how):
        return compile_ruleset(ruleset, backend=backend, threads=threads if backend == "native" else 1)


def portable(simulator: Simulator) -> Simulator:
    """A simulator of the backend `torch` that runs as on other devices than CPUs."""
    program = simulator._program.whole
    for part in getattr(program, "parts", [program]):
        part.eager = False
    return simulator


def _emulated(ruleset: Ruleset, folder: Path | None, order: int) -> Simulator:
    """Kernels are compiled when worlds of a new size come; they stay in a folder of their own until they are not needed."""
    kernels = Path(mkdtemp(prefix="powderdsl-kernels-", dir=folder))
    simulator = EmulatedSimulator(ruleset, kernels, order)
    finalize(simulator, shutil.rmtree, kernels, ignore_errors=True)
    return simulator


def _forget(folder: Path | None) -> None:
    """Remove the libraries that this process has loaded: no other ruleset has the same, and they pile up."""
    for entry in sorted(folder.iterdir()) if folder is not None else ():
        if entry.name.startswith("powderdsl-kernels-"):
            continue  # still in use
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def _states(simulator: Simulator, start: Start, steps: int) -> list[State]:
    """The state at the start and after every step."""
    world = start.world(simulator)
    states: list[State] = [dict(world.state)]
    for _ in range(steps):
        world = simulator.step(world, params=start.params or None)
        states.append(dict(world.state))
    return states


def _problem(simulator: Simulator, start: Start, expected: Sequence[State]) -> str | None:
    """Where a backend differs from the reference: step by step, in one call, and with a world on its own."""
    for step, (wanted, found) in enumerate(
        zip(expected, _states(simulator, start, len(expected) - 1), strict=True)
    ):
        if difference := find_difference(wanted, found):
            return f"differs after step {step}: {difference}"
    steps = len(expected) - 1
    world = start.world(simulator)
    jump = simulator.step(world, steps, params=start.params or None)
    if difference := find_difference(expected[-1], dict(jump.state)):
        return f"differs after {steps} steps in one call: {difference}"
    last = len(start.ids) - 1
    params = {name: values[last] for name, values in start.params.items()}
    alone = simulator.step(world.select([last]), steps, params=params or None)
    wanted = {name: value[last:] for name, value in expected[-1].items()}
    if difference := find_difference(wanted, dict(alone.state)):
        return f"world {last} differs after {steps} steps on its own: {difference}"
    return None


def _told(error: Exception) -> str:
    """An exception, and the last place of ours that it came from."""
    trace, place = error.__traceback__, ""
    while trace is not None:
        place = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{type(error).__name__} at {place}\n{error}"
