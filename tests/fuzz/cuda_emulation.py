"""Generated kernels on the CPU: fibers stand for threads, so their meaning and their barriers are tested without a GPU."""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
import tempfile
from pathlib import Path

from powderdsl.compiler import lower
from powderdsl.ir.bits import segments
from powderdsl.model.types import Ruleset
from powderdsl.simulation.programs import BackendProgram
from powderdsl.simulation.simulator import Simulator
from powderdsl.targets.cpp.build import find_compiler
from powderdsl.targets.cuda.program import Compile, CudaProgram, Launch, Worlds
from powderdsl.targets.cuda.source import KernelSource
from powderdsl.targets.torch.program import packed_program
from tests.fuzz import EMULATED

FLAGS = ("-std=c++17", "-O0", "-ffp-contract=off", "-fno-strict-aliasing", "-shared", "-fPIC", "-w")


def emulated_text(text: str) -> str:
    """A kernel's source between what stands in for a GPU."""
    folder = Path(__file__).parent
    before = (folder / "cuda_emulation.hpp").read_text(encoding="utf-8")
    after = (folder / "cuda_fibers.hpp").read_text(encoding="utf-8")
    return "\n".join([before, text, after])


def compiler_for(folder: Path, order: int) -> Compile:
    """Makes kernels that run on the CPU; `order` 0 or 1: which fiber runs first. Raises NoCompiler."""

    def compile(source: KernelSource) -> Launch:
        text = emulated_text(source.text)
        target = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.so"
        if not target.is_file():
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                unit, library = Path(scratch) / "kernel.cpp", Path(scratch) / "kernel.so"
                unit.write_text(text, encoding="utf-8")
                command = [*find_compiler().command, *FLAGS, "-o", str(library), str(unit)]
                subprocess.run(command, check=True, timeout=600)
                os.replace(library, target)
        emulate = ctypes.CDLL(str(target)).emulate

        def launch(worlds: Worlds, blocks: int) -> None:
            if emulate(ctypes.byref(worlds), blocks, order):
                raise AssertionError("some threads wait at a barrier that others never reach")

        return launch

    return compile


class EmulatedSimulator(Simulator):
    """A simulator whose steps run the generated kernels on the CPU.

    Args:
        folder: for compiled kernels.
        order: 0 or 1: which of the fibers between two barriers runs first.
        shared_limit: bytes of shared memory that a block may have.
    """

    def __init__(self, ruleset: Ruleset, folder: Path, order: int = 0, shared_limit: int = 232_448):
        super().__init__(ruleset, "reference", "cpu")
        self.backend = EMULATED
        compile = compiler_for(folder, order)
        program = packed_program(
            segments(lower(ruleset)),
            self.device,
            lambda cells, planes: CudaProgram(cells, planes, compile, shared_limit),
        )
        self._program = BackendProgram(EMULATED, program)
