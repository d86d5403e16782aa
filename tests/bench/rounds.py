"""Programs that step the same worlds, timed in turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

Maker = Callable[[], Callable[[int], object]]
"""Loads worlds, and returns what runs a number of steps of them."""


def microseconds(
    makers: Mapping[str, Maker], worlds: int, steps: int | Mapping[str, int], rounds: int
) -> dict[str, float]:
    """Processor time of a step of one world: medians of some rounds, in which all run one after the other.

    `steps`: of a call, by program where they differ. What prepares a call is not timed.
    """
    found: dict[str, list[float]] = {name: [] for name in makers}
    for number in range(rounds + 1):  # the first round compiles
        for name, make in makers.items():
            run = make()
            count = steps if isinstance(steps, int) else steps[name]
            begun = time.process_time()
            run(count)
            if number:
                found[name].append((time.process_time() - begun) / count / worlds)
    return {name: 1e6 * statistics.median(seconds) for name, seconds in found.items()}
