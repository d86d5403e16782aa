"""Modules for rules: what they promise to hosts, in wasmtime and in V8."""

from __future__ import annotations

import gzip
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import wasmtime

import powderdsl
from powderdsl.compiler import lower
from powderdsl.ir.bits import segments
from powderdsl.system.cache import Memo
from powderdsl.targets.tensor_kind import Tensors
from powderdsl.targets.wasm import program, source
from powderdsl.targets.wasm.binary import Module
from powderdsl.targets.wasm.program import Instance, WasmProgram, WasmState
from powderdsl.targets.wasm.source import wasm_module
from tests.fuzz.rulemaker import random_ruleset_text


def module_of(name: str, width: int) -> Module:
    (segment,) = segments(lower(powderdsl.load(name)))
    assert segment.planes is not None
    return wasm_module(segment.planes, width)


def test_the_module_of_powderworld_is_small() -> None:
    code = module_of("powderworld", 64).code
    assert len(code) <= 150_000
    assert len(gzip.compress(code)) <= 50_000


@pytest.mark.slow
def test_branches_use_the_variables_of_others_again(tmp_path: Path) -> None:
    """A loop here has some 90,000 values, nearly all of them in branches; engines allow 50,000 variables."""
    rules = tmp_path / "long.yaml"
    rules.write_text(random_ruleset_text(4017), encoding="utf-8")
    wasmtime.Module.validate(wasmtime.Engine(), module_of(str(rules), 64).code)


def packed(world: Any) -> tuple[Instance, int]:
    state = world.state
    assert isinstance(state, WasmState)
    return state.instance, state.handle


def test_the_same_rules_are_compiled_once_for_a_width_and_once_for_narrow_grids(
    monkeypatch: pytest.MonkeyPatch, torch
) -> None:  # type: ignore[no-untyped-def]
    made: list[int | None] = []
    original = source.wasm_module
    monkeypatch.setattr(
        source, "wasm_module", lambda *given, **more: made.append(given[1]) or original(*given, **more)
    )
    monkeypatch.setattr(program, "persistent", lambda name, inputs, make: make())
    monkeypatch.setattr(program, "_MODULES", Memo(versions=1, things=64))
    for chance in ("20%", "20%", "30%"):
        ruleset = powderdsl.load("core+sand+water", params={"water.melt": chance})
        sim = powderdsl.compile(ruleset, backend="wasm")
        for width in (5, 70, 32, 9, 63):
            sim.step(sim.world(torch.zeros((1, 4, width), dtype=torch.int64)))
    assert made == [None, 70, 32]  # parameters are inputs
    sim = powderdsl.compile("core+water", backend="wasm")
    sim.step(sim.world(torch.zeros((1, 4, 5), dtype=torch.int64)))
    assert made == [None, 70, 32, None]


def test_memory_is_used_again(torch) -> None:  # type: ignore[no-untyped-def]
    sim = powderdsl.compile("powderworld", backend="wasm")
    ids = torch.randint(0, 14, (3, 20, 64), generator=torch.Generator().manual_seed(1))
    world = sim.step(sim.step(sim.world(ids, seed=3), 60))  # the second call copies the worlds of the first
    instance, _ = packed(world)
    before = instance.call("scratch", 0), instance.running.memory_size()
    for _ in range(60):
        world = sim.step(world)
    assert (instance.call("scratch", 0), instance.running.memory_size()) == before


def test_a_full_memory_is_followed_by_another(monkeypatch: pytest.MonkeyPatch, torch) -> None:  # type: ignore[no-untyped-def]
    """Worlds that a user keeps stay readable, and later ones come into another instance."""
    monkeypatch.setattr(program, "ROOM", 1 << 17)
    ruleset = powderdsl.load("core+water+sand")
    sims = [powderdsl.compile(ruleset, backend=name) for name in ("wasm", "torch")]
    ids = torch.randint(0, 4, (9, 40, 64), generator=torch.Generator().manual_seed(1))
    kept = []
    for sim in sims:
        worlds = [sim.world(ids, seed=3)]
        for number in range(12):
            worlds.append(sim.step(worlds[-1]))
            if number % 4 == 3:
                worlds.append(sim.step(sim.replace(worlds.pop(), ids=ids), reuse=True))
        kept.append(worlds)
    assert len({id(world.state.instance) for world in kept[0][1:]}) > 1
    for one, other in zip(*kept, strict=True):
        assert torch.equal(one.ids, other.ids)


LIMITED = """
import resource
from powderdsl.arrays import np
from powderdsl.simulation.simulator import compile

resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
for name in ("life", "core+sand"):
    sim = compile(name, "wasm", tensors=False)
    print(int(sim.step(sim.world(np.ones((2, 8, 64), np.uint8)), 3).ids.sum()))
"""


def test_few_addresses_are_enough() -> None:
    """Under `ulimit -v`, where wasmtime cannot reserve 4 GiB for a memory."""
    done = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["0", "1024"]


def test_too_many_worlds_are_refused(torch) -> None:  # type: ignore[no-untyped-def]
    instance = WasmProgram(*_programs("life"), Tensors()).instance(2, 64, 64)
    for worlds, rows in ((1 << 31, 64), (1 << 25, 64), (2, 1 << 30)):
        with pytest.raises(MemoryError):
            instance.call("allocate", worlds, rows, 64)
    with pytest.raises(MemoryError):
        instance.call("scratch", (1 << 32) - 1)
    batch = instance.call("allocate", 2, 64, 64)  # smaller ones still fit
    instance.call("run", batch, 3)


def _programs(name: str) -> tuple[Any, Any]:
    (segment,) = segments(lower(powderdsl.load(name)))
    return segment.program, segment.planes


ENDING = """
import atexit
from wasmtime import _ffi

FREE = ("wasmtime_module_delete", "wasmtime_store_delete", "wasm_engine_delete")

def take_apart():
    for name in FREE:
        getattr(_ffi, name)
        setattr(_ffi, name, None)

atexit.register(take_apart)  # what is registered first runs last
from powderdsl.targets.wasm.wasmtime_host import WasmtimeModule

module = WasmtimeModule(bytes.fromhex("0061736d01000000" "0503010001" "070a01066d656d6f72790200"))  # exports a memory
running = module()
assert running.memory_size() == 1 << 16
"""


def test_nothing_is_freed_after_python_has_taken_wasmtime_apart() -> None:
    run = subprocess.run(
        [sys.executable, "-c", ENDING], capture_output=True, text=True, timeout=120, check=False
    )
    assert (run.returncode, run.stderr) == (0, "")
