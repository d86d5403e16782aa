"""Runs start worlds and keeps what they were after each step, and which lines of rules happened meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from powderdsl.diagnostics import Span
from powderdsl.model import reference
from powderdsl.model.expressions.operands import TRUE
from powderdsl.model.state import slots
from powderdsl.model.types import FLAG, Assign, Field, Moment, Pass, Rule, Ruleset
from powderdsl.simulation.draw import to_numpy
from powderdsl.testing.properties.samples import Array, Sample, State, full_state

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

MARK = "happened "
"""How the flags are called that lines of rules set. No rule file can have a name with a blank."""


class Runner:
    """Runs a ruleset on one backend. `happened` collects the lines of rules that changed or claimed some cell."""

    def __init__(self, ruleset: Ruleset, backend: str = "arrays"):
        self.ruleset = ruleset
        self.backend = backend
        self.lines = rule_spans(ruleset)
        self.happened: set[Span] = set()
        self.worlds_run = 0
        from powderdsl.simulation.simulator import (
            compile,  # brings torch, which `powderdsl check` does without
        )

        self.sim = compile(marked(ruleset), backend=backend)

    def states(self, sample: Sample, steps: int, random: Mapping[str, Array] | None = None) -> list[State]:
        """The state at the start and after each step, in storage dtypes. `random`: draws for all streams."""
        found, end = run_sample(self.sim, sample, steps, random, self.ruleset)
        self.worlds_run += len(sample)
        self.note(end.state)
        return found

    def note(self, state: Mapping[str, Any]) -> None:
        """Remember which lines happened on the way to this state of `sim`."""
        for number, span in enumerate(self.lines):
            if span not in self.happened and bool(state[f"{MARK}{number}"].any()):
                self.happened.add(span)


def run_sample(
    sim: Simulator,
    sample: Sample,
    steps: int,
    random: Mapping[str, Array] | None = None,
    ruleset: Ruleset | None = None,
) -> tuple[list[State], World]:
    """The state at the start and after each step, in storage dtypes, and the world after the last one.

    `ruleset`: whose slots are kept, if the simulator has more.
    """
    start = full_state(ruleset or sim.ruleset, sample)
    world = sim.world(sample.ids, seed=sample.seeds)
    given = {name: world.state[name].new_tensor(values) for name, values in start.items()}
    clock = world.step.new_tensor(sample.clock)
    world = replace(world, state={**world.state, **given}, step=clock)
    found = [start]
    for _ in range(steps):
        world = sim.step(world, random=random, params=dict(sample.params) or None)
        found.append({name: to_numpy(world.state[name]) for name in start})
    return found, world


def reference_states(
    ruleset: Ruleset, sample: Sample, steps: int, random: Mapping[str, Array] | None = None
) -> list[State]:
    """The same from the oracle."""
    found = [full_state(ruleset, sample)]
    for step in range(steps):
        found.append(reference_step(ruleset, found[-1], sample, step, random))
    return found


def reference_step(
    ruleset: Ruleset,
    state: State,
    sample: Sample,
    step: int,
    random: Mapping[str, Array] | None = None,
) -> State:
    """One step of the oracle; `step` counts from the sample's own clock. `ruleset` may have fewer passes."""
    bits = {stream.name: stream.bits for stream in ruleset.streams}
    draws = {  # a draw counts as the one of the stream's resolution that it falls into
        name: (np.floor(values * 2.0 ** bits[name]) + 0.5) / 2.0 ** bits[name]
        for name, values in (random or {}).items()
    }
    return reference.step(ruleset, state, clock(sample, step), parameters(ruleset, sample), draws=draws)


def clock(sample: Sample, step: int) -> reference.Clock:
    return reference.Clock(sample.seeds, np.zeros(len(sample), np.int64), sample.clock + step)


def parameters(ruleset: Ruleset, sample: Sample) -> dict[str, Array]:
    """All parameters, [B] each."""
    return reference.parameters(ruleset, len(sample), sample.params)


def context(ruleset: Ruleset, state: State, sample: Sample, step: int) -> reference.Context:
    """What a condition reads of worlds: their state, parameters, the clock."""
    working = reference.widened(ruleset, {slot.name: state[slot.name] for slot in slots(ruleset)})
    return reference.Context(ruleset, working, parameters(ruleset, sample), {}, clock(sample, step))


# Which lines happen


def rule_spans(ruleset: Ruleset) -> tuple[Span, ...]:
    """The lines of rules, in the order in which they run first. Loops and symmetries make many rules of one."""
    return tuple(
        dict.fromkeys(rule.span for p in ruleset.passes for moment in p.moments for rule in moment.rules)
    )


def marked(ruleset: Ruleset) -> Ruleset:
    """The same rules, each of which also sets a flag of its line where it happens; nothing reads the flags."""
    lines = rule_spans(ruleset)
    names = {span: f"{MARK}{number}" for number, span in enumerate(lines)}
    home = ruleset.elements[0]
    flags = [Field(name, FLAG, 0, "place", False, None, home.pack, home.span) for name in names.values()]
    passes = tuple(_marked_pass(pass_, names) for pass_ in ruleset.passes)
    return replace(ruleset, fields=(*ruleset.fields, *flags), passes=passes)


def _marked_pass(pass_: Pass, names: Mapping[Span, str]) -> Pass:
    moments: list[Moment] = []
    for moment in pass_.moments:
        rules: list[Rule] = []
        for rule in moment.rules:
            name = names[rule.span]
            if isinstance(rule, Assign):
                rules += [rule, Assign(name, (0, 0), ":=", TRUE, rule.mask, rule.span)]
            else:
                effect = Assign(name, (0, 0), ":=", TRUE, None, rule.span)
                rules.append(replace(rule, effects=(*rule.effects, effect)))
        moments.append(replace(moment, rules=tuple(rules)))
    return replace(pass_, moments=tuple(moments))
