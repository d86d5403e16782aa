"""Where figures were measured: what a reader must know to compare them."""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass
from pathlib import Path

BUSY = 0.5
"""Runnable processes a CPU from which others are in the way."""


@dataclass(frozen=True)
class Machine:
    """The machine and the versions of what ran on it. `load` is the load average of the minute before."""

    system: str
    processor: str
    cpus: int
    device: str
    python: str
    torch: str
    compiler: str
    powderdsl: str
    load: float | None

    @property
    def busy(self) -> bool:
        """Whether others were at work before we began."""
        return self.load is not None and self.load > BUSY * self.cpus


def this_machine(device: str) -> Machine:
    """The machine as it is now, and a torch device's name. Raises CompileError (PD701) without such a device."""
    import torch

    from powderdsl.simulation.programs import find_device

    kind = find_device(device)
    return Machine(
        system=f"{platform.system()} {platform.machine()}",
        processor=_processor(),
        cpus=_cpus(),
        device=torch.cuda.get_device_name(kind) if kind.type == "cuda" else device,
        python=platform.python_version(),
        torch=str(torch.__version__),
        compiler=_compiler(),
        powderdsl=sys.modules["powderdsl"].__version__,
        load=load_average(),
    )


def load_average() -> float | None:
    """Runnable processes in the last minute, None where the system does not say."""
    try:
        return os.getloadavg()[0]
    except (OSError, AttributeError):
        return None


def _cpus() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _compiler() -> str:
    from powderdsl.targets.cpp.compilers import NoCompiler, find_compiler

    try:
        return find_compiler().version
    except NoCompiler:
        return "none"
