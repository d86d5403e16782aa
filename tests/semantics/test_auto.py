"""The backend `auto`: when it compiles, when it changes over, what it says; and that no cell is changed by it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

import powderdsl
from powderdsl.cli.dispatch import plain_warning
from powderdsl.model.types import Ruleset
from powderdsl.simulation import native
from powderdsl.simulation.native import AutoProgram
from powderdsl.simulation.programs import BackendProgram
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.system import cache
from powderdsl.targets.cpp.build import Building, NoCompiler, NoCompilerWarning, building
from powderdsl.targets.job import Clock, Job
from powderdsl.testing.generators.cases import Choices, random_start
from tests.cli.commands import environment_with
from tests.cli.commands import powderdsl as command
from tests.fuzz.compare import find_difference
from tests.semantics.texts import load_text

RULES = """\
pack: kettle
elements:
  air: {id: 0, color: "#102030"}
  drop: {id: 1, color: "#FEDCBA"}
fields:
  level: {type: -50..50, at: element, default: 3}
  heat: {type: real(-9..9), at: place}
streams: [coin]
params: {rate: 30%}
passes:
  fall:
    do: drop swaps below if below is air and coin < rate
  warm:
    after: fall
    do:
      - heat := heat * 0.7 + level / 7 - heat / 3 * (heat * 0.1 + 1) where coin < 0.7
      - level += 1 where heat > 0.5 and level < 50
