"""The stages between lowering and targets: an ordered list, a reason for each place, the verifier in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from powderdsl.ir.ops import PassGraph, Program
from powderdsl.ir.rewrite import Rules, rewrite_pass
from powderdsl.ir.stages.fold import FOLD
from powderdsl.ir.stages.prune import prune
from powderdsl.ir.stages.resolve import RESOLVE, specialise
from powderdsl.ir.stages.share import SHARE
from powderdsl.ir.verify import verify


@dataclass(frozen=True)
class Stage:
    """A stage of the compiler: its name, one line of help, and what it does to one pass of a program."""

    name: str
    about: str
    run: Callable[[PassGraph], PassGraph]


def _rewriting(*parts: Rules) -> Callable[[PassGraph], PassGraph]:
    rules = Rules(*parts)
    return lambda graph: rewrite_pass(graph, rules)


PIPELINE: tuple[Stage, ...] = (
    Stage("fold", "folds constants and flags that are always equal", _rewriting(FOLD)),
    # Before sharing: what a neighbor's property decides becomes a question about its element.
    Stage("specialise", "replaces the properties of a cell whose element is known", specialise),
    Stage("resolve", "turns tests of properties into tests of the element", _rewriting(RESOLVE, FOLD)),
    # After resolving: only now is it clear which neighbors are read.
    Stage("share", "reads each value of a neighbor once", _rewriting(SHARE, FOLD)),
    # Last: substeps whose rules have turned out never to fire no longer write anything.
    Stage("prune", "removes substeps that change nothing", prune),
)


def run_passes(program: Program, until: str | None = None) -> Program:
    """The optimized program; `until` names the last stage to run. The IR is verified after every stage."""
    verify(program, "lower")
    for stage in PIPELINE:
        program = replace(program, passes=tuple(stage.run(graph) for graph in program.passes))
        verify(program, stage.name)
        if stage.name == until:
            break
    return program
