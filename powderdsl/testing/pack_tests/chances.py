"""Chances that tests of packs claim, held against counts: many copies of a world, each with luck of its own.

A count is judged by Chernoff's bound, which needs no table and holds for any number of trials: that n trials of a
chance p come out at a share q or farther away has a probability of at most exp(−n·D(q‖p)) on each side, where D is the
divergence of the two. A correct rule fails with a probability below `ERROR_RATE`; the seeds are fixed, so that a test
which passes once passes always.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, log, prod
from typing import TYPE_CHECKING

from powderdsl.model import reference
from powderdsl.model.text import one_line
from powderdsl.model.types import Expr, Often

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

ERROR_RATE = 1e-6
"""How likely a correct chance fails a test, at most; and how likely one passes that is off by `OFF`."""

OFF = 0.25
"""How far a chance may be off, as a part of itself or of what it lacks to 100 %, before it is sure to be noticed."""

MOST = 1 << 25
"""Cells times steps that a test may cost. A chance that would need more is tested less sharply."""

CHUNK = 1 << 19
"""Cells that run at once."""


def divergence(share: float, chance: float) -> float:
    """The Kullback-Leibler divergence D(share‖chance) of two chances, in nats for each trial."""
    total = 0.0
    for a, b in ((share, chance), (1 - share, 1 - chance)):
        if a > 0:
            if b <= 0:
                return float("inf")
            total += a * log(a / b)
    return total


def is_unlikely(hits: int, trials: int, chance: float) -> bool:
    """True if chance alone gives a count like this, or one farther off, less than once in 1 / ERROR_RATE times."""
    return trials * divergence(hits / trials, chance) > log(2 / ERROR_RATE)


def trials_for(chance: float) -> int:
    """The number of trials that tell a chance from one that is off by OFF, in either direction, with ERROR_RATE both ways."""
    small = min(chance, 1 - chance)
    if small <= 0:
        return 1 << 16
    needed = []
    for other in (chance + OFF * small, chance - OFF * small):
        hits, misses = log(chance / other), log((1 - chance) / (1 - other))
        middle = misses / (misses - hits)  # the share that is equally unlike both
        needed.append(ceil(log(2 / ERROR_RATE) / divergence(middle, chance)))
    return max(needed)


def chance_problem(start: World, steps: int, claims: Sequence[Often], seed: int) -> str:
    """A sentence about the first claim that counts contradict, or nothing.

    Args:
        start: one world.
        seed: of all copies; each has an index of its own.
    """
    chosen = [
        (claim, reference.evaluate(claim.before, world_context(start, claim.before))[0]) for claim in claims
    ]
    for claim, cells in chosen:
        if not cells.any():
            return f"no cell of the start world is as `{one_line(claim.span)}` says"
    cells_of_one = prod(start.shape)
    most = max(1, MOST // (cells_of_one * max(steps, 1)))
    copies = min(most, max(ceil(trials_for(float(c.chance)) / int(cells.sum())) for c, cells in chosen))
    hits = [0] * len(chosen)
    chunk, put = max(1, CHUNK // cells_of_one), start.sim.kind.put
    for first in range(0, copies, chunk):
        index = [*range(first, min(first + chunk, copies))]  # by which each copy has luck of its own
        world = start.select(put([0] * len(index), "int64"))
        world = replace(world, index=put(index, "int64"), seed=put([seed] * len(index), "int64"))
        world = world.sim.step(world, steps=steps)
        at = world_context(world, *(claim.after for claim in claims))
        for number, (claim, cells) in enumerate(chosen):
            hits[number] += int(reference.evaluate(claim.after, at)[:, cells].sum())
    for (claim, cells), hits_of_claim in zip(chosen, hits, strict=True):
        trials = copies * int(cells.sum())
        if is_unlikely(hits_of_claim, trials, float(claim.chance)):
            return (
                f"`{one_line(claim.span)}` came true {hits_of_claim:,} times in {trials:,}, {100 * hits_of_claim / trials:.3g} %,"
                f" not {100 * float(claim.chance):g} %: luck does that less than once in a million times"
            )
    return ""


def world_context(world: World, *conditions: Expr) -> reference.Context:
    """The values that some conditions read: a world's state as the oracle holds it, parameters, the clock."""
    ruleset, to_numpy = world.sim.ruleset, world.sim.kind.to_numpy
    read = {
        part.value
        for condition in conditions
        for part in condition.walk()
        if part.op in ("field", "property")
    }
    names = [name for name in world.state if name == "element" or name in read]
    state = reference.widen(ruleset, {name: to_numpy(world.state[name]) for name in names})
    clock = reference.Clock(to_numpy(world.seed), to_numpy(world.index), to_numpy(world.step))
    return reference.Context(ruleset, state, reference.parameters(ruleset, len(world), {}), {}, clock)