"""


# --- when it changes over, with programs made up for it


@dataclass
class Counter:
    """A program that counts its steps in the state; it takes its time."""

    name: str
    seconds: float = 0.0
    log: list[tuple[str, int, int]] = field(default_factory=list)

    def run(self, job: Job) -> Mapping[str, Any]:
        self.log.append((self.name, int(job.clock.step[0]), job.steps))
        time.sleep(self.seconds * job.steps)
        return {"element": job.state["element"] + job.steps}


def job(steps: int, start: int = 0, **changes: Any) -> Job:
    zero = torch.zeros(1, dtype=torch.int64)
    clock = Clock(zero, zero, torch.tensor([start]))
    state = {"element": torch.full((1, 2, 2), start)}
    return Job(state, clock, steps, {}, changes.get("draws", {}), changes.get("passes"))


class Compiler:
    """Gives a program when it is told to, or raises."""

    def __init__(self, program: Counter, problem: Exception | None = None):
        self.program, self.problem, self.go, self.asked = program, problem, threading.Event(), 0

    def __call__(self) -> Counter:
        self.asked += 1
        if self.problem is not None:
            raise self.problem
        assert self.go.wait(60)
        return self.program


Log = list[tuple[str, int, int]]


def auto_program(
    seconds: float,
    problem: Exception | None = None,
    is_compiled: bool = False,
    first: type[Counter] = Counter,
) -> tuple[AutoProgram, Compiler, Log]:
    """A program of `auto` whose first backend takes some seconds a step, its compiler, and the log of what ran."""
    log: Log = []
    names = {name: Counter(name, 0, log) for name in ("torch", "native")}
    compiler = Compiler(names["native"], problem)
    return (
        AutoProgram(
            "wasm",
            lambda: first("wasm", seconds, log),
            lambda: names["torch"],
            lambda: names["native"] if is_compiled else None,
            compiler,
        ),
        compiler,
        log,
    )


def test_little_work_starts_no_compiler() -> None:
    program, compiler, log = auto_program(0.0001)
    state = {}
    for start in range(0, 300, 100):
        state = program.run(job(100, start))
    assert int(state["element"][0, 0, 0]) == 300
    assert program.run(job(0, 300))["element"].tolist() == [[[300, 300], [300, 300]]]
    assert compiler.asked == 0
    assert program.running == "wasm"
    assert program.notes == ("wasm: native is compiled from 2 s of work, or by --backend native",)
    assert {name for name, _, _ in log} == {"wasm"}


def test_long_calls_change_over_between_two_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """It compiles as soon as the pace shows what is to come, and changes over within the call."""
    monkeypatch.setattr(native, "SLICE", 0.02)
    program, compiler, log = auto_program(0.005)
    threading.Timer(0.3, compiler.go.set).start()
    state = program.run(job(5000))  # 25 s on the first backend
    assert int(state["element"][0, 0, 0]) == 5000
    assert compiler.asked == 1
    assert program.running == "native"
    done = 0
    for _, start, steps in log:  # no step twice, none left out
        assert start == done
        done += steps
    assert [name for name, _, _ in log] == ["wasm"] * (len(log) - 1) + ["native"]
    assert log[-1][2] > 4000
    assert program.notes[0].startswith(f"wasm for {5000 - log[-1][2]} steps while native was made ready")
    assert program.notes[0].endswith(f"then native for {log[-1][2]}")


class Full(Counter):
    def run(self, job: Job) -> Mapping[str, Any]:
        raise MemoryError


@pytest.mark.parametrize(("problem", "runs"), [(None, "native"), (NoCompiler("g++ does not run"), "torch")])
def test_worlds_too_large_for_webassembly_wait_for_native_code(problem: Exception | None, runs: str) -> None:
    program, compiler, log = auto_program(0, problem, first=Full)
    compiler.go.set()
    program.run(job(3))
    program.run(job(4, 3))
    assert log == [(runs, 0, 3), (runs, 3, 4)]


def test_given_draws_and_chosen_passes_stay_with_torch() -> None:
    auto, _, log = auto_program(0, is_compiled=True)
    program = BackendProgram("", auto, lambda: Counter("torch", 0, log))
    program.run(job(3))
    program.run(job(4, draws={"coin": torch.zeros(1, 2, 2)}))
    program.run(job(5, passes=frozenset({"fall"})))
    assert log == [("native", 0, 3), ("torch", 0, 4), ("torch", 0, 5)]
    assert auto.notes == ("native: it was compiled before",)


@pytest.mark.parametrize("problem", [NoCompiler("no C++ compiler: tried g++"), ValueError("oh")])
def test_without_native_code_the_first_backend_continues(
    problem: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "WORTH", 0.0)
    program, compiler, _ = auto_program(0.001, problem)
    native._warn_of_compilers.cache_clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for start in range(50):
            program.run(job(1, start))
    wanted = "no C++ compiler: tried g++; native code is many times faster: install g++ or clang++, or "
    sentences = [wanted + "`pip install powderdsl[native]`"] if isinstance(problem, NoCompiler) else []
    assert [str(one.message) for one in told] == sentences, "once"
    assert compiler.asked == 1
    assert str(problem) in program.notes[0]
    assert "pip install powderdsl[native]" in program.notes[1]


def test_threads_share_one_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "WORTH", 0.0)
    program, compiler, _ = auto_program(0.0001)
    results = []

    def run() -> None:
        for start in range(0, 2000, 20):
            results.append(int(program.run(job(20, start))["element"][0, 0, 0]) - start)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    compiler.go.set()
    for thread in threads:
        thread.join()
    assert results == [20] * 400
    assert compiler.asked == 1
    assert program.running == "native"


# --- real programs


@pytest.fixture
def rules() -> Ruleset:
    return load_text(RULES, "kettle.yaml")


def compilers() -> list[str]:
    """Every C++ compiler of this machine, as $CXX."""
    found = [name for name in ("g++", "clang++") if shutil.which(name)]
    package = find_spec("ziglang")
    if package is not None and package.origin:
        found.append(f"'{Path(package.origin).with_name('zig')}' c++")
    return found


def start_of(sim: Simulator) -> World:
    return random_start(sim.ruleset, Choices.seeded(5), (9, 21, 70)).world(sim)


needs_compiler = pytest.mark.skipif(not compilers(), reason="no C++ compiler")


@pytest.mark.slow
@pytest.mark.parametrize("cxx", compilers())
def test_every_compiler_gives_the_oracles_worlds(
    cxx: str, rules: Ruleset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", cxx)
    oracle = powderdsl.compile(rules, backend="reference")
    with building(Building("-O2", tmp_path)):
        native = powderdsl.compile(rules, backend="native", threads=2)
    wanted, found = (sim.step(start_of(sim), 25) for sim in (oracle, native))
    assert find_difference(wanted.state, found.state) is None


@needs_compiler
def test_auto_changes_over_to_the_same_worlds_and_remembers(
    rules: Ruleset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "WORTH", 0.0)
    with building(Building("-O0", tmp_path)):
        sims = [powderdsl.compile(rules) for _ in range(3)]
        assert [sim.running for sim in sims] == ["wasm"] * 3
        worlds = [start_of(sim) for sim in sims]
        steps, end = 0, time.monotonic() + 300
        while any(sim.running == "wasm" for sim in sims) and time.monotonic() < end:
            worlds = [world.sim.step(world) for world in worlds]
            steps += 1
            time.sleep(0.05)  # the worlds need not age while the compiler is busy
        worlds = [world.sim.step(world, 5) for world in worlds]
        assert [sim.running for sim in sims] == ["native"] * 3
        oracle = powderdsl.compile(rules, backend="wasm")
        expected = oracle.step(start_of(oracle), steps + 5)
        for world in worlds:
            assert find_difference(expected.state, world.state) is None
        assert len(libraries(tmp_path)) == 1

        # Other values of parameters, other tests and comments: nothing is compiled, it starts natively.
        text = RULES.replace("30%", "99%").replace("passes:", "# a comment\npasses:")
        again = powderdsl.compile(load_text(text, "elsewhere.yaml"))
        assert again.running == "native"
        assert again.notes == ("native: it was compiled before",)
        other = powderdsl.compile(load_text(RULES.replace("0.7 +", "0.6 +"), "kettle.yaml"))
        assert other.running == "wasm"


def libraries(folder: Path) -> list[Path]:
    """The libraries of programs in a cache, without those of drivers and the starts of programs."""
    return [entry.path for entry in cache.entries(folder) if not entry.name.endswith((".layout", "driver"))]


def compiled_natively(rules: Ruleset) -> None:
    sim = powderdsl.compile(rules, backend="native")
    sim.step(start_of(sim))


@pytest.mark.slow
@needs_compiler
def test_a_damaged_cache_is_mended(rules: Ruleset, tmp_path: Path) -> None:
    with building(Building("-O0", tmp_path)):
        compiled_natively(rules)
        starts = sorted(tmp_path.glob("*/*.layout"))  # of the width, and of the width compiled last
        assert len(starts) == 2
        whole = starts[0].read_bytes()
        for damage in (whole[:40], b"", whole.replace(b"layout", b"lay-by"), b"\xff"):
            for start in starts:
                start.write_bytes(damage)
            assert powderdsl.compile(rules).running == "wasm"
            compiled_natively(rules)
            assert [start.read_bytes() for start in starts] == [whole, whole]
            assert powderdsl.compile(rules).running == "native"


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_forks_run_native_code_too(rules: Ruleset, tmp_path: Path) -> None:
    """With its parent's memory, but without its threads: a fork starts its own, and does not wait for a build that
    nobody does any more."""
    program = """\
