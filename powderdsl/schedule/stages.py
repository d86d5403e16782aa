"""The planner: what each target's schedules go through, in order, each stage with the reason for its place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from powderdsl.ir.ops import PassGraph
from powderdsl.schedule.blocks import blocks
from powderdsl.schedule.calm import calm_pass
from powderdsl.schedule.choices import choices
from powderdsl.schedule.costs import Costs
from powderdsl.schedule.cut import cut
from powderdsl.schedule.cut_rows import cut_rows
from powderdsl.schedule.draws import cheap_questions, conditions, thresholds
from powderdsl.schedule.empty import empty
from powderdsl.schedule.flatten import flatten
from powderdsl.schedule.floats import late, led
from powderdsl.schedule.join import join
from powderdsl.schedule.lower import lower
from powderdsl.schedule.moves import moves
from powderdsl.schedule.narrow import ask_regions, narrow
from powderdsl.schedule.place import place
from powderdsl.schedule.presence import presence
from powderdsl.schedule.release import release
from powderdsl.schedule.rewrite import without_unread
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


CUDA = (
    Stage("thresholds", thresholds, "draws below a parameter"),
    Stage("late", late, "floats where they are asked for"),
    Stage("led", led, "comparisons under others"),
    Stage("conditions", conditions, "where each draw matters"),
    Stage("cut", cut(Costs(gates=24, floats=2)), "loops; a barrier costs about as much as 24 gates"),
    Stage("unread", without_unread, "floats that were stored for neighbors who then did not ask"),
    Stage("narrow", narrow, "loops over cells where something happens"),
    Stage("regions", ask_regions, "not even looked for where it happens nowhere"),
)
"""For blocks of threads that share some worlds."""


CPP = (
    Stage("thresholds", thresholds, "draws below a parameter"),
    Stage("late", late, "floats where they are asked for"),
    Stage("led", led, "comparisons under others"),
    Stage("conditions", conditions, "where each draw matters"),
    Stage("presence", presence, "which elements are asked for; before `cut`, which takes masks apart"),
    Stage("cut", cut_rows(Costs(gates=6, floats=2)), "loops over rows, and movements in place"),
    Stage("unread", without_unread, "floats that were stored for neighbors who then did not ask"),
    Stage("empty", empty, "loops over words that find nothing"),
    Stage("narrow", narrow, "loops over cells where something happens"),
    Stage("join", join, "loops over cells that follow each other; they must know what they read"),
    Stage("release", release, "what is not needed any more, after everything that reads it has its place"),
)
"""For a thread that works on eight worlds side by side, plane by plane."""


def plan(pass_: PassGraph, stages: tuple[Stage, ...]) -> Schedule:
    """The schedule of a pass on bit planes, and of its calm form if it has one.

    Only the last schedule is verified here: verifying every one takes as long as making them. Tests do.
    """
    *_, (_, schedule) = steps(pass_, stages)
    verify(schedule, stages[-1].name)
    calm = calm_pass(pass_) if stages is ARRAYS else None
    return schedule if calm is None else replace(schedule, calm=plan(calm, stages))


def steps(pass_: PassGraph, stages: tuple[Stage, ...]) -> Iterator[tuple[str, Schedule]]:
    """The schedule of a pass after each stage, with the stage's name."""
    schedule = lower(pass_)
    yield "lower", schedule
    for stage in stages:
        schedule = stage.apply(schedule)
        yield stage.name, schedule
