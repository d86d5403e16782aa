"""The planner: what each target's schedules go through, in order, each stage with the reason for its place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from powderdsl.ir.ops import PassGraph
from powderdsl.schedule.blocks import blocks
from powderdsl.schedule.calm import calm_pass
from powderdsl.schedule.choices import choices
from powderdsl.schedule.draws import cheap_questions, conditions, thresholds
from powderdsl.schedule.flatten import flatten
from powderdsl.schedule.lower import lower
from powderdsl.schedule.moves import moves
from powderdsl.schedule.place import place
from powderdsl.schedule.share import share
from powderdsl.schedule.types import Schedule
from powderdsl.schedule.verify import verify


@dataclass(frozen=True)
class Stage:
    """A change to schedules that keeps what they mean."""

    name: str
    apply: Callable[[Schedule], Schedule]
    about: str


ARRAYS = (
    Stage("thresholds", thresholds, "draws below a parameter, before their planes get variables"),
    Stage("questions", cheap_questions, "guards ask without draws"),
    Stage("share", share, "what several statements need, once; after `questions`, which copy parts of masks"),
    Stage(
        "conditions",
        conditions,
        "where each draw matters; after `share`, so that each has its own users only",
    ),
    Stage("moves", moves, "planes that move together; after `share`, so that their movers are variables"),
    Stage("blocks", blocks, "moving planes in one array"),
    Stage("choices", choices, "choices of floats that change few cells"),
    Stage("flatten", flatten, "one operation a statement; nothing after it makes operations"),
    Stage("place", place, "what is released, and what is overwritten"),
)
"""For targets that carry out one operation over all cells of all worlds before the next."""


def plan(pass_: PassGraph, stages: tuple[Stage, ...]) -> Schedule:
    """The schedule of a pass on bit planes, and of its calm form if it has one. Every stage is verified."""
    schedule = lower(pass_)
    verify(schedule, "lower")
    for stage in stages:
        schedule = stage.apply(schedule)
        verify(schedule, stage.name)
    calm = calm_pass(pass_)
    return schedule if calm is None else replace(schedule, calm=plan(calm, stages))
