"""Peak memory of a piece of work, and how it was found."""

from __future__ import annotations

import ctypes
import gc
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PEAK = "highest resident size of the process during the first calls, less that just before them"
MONOTONE = "growth of the process' highest resident size so far: 0 where earlier work took more"
ALLOCATED = "torch.cuda.max_memory_allocated during the first calls, less what was allocated before"
UNKNOWN = "not measured on this system"


@dataclass(frozen=True)
class Memory:
    """Bytes, or None where the system does not say, and how they were found."""

    growth: int | None
    how: str


def peak_growth(work: Callable[[], None], device: str) -> Memory:
    """Do some work; how far memory rose over what was in use before.

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
    import sys

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