import os, sys, time
from pathlib import Path
from powderdsl.simulation import native
from powderdsl.simulation.simulator import compile
from powderdsl.targets.cpp.build import Building, building
from tests.semantics.texts import load_text

native.WORTH = 0.0
with building(Building('-O0', Path(sys.argv[1]))):
    auto = compile(load_text(sys.argv[2], 'kettle.yaml'), threads=2)
    old = auto.step(auto.step(auto.world([[[0, 1]] * 3] * 33), 2), 2)   # begins to compile
    print(auto.running, flush=True)
    pid = os.fork()
    while auto.running == 'wasm':
        old = auto.step(old)
        time.sleep(0.05)
    if pid == 0:
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
    old = auto.step(old)   # with threads
    pid = os.fork()
    new = auto.step(old, 3).ids.sum()
    if pid == 0:
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
    print(auto.running)
"""
    command = [sys.executable, "-W", "ignore", "-c", program, str(tmp_path), RULES]
    environment = environment_with(OMP_NUM_THREADS="1")
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert (run.returncode, run.stdout) == (0, "wasm\nnative\n"), run.stderr


def test_run_says_what_ran_and_why(tmp_path: Path) -> None:
    run = ("run", "life", "--size", "8x8", "--steps", "4", "-v", "--out", tmp_path / "x.npz")
    quick = command(*run, CXX="no-such", exits=0)
    assert "wasm on cpu" in quick.stderr
    assert "  wasm: native code takes torch and more work, or --backend native" in quick.stderr
    native = command(*run, "--backend", "native", CXX="no-such", exits=2)
    assert "PD701" in native.stderr
    assert "pip install powderdsl[native]" in native.stderr
    note = plain_warning(NoCompilerWarning("no C++ compiler"), NoCompilerWarning, "auto.py", 1)
    assert note == "note: no C++ compiler\n"
