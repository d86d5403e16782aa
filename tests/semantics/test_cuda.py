"""The cuda backend: its kernels run on the CPU, by fibers, and give the oracle's worlds; on a GPU they do so for real."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

import powderdsl
from powderdsl.compiler import load, lower, shipped_tests, shipped_variants
from powderdsl.ir.bits import segments
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.targets.cuda.source import KernelSource, cuda_source
from tests.fuzz.compare import assert_same_worlds
from tests.fuzz.cuda_emulation import EmulatedSimulator
from tests.fuzz.rulemaker import random_ruleset
from tests.refusals import refusal
from tests.tiers import tiered

RULESETS = sorted(set(shipped_tests()) - shipped_variants())
H200 = 232_448
"""Bytes of shared memory that a block may have there."""

SIZES = [(3, 4, 5), (2, 3, 64), (2, 9, 70)]
"""Worlds of which several share a block, words that end early, rows of two words and of three."""

SEEDS = (3, 4, 43, 55, *range(60, 93))
"""Random rulesets: the first have floats, movements by several masks, and offsets as large as the grid."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels, for all tests of this file."""
    return tmp_path_factory.mktemp("kernels")


def kernels(ruleset: Ruleset, height: int, width: int, shared: int = H200) -> list[KernelSource]:
    found = segments(lower(ruleset))
    return [cuda_source(one.planes, height, width, shared) for one in found if one.planes is not None]


@pytest.mark.parametrize("name", tiered(RULESETS, ["life", "wireworld"]))
def test_emulated_kernels_give_the_same_worlds(name: str, folder: Path) -> None:
    """Whichever thread comes first: what lies between two barriers does not depend on it."""
    ruleset = load(name)
    emulated = [EmulatedSimulator(ruleset, folder, order) for order in (0, 1)]
    assert_same_worlds([compile_ruleset(ruleset, backend="reference"), *emulated], SIZES, 3)


@pytest.mark.parametrize("seed", tiered(SEEDS, SEEDS[:1]))
def test_random_rulesets(seed: int, folder: Path) -> None:
    """On the chip, with fields outside, and with everything outside."""
    ruleset = random_ruleset(seed)
    if ruleset is None:
        return
    shape = (3, 2, 37)
    source = kernels(ruleset, *shape[1:])[0]
    assert source.scratch == 0
    limits = (H200, source.shared - 4, 300)
    emulated = [EmulatedSimulator(ruleset, folder, n % 2, limit) for n, limit in enumerate(limits)]
    assert_same_worlds([compile_ruleset(ruleset, backend="reference"), *emulated], [shape], 2)


def test_worlds_with_more_words_than_threads_can_hold(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then nothing is held back in registers: planes that neighbors read are never written in place."""
    monkeypatch.setattr("powderdsl.targets.cuda.source.HELD", 0)
    ruleset = load("core+sand+water")
    simulators = [compile_ruleset(ruleset, backend="reference"), EmulatedSimulator(ruleset, folder)]
    assert_same_worlds(simulators, [(2, 9, 40)], 3)
    assert " o_p" in (text := kernels(ruleset, 9, 40)[0].text)
    assert "[ROUNDS]" not in text


@pytest.mark.slow
def test_what_does_not_fit_leaves_the_chip() -> None:
    """Fields first, then planes; a block never takes more shared memory than it may."""
    ruleset = load("powderworld")
    for shared, side in ((H200, 64), (H200, 256), (1 << 10, 64)):
        (source,) = kernels(ruleset, side, side, shared)
        assert source.shared <= shared
        assert (source.scratch == 0) == ((shared, side) == (H200, 64))
    assert kernels(load("life"), 8, 8)[0].group == 8


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_without_a_gpu_it_is_refused(device: str, torch) -> None:  # type: ignore[no-untyped-def]
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    found = refusal(powderdsl.compile, "life", backend="cuda", device=device)
    assert found[0].code == "PD701"
    assert found[0].helps


@pytest.mark.cuda
@pytest.mark.parametrize("name", tiered(["margolus", "powderworld"], ["margolus"]))
def test_kernels_compile_for_a_gpu(name: str, tmp_path: Path) -> None:
    compiler = shutil.which("nvcc")
    if compiler is None:
        pytest.skip("nvcc not found")
    for source in kernels(load(name), 64, 64):
        unit = tmp_path / "kernel.cu"
        unit.write_text(source.text, encoding="utf-8")
        options = ["-arch=sm_90", "-std=c++17", "-fmad=false", "-w", "-cubin", "-o"]
        command = [compiler, *options, f"{unit}.cubin", str(unit)]
        run = subprocess.run(command, capture_output=True, text=True, timeout=600)
        assert run.returncode == 0, run.stderr[:2000]


# On a GPU


@pytest.fixture
def gpu(torch) -> str:  # type: ignore[no-untyped-def]
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return "cuda"


@pytest.mark.cuda
@pytest.mark.parametrize("name", RULESETS)
def test_same_worlds_on_a_gpu(name: str, gpu: str) -> None:
    """Small worlds against the oracle, large ones, for which it takes minutes, against `wasm`."""
    ruleset = load(name)
    oracle, wasm = (compile_ruleset(ruleset, backend=backend) for backend in ("reference", "wasm"))
    on_gpu = [compile_ruleset(ruleset, backend=backend, device=gpu) for backend in ("cuda", "torch")]
    assert_same_worlds([oracle, *on_gpu], SIZES, 4)
    assert_same_worlds([wasm, *on_gpu], [(5, 64, 64), (1, 130, 200)], 4)


@pytest.mark.cuda
@pytest.mark.parametrize("seed", range(0, 200, 8))
def test_random_rulesets_on_a_gpu(seed: int, gpu: str) -> None:
    ruleset = random_ruleset(seed)
    if ruleset is None:
        return
    on_gpu = compile_ruleset(ruleset, backend="cuda", device=gpu)
    assert_same_worlds([compile_ruleset(ruleset, backend="reference"), on_gpu], [(3, 2, 5), (2, 3, 65)], 2)


@pytest.mark.cuda
def test_thousands_of_worlds_and_steps_on_a_gpu(gpu: str, torch) -> None:  # type: ignore[no-untyped-def]
    """A thousand steps in one launch, on every multiprocessor; `torch` on the same device is the other side."""
    ruleset = load("powderworld")
    ids = torch.tensor([element.id for element in ruleset.elements])
    start = ids[torch.randint(len(ids), (600, 64, 64), generator=torch.Generator().manual_seed(3))]
    kernel = compile_ruleset(ruleset, backend="cuda", device=gpu)
    plain = compile_ruleset(ruleset, backend="torch", device=gpu)
    after = kernel.step(kernel.world(start, seed=4), 1000)
    expected = plain.step(plain.world(start, seed=4), 1000)
    for slot in kernel.slots:
        assert torch.equal(after.state[slot.name], expected.state[slot.name]), slot.name
    assert torch.equal(after.ids, kernel.step(kernel.step(kernel.world(start, seed=4), 300), 700).ids)
