"""The start worlds of tasks: each seed's, whichever variant of a split it comes from. They need no torch."""

from __future__ import annotations

from collections.abc import Mapping

from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.tasks.task import Task
from powderdsl.tasks.tensors.generator import Made, WorldMaker, joined


class StartWorlds:
    """A task's split made executable for one kind of arrays."""

    def __init__(self, task: Task, split: str, kind: ArrayKind):
        self.kind = kind
        self._makers = [WorldMaker(one, task.size, kind) for one in task.split(split).variants]
        cells = [maker.fixed_cells for maker in self._makers]
        self.fixed: Mapping[str, Array] = {
            name: value
            for name, value in cells[0].items()
            if all(name in one and bool((value == one[name]).all()) for one in cells)
        }
        """Regions that are the same in all worlds of the split, bool [1, H, W]."""

    def make(self, seeds: Array) -> Made:
        """The start worlds of seeds, int64 [B]; where the split has several variants, each world comes from its own."""
        if len(self._makers) == 1:
            return self._makers[0].make(seeds)
        variant = seeds % len(self._makers)
        variants = variant.tolist()
        numbers = sorted(set(variants)) or [0]
        parts = [self._makers[number].make(seeds[variant == number]) for number in numbers]
        made = joined(self.kind, parts, self.fixed)
        # Back from the order of variants to that of the seeds.
        places = [0] * len(variants)
        for place, world in enumerate(sorted(range(len(variants)), key=variants.__getitem__)):
            places[world] = place
        order = self.kind.put(places, "int64")
        regions = {name: one if name in self.fixed else one[order] for name, one in made.regions.items()}
        return Made(made.ids[order], regions, {name: one[order] for name, one in made.targets.items()})
