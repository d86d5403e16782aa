"""`powderdsl compile`: print the output of a compiler stage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.compiler import lower, read
from powderdsl.diagnostics import Reporter, with_suggestion
from powderdsl.model.text import print_model, print_tree
from powderdsl.model.types import Ruleset

if TYPE_CHECKING:
    from powderdsl.ir.bits import Segment
    from powderdsl.ir.ops import PassGraph, Program

STAGES = ("tree", "model", "ir", "planes", "schedule", "kernels")


@click.command("compile")
@opt.rules
@opt.option(
    "--emit",
    STAGES,
    "tree: rules as parsed; model: checked, loops unrolled; ir: optimized; planes: on bit planes; "
    "schedule: loops, guards and buffers; kernels: what runs.",
    to="stage",
    required=True,
)
@opt.backend("auto", "Backend whose schedule or kernels are printed.")
@opt.option("--after", "STAGE", "Print the schedule after this stage of the planner.  [default: the last]")
@opt.option("--pass", "NAME", "Print only this pass of the rules.", to="pass_name")
@opt.parameters
def command(
    rules: str, stage: str, backend: str, after: str | None, pass_name: str | None, settings: dict[str, str]
) -> None:
    """Print the output of a compiler stage."""
    if after is not None and stage != "schedule":
        raise BadInput("--after requires --emit schedule")
    if stage == "tree":
        reporter = Reporter()
        packs, _ = read([rules], reporter)
        reporter.raise_if_errors()
        if pass_name is not None:
            _check_known(
                "pass", pass_name, [decl.name.text for pack in packs for decl in pack.passes], "passes"
            )
        text = print_tree(packs, pass_name)
    else:
        text = _checked(opt.load_rules(rules, settings), stage, backend, after, pass_name)
    click.echo(text, nl=not text.endswith("\n"))


def _checked(ruleset: Ruleset, stage: str, backend: str, after: str | None, pass_name: str | None) -> str:
    """The output of a stage after parsing."""
    if pass_name is not None:
        _check_known("pass", pass_name, [pass_.name for pass_ in ruleset.passes], "passes")
    if stage == "model":
        return print_model(ruleset, None if pass_name is None else [pass_name])
    program = lower(ruleset)
    from powderdsl.ir.bits import segments
    from powderdsl.ir.text import print_program

    match stage:
        case "ir":
            return print_program(program, pass_name)
        case "planes":
            parts = [segment.planes or segment.program for segment in segments(program)]
            chosen = [part for part in parts if pass_name in (None, *(p.name for p in part.passes))]
            return "\n".join(print_program(part, pass_name) for part in chosen)
        case "schedule":
            return "\n\n".join(_schedules(segments(program), backend, after, pass_name))
        case _:
            return "\n\n".join(text for text in _kernels(program, backend, pass_name) if text)


def _schedules(
    parts: Sequence[Segment], backend: str, after: str | None, pass_name: str | None
) -> Iterator[str]:
    from powderdsl.schedule.stages import PLANNERS, steps
    from powderdsl.schedule.types import print_schedule

    stages = PLANNERS.get("wasm" if backend == "auto" else backend)
    if stages is None:
        raise BadInput(f"the {backend} backend has no schedule: it computes pass by pass what the IR says")
    names = ["lower", *(stage.name for stage in stages)]
    last = after or names[-1]
    _check_known("stage", last, names, "stages")
    for part in parts:
        if part.planes is None:
            continue
        for pass_ in part.planes.passes:
            if pass_name in (None, pass_.name):
                yield print_schedule(dict(steps(part.planes, pass_, stages))[last])


SHOWN_WIDTH, SHOWN_SHARED = 64, 227 << 10
"""The grid's columns, and the GPU's bytes of shared memory, for which kernels are shown."""


def _kernels(program: Program, backend: str, pass_name: str | None) -> Iterator[str]:
    """The generated source of a backend; in parts if some passes cannot run on bit planes."""
    from powderdsl.ir.bits import segments
    from powderdsl.targets.torch import planes, source

    def shown(part: Program) -> list[tuple[PassGraph, int]]:
        return [(pass_, i) for i, pass_ in enumerate(part.passes) if pass_name in (None, pass_.name)]

    if backend == "reference":
        raise BadInput("the reference backend runs the checked model: it has no kernels")
    if backend in ("native", "cuda") and pass_name is not None:
        raise BadInput(f"{backend} source is one text: --pass cannot be used with it")
    if backend == "torch-cells":
        yield from (source.pass_source(*pass_)[0] for pass_ in shown(program))
        return
    for part in segments(program):
        if part.planes is None:
            yield from (source.pass_source(*pass_)[0] for pass_ in shown(part.program))
        elif backend in ("torch", "torch-fused"):
            yield from (planes.pass_source(part.planes, *pass_).text for pass_ in shown(part.planes))
        elif backend == "native":
            from powderdsl.targets.cpp.source import native_source

            yield native_source(part.planes).passes
        elif backend == "cuda":
            from powderdsl.targets.cuda.source import cuda_source

            yield cuda_source(part.planes, SHOWN_WIDTH, SHOWN_WIDTH, SHOWN_SHARED).text
        else:
            from powderdsl.targets.wasm.source import pass_function_name, wasm_module

            chosen = None if pass_name is None else pass_function_name(pass_name)
            yield wasm_module(part.planes, SHOWN_WIDTH).listing(chosen)


def _check_known(what: str, name: str, known: Sequence[str], plural: str) -> None:
    if name not in known:
        raise BadInput(with_suggestion(f"no {what} `{name}`", name, known, plural))
