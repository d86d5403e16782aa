"""Filters for universes: results of checking a universe, proving its claims and running it."""

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
    """The findings about a universe: diagnostics, claims that are proven or not, and what some worlds did.

    `moved` cells change in the first step, and `reacted` hold another element in the end than moving explains. The element
    that gained most is `largest`, with its share of all cells.
    """

    remarks: tuple[str, ...]
    proven: int
    unproven: tuple[str, ...]
    moved: int
    reacted: int
    largest: tuple[str, float]

    @property
    def faults(self) -> list[str]:
        """The filters that the universe fails, in words."""
        name, share = self.largest
        faults = [*self.remarks, *(f"not proven: {claim}" for claim in self.unproven)]
        faults += ["nothing moves"] * (not self.moved) + ["nothing reacts"] * (not self.reacted)
        return faults + [f"{name} takes over {share:.0%} of the world"] * (share > MOST)

    @property
    def lines(self) -> list[str]:
        """All findings in words, one per line."""
        name, share = self.largest
        return [
            f"{len(self.remarks) or 'no'} remarks, {self.proven} claims proven",
            f"{self.moved:,} of {WORLDS * SIDE**2:,} cells change in the first step",
            f"{self.reacted:,} cells hold something else after {STEPS} steps",
            f"{name} gained most: it has {share:.1%} of the cells",
            *(f"fault: {fault}" for fault in self.faults),
        ]


def findings(seed: int) -> Findings:
    """Check a universe, prove what it claims, and run worlds under it of which half of the cells hold the element 0.

    Raises CompileError for rules with mistakes, and as `powderdsl.compile` does where no backend is installed.
    """
    rules, remarks = load_with_diagnostics(f"universe:{seed}")
    known = ledger(rules, needs=False)
    own = [claim for claim in rules.invariants if claim.pack == rules.packs[-1]]
    unproven = [claim.span.text for claim in own if prove(claim.claim, rules, known, claim.without) is None]
    sim = compile_rules(rules, backend=starting_backend("cpu"))
    start = sim.world(_start(rules.slots, seed), seed=seed)
    first = sim.step(start)
    worlds = (start, first, sim.step(first, STEPS - 1))
    before, after, last = (list(chain(*chain(*world.ids.tolist()))) for world in worlds)
    gains = {element: last.count(element.id) - before.count(element.id) for element in rules.elements[1:]}
    reacted = max(sum(gain for gain in gains.values() if gain * sign > 0) * sign for sign in (1, -1))
    most = max(gains, key=lambda element: gains[element])
    share = last.count(most.id) / len(last)
    moved = sum(map(ne, before, after))
    texts = tuple(map(render_text, remarks))
    return Findings(texts, len(own) - len(unproven), tuple(unproven), moved, reacted, (most.name, share))


def _start(slots: int, seed: int) -> list[list[list[int]]]:
    """Worlds of random cells, of which half hold the element 0, in frames."""

    def cell(*at: int) -> int:
        number = mix(mix(at[0] << 16 | at[1] << 8 | at[2]) + seed & MASK) % (2 * slots)
        return FRAME if {0, SIDE - 1} & {*at[1:]} else number if number < slots else 0

    return [
        [[cell(world, row, column) for column in range(SIDE)] for row in range(SIDE)]
        for world in range(WORLDS)
    ]
