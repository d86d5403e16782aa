"""The planner: a first schedule, then the stages of each target in order, each with the reason for its position."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from powderdsl.ir.ops import Graph, Node, PassGraph, Program, SubstepGraph, Type, needed, nodes_of
from powderdsl.schedule.costs import Costs, compare_parameters, condition_draws
from powderdsl.schedule.cut import cut
from powderdsl.schedule.floats import inline_floats, lead_comparisons, shift_choices
from powderdsl.schedule.join import guard_regions, join, narrow
from powderdsl.schedule.lifetimes import release, swap_fields
from powderdsl.schedule.presence import check_presence
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    drop_unread,
    load,
)
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


# The first schedule: one guard per substep, nothing shared between statements


def lower(program: Program, pass_: PassGraph) -> Schedule:
    """The schedule of a pass of a program on bit planes.

    A substep changes nothing if its masks hold nowhere, so a guard contains its writes and keeps the old values.
    Writes without an old value (the first one of a scratch field) are computed unconditionally.
    """
    lowering = _Lowering(pass_)
    for step in pass_.substeps:
        lowering.substep(step)
    lowering.compute(dict(pass_.outputs).values())
    outputs = tuple((slot, lowering.value(node)) for slot, node in pass_.outputs)
    bits = sum(slot.name.startswith("element:") for slot in program.slots)
    inputs, body = tuple(lowering.inputs.items()), tuple(lowering.body)
    return Schedule(pass_.name, inputs, body, outputs, lowering.graph, element_bits=bits)


class _Lowering:
    def __init__(self, pass_: PassGraph):
        self.graph, self.namer = Graph(), Namer()
        self.body: list[Statement] = []
        self.inputs: dict[str, Var] = {}
        self.stored: dict[Node, Var] = {}
        """The variable of each node of the pass that has one."""
        self.current: dict[str, Node] = {}
        """The last node that was written to each slot."""
        self.alive = set(nodes_of(pass_, substeps=False))
        self.outputs = dict(pass_.outputs)
        """Slots of the state that the pass changes; the other slots that it writes are scratch."""

    def substep(self, step: SubstepGraph) -> None:
        guards = [node for node in dict.fromkeys(step.guards) if node.op != "const"]
        always = not guards or any(node.op == "const" and node.attr for node in step.guards)
        free: list[Node] = []
        guarded: dict[Node, Node] = {}
        """By node that is written: the slot's old value."""
        for slot, node in step.writes:
            if node in self.alive and self.missing(node):
                if always or (old := self.old(slot)) is None:
                    free.append(node)
                else:
                    guarded[node] = old
        self.compute([node for node in free if node not in guarded], step.place)
        if guarded:
            self.compute(guards, step.place)
            guarded = {node: old for node, old in guarded.items() if self.missing(node)}  # it may be a mask
        if guarded:
            when = self.graph.node("some", ANSWER, tuple(map(self.value, guards)))
            self.compute(guarded, step.place)
            body = self.body.pop()
            olds = zip(body.vars.values(), guarded.values(), strict=True)
            outs = tuple(Out(var, old, old) for var, old in olds)
            self.body.append(Guard(outs, step.place, when=when, body=(body,)))
        self.current |= dict(step.writes)

    def missing(self, node: Node) -> bool:
        return node not in self.stored and node.op not in ("const", "input")

    def old(self, slot: str) -> Node | None:
        """The value of a slot before a substep, if a variable holds it."""
        if (node := self.current.get(slot)) is None:
            return self.input(slot, self.outputs[slot].type) if slot in self.outputs else None
        return self.value(node) if node in self.alive and not self.missing(node) else None

    def input(self, slot: str, type: Type) -> Node:
        """The value of a slot at the beginning of the pass."""
        if slot not in self.inputs:
            self.inputs[slot] = self.namer.var(type)
        return load(self.graph, self.inputs[slot])

    def compute(self, nodes: Iterable[Node], place: str = "") -> None:
        missing = filter(self.missing, dict.fromkeys(nodes))
        if outs := tuple([Out(self.namer.var(node.type, node), self.value(node)) for node in missing]):
            self.body.append(Compute(outs, place))
        for out in outs:
            assert out.var.means is not None
            self.stored[out.var.means] = out.var

    def below(self, node: Node) -> tuple[Node, ...]:
        return () if node in self.stored else node.args

    def value(self, root: Node) -> Node:
        """A node of the pass in terms of the variables defined so far."""
        done: dict[Node, Node] = {}
        for node, parts in needed([root], self.below).items():
            if node in self.stored:
                done[node] = load(self.graph, self.stored[node])
            elif node.op == "input":
                done[node] = self.input(node.attr, node.type)
            else:
                args = tuple([done[arg] for arg in parts])
                done[node] = self.graph.node(node.op, node.type, args, node.attr)
        return done[root]
