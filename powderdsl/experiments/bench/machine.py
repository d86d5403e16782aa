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
from pathlib import Path
from typing import Any


def this_machine(device: str) -> dict[str, Any]:
    """This machine, the name of a torch device, and the versions of what runs on it.

    `load` is the load average of the minute before. Raises CompileError (PD701) without such a device.
    """
    import torch

    from powderdsl.simulation.programs import find_device
    from powderdsl.targets.cpp.compilers import NoCompiler, find_compiler

    kind = find_device(device)
    try:
        compiler = find_compiler().version
    except NoCompiler:
        compiler = "none"
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "device": torch.cuda.get_device_name(kind) if kind.type == "cuda" else device,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "compiler": compiler,
        "powderdsl": sys.modules["powderdsl"].__version__,
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def peak_growth(work: Callable[[], None], device: str) -> int | None:
    """Do some work; returns by how many bytes the peak of memory exceeded the memory in use before.

    None where the system does not report it. On Linux the process' own peak is reset first. What freed memory still
    belongs to the process is handed back before, so that the work cannot hide in it.
    """
    import torch

    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc only
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    except OSError:
        work()
        return None
    resident = _status("VmRSS")
    work()
    return max(0, _status("VmHWM") - resident)


def _status(name: str) -> int:
    """A line of /proc/self/status in bytes."""
    line = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(line[1]) * 1024 if line else 0
