"""The planner: the stages of each target in order, each with the reason for its position."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from powderdsl.ir.ops import PassGraph, Program
from powderdsl.schedule.costs import Costs, compare_parameters, condition_draws
from powderdsl.schedule.cut import cut
from powderdsl.schedule.floats import inline_floats, lead_comparisons, shift_choices
from powderdsl.schedule.join import guard_regions, join, narrow
from powderdsl.schedule.lifetimes import release, swap_fields
from powderdsl.schedule.lower import lower
from powderdsl.schedule.presence import check_presence
from powderdsl.schedule.types import Schedule, drop_unread
from powderdsl.schedule.words import extract_updates, skip_empty


@dataclass(frozen=True)
class Stage:
    """A transformation of schedules that preserves their meaning. `only` names the targets that have it, if not all do."""

    name: str
    apply: Callable[[Schedule], Schedule]
    about: str
    only: Literal["", "cpu", "cuda"] = ""


_CPU_COSTS, _CUDA_COSTS = Costs(gates=6, floats=2, by_rows=True), Costs(gates=24, floats=2)

# fmt: off
_STAGES = (
    Stage("compare_parameters", compare_parameters, "which draws are compared with a parameter"),
    Stage("inline_floats", inline_floats, "floats are computed where they are used"),
    Stage("shift_choices", shift_choices, "which floats at neighbors follow from a flag; before `cut`, which would store them", "cpu"),
    Stage("lead_comparisons", lead_comparisons, "which comparisons are computed only where another one holds"),
    Stage("condition_draws", condition_draws, "where the result of each draw matters"),
    Stage("check_presence", check_presence,
          "which elements must be present for work to be done; before `cut`, which takes masks apart", "cpu"),
    Stage("cut", partial(cut, costs=_CPU_COSTS),
          "where loops over rows begin and end, and which movements happen in place", "cpu"),
    Stage("cut", partial(cut, costs=_CUDA_COSTS),
          "where loops begin and end; a barrier costs about as much as 24 gates", "cuda"),
    Stage("drop_unread", drop_unread, "variables that nothing reads after `cut` are removed"),
    Stage("extract_updates", extract_updates,
          "which planes change only where a mask holds; before `skip_empty`, which takes loops apart", "cpu"),
    Stage("skip_empty", skip_empty, "which loops over words give nothing because a plane is empty", "cpu"),
    Stage("narrow", narrow, "in which cells a loop has anything to do"),
    Stage("guard_regions", guard_regions, "loops that have nothing to do anywhere are skipped", "cuda"),
    Stage("swap_fields", swap_fields,
          "which fields exchange values in place; after `cut`, which decides by which planes", "cpu"),
    Stage("join", join, "which loops over cells run as one; after `narrow`, which decides what they read", "cpu"),
    Stage("release", release, "when a plane is no longer needed; last, after all reads have their place", "cpu"),
)
# fmt: on

CPU = tuple(stage for stage in _STAGES if stage.only != "cuda")
"""For a thread that processes some worlds side by side, plane by plane, in C++ or WebAssembly."""

CUDA = tuple(stage for stage in _STAGES if stage.only != "cpu")
"""For blocks of threads, each of which holds some worlds in shared memory."""


PLANNERS = {"native": CPU, "wasm": CPU, "cuda": CUDA}
"""The stages of each backend that prints schedules."""


def plan(program: Program, pass_: PassGraph, stages: tuple[Stage, ...]) -> Schedule:
    """The schedule of a pass of a program on bit planes. Tests verify it after each stage."""
    *_, (_, schedule) = steps(program, pass_, stages)
    return schedule


def steps(program: Program, pass_: PassGraph, stages: tuple[Stage, ...]) -> Iterator[tuple[str, Schedule]]:
    """The schedule of a pass after each stage, with the stage's name."""
    schedule = lower(program, pass_)
    yield "lower", schedule
    for stage in stages:
        schedule = stage.apply(schedule)
        yield stage.name, schedule
