"""Whether a universe is lawful: what checking it, proving its claims and running it for a while show."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from operator import ne

from powderdsl.analysis.ledger import ledger
from powderdsl.analysis.proofs import prove
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics.diagnostic import render_text
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.system.random import MASK, mix

WORLDS, SIDE, STEPS, FRAME = 4, 32, 96, 1
"""Worlds that are run, their rows and columns, for how many steps, and the id of what frames them."""
MOST = 0.5
"""The largest share of all cells that one element may take over, unless it had it before."""


@dataclass(frozen=True)
class Findings:
    """What was found out about a universe."""

    remarks: tuple[str, ...]
    """Diagnostics of its rules."""
    proven: int
    unproven: tuple[str, ...]
    """Claims that were proven without running a world, and the others."""
    moved: int
    """Cells whose content changed places in the first step."""
    reacted: int
    """Cells that held another element in the end, beyond what moving explains."""
    largest: tuple[str, float]
    """The element that had most cells in the end, apart from the ground, and its share."""

    @property
    def lines(self) -> list[str]:
        """What was found, in words, a finding a line."""
        name, share = self.largest
        return [
            f"{len(self.remarks) or 'no'} remarks, {self.proven} claims proven",
            f"{self.moved:,} of {WORLDS * SIDE**2:,} cells change in the first step",
            f"{self.reacted:,} cells hold something else after {STEPS} steps",
            f"{name} gained most: it has {share:.1%} of the cells",
            *(f"fault: {fault}" for fault in self.faults),
        ]

    @property
    def faults(self) -> tuple[str, ...]:
        """The filters that the universe does not pass, in words."""
        name, share = self.largest
        told = {
            "nothing moves": not self.moved,
            "nothing reacts": not self.reacted,
            f"{name} takes over {share:.0%} of the world": share > MOST,
        }
        unproven = (f"not proven: {claim}" for claim in self.unproven)
        return (*self.remarks, *unproven, *(fault for fault, holds in told.items() if holds))


def findings(seed: int) -> Findings:
    """Check a universe, prove what it claims, and run worlds of random cells under it.

    Half of the cells hold the element 0 at the start, the others any. Raises CompileError for rules with mistakes, and as `powderdsl.compile` does where no backend is installed.
    """
    rules, remarks = load_with_diagnostics(f"universe:{seed}")
    known = ledger(rules)
    own = [claim for claim in rules.invariants if claim.pack == rules.packs[-1]]
    unproven = [claim for claim in own if prove(claim.claim, rules, known, claim.without) is None]
    sim = compile_rules(rules, backend=starting_backend("cpu"))
    start = sim.world(_start(rules.slots, seed), seed=seed)
    first = sim.step(start)
    end = sim.step(first, STEPS - 1)
    before, after, last = (list(chain(*chain(*world.ids.tolist()))) for world in (start, first, end))
    slots = range(1, rules.slots)
    counts = [[ids.count(element) for element in slots] for ids in (before, last)]
    gains = [max(then - now, 0) for now, then in zip(*counts, strict=True)]
    losses = [max(now - then, 0) for now, then in zip(*counts, strict=True)]
    most = max(slots, key=lambda element: gains[element - 1])
    return Findings(
        tuple(map(render_text, remarks)),
        len(own) - len(unproven),
        tuple(claim.span.text for claim in unproven),
        sum(map(ne, before, after)),
        max(sum(gains), sum(losses)),
        (rules.elements[most].name, counts[1][most - 1] / len(before)),
    )


def _start(slots: int, seed: int) -> list[list[list[int]]]:
    """Worlds of random cells, of which half hold the element 0, in frames."""

    def cell(*at: int) -> int:
        number = mix(mix(at[0] << 16 | at[1] << 8 | at[2]) + seed & MASK) % (2 * slots)
        return FRAME if {0, SIDE - 1} & {*at[1:]} else number if number < slots else 0

    return [
        [[cell(world, row, column) for column in range(SIDE)] for row in range(SIDE)]
        for world in range(WORLDS)
    ]
