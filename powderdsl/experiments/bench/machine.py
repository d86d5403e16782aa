"""The machine of a measurement, which a reader must know to compare results, and peak memory."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

BUSY = 0.5
"""Runnable processes per CPU above which other processes disturb a measurement."""


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
        """Whether other processes were running before the measurement."""
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
    """The load average of the last minute; None where the system does not report it."""
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


# Memory

PEAK = "highest resident size of the process during the first calls, less that just before them"
MONOTONE = "growth of the process' highest resident size so far: 0 where earlier work took more"
ALLOCATED = "torch.cuda.max_memory_allocated during the first calls, less what was allocated before"
UNKNOWN = "not measured on this system"


@dataclass(frozen=True)
class Memory:
    """Bytes, or None where the system does not report them, and how they were measured."""

    growth: int | None
    how: str


def peak_growth(work: Callable[[], None], device: str) -> Memory:
    """Do some work; returns by how much the peak of memory exceeded the memory in use before.

    On Linux the process' own peak is reset first. What freed memory still belongs to the process is handed back
    before, so that the work cannot hide in it.
    """
    import torch

    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        work()
        torch.cuda.synchronize(device)
        return Memory(torch.cuda.max_memory_allocated(device) - before, ALLOCATED)
    gc.collect()
    _hand_back()
    if _reset_peak():
        resident = _status("VmRSS")
        work()
        return Memory(max(0, _status("VmHWM") - resident), PEAK)
    so_far = _peak_so_far()
    work()
    now = _peak_so_far()
    return Memory(None, UNKNOWN) if so_far is None or now is None else Memory(now - so_far, MONOTONE)


def _hand_back() -> None:
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc only


def _reset_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _status(name: str) -> int:
    """A line of /proc/self/status in bytes."""
    found = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def _peak_so_far() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
