"""Loops over floats run together row by row, and swaps exchange floats in place if no cell belongs to two of them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from powderdsl.compiler import load
from powderdsl.ir.ops import REAL, InvalidIR
from powderdsl.schedule.stages import CPU, plan
from powderdsl.schedule.types import Compute, Move, Schedule, Sweeps, field_reads, flat
from powderdsl.testing.generators.cases import load_text
from tests.schedule.test_stages import packed_passes, run_stages
from tests.schedule.verify import verify


def planned(name: str) -> Schedule:
    """The pass of that name in powderworld, as native code runs it."""
    ((part, found),) = (pair for pair in packed_passes(load("powderworld")) if pair[1].name == name)
    return plan(part.planes, found, CPU)


def test_box_sums_follow_choices() -> None:
    *_, last = (one for one in flat(planned("wind").body) if isinstance(one, Sweeps))
    # Damped choices; sums of three columns; sums of three rows of these.
    assert [loop.over for loop in last.loops] == ["choices", "cells", "cells"]
    assert [(loop.part, loop.lag) for loop in last.body] == [(0, 0), (0, 1), (0, 2)]
    written = [out.var.name for loop in last.loops for out in loop.outs]
    assert last.frees == tuple(written[:4])
    # Two rows behind, the result takes the place of what the choices read up to a row below and above.
    read = {read.name for read in field_reads(last.loops[0])}
    assert {out.into for out in last.loops[2].outs} == read
    assert not any(out.into for loop in last.loops[:2] for out in loop.outs)


def test_a_row_is_not_read_before_it_is_there() -> None:
    schedule = planned("wind")
    early = tuple(
        replace(one, body=tuple(replace(loop, lag=0) for loop in one.body))
        if isinstance(one, Sweeps)
        else one
        for one in schedule.body
    )
    with pytest.raises(InvalidIR, match="before it is"):
        verify(replace(schedule, body=early), "join")


def test_fields_change_in_place() -> None:
    *_, last = (one for one in flat(planned("fire").body) if isinstance(one, Sweeps))
    (loop,) = last.loops
    assert isinstance(loop, Compute)
    for out in loop.outs:
        assert out.into == out.otherwise.attr


SINKING = """
pack: sinking
fields:
  heat: {type: real(-9..9), at: element}
elements:
  air: {id: 0, color: '#000000'}
  oil: {id: 1, color: '#804000'}
  water: {id: 2, color: '#0000FF'}
passes:
  fall:
    conflicts: POLICY
    do: water swaps below if below is oil
    then: water swaps OFFSET if OFFSET is air
"""


@pytest.mark.parametrize("place", ["left", "above.right", "at(-2, 3)"])
@pytest.mark.parametrize("policy", ["drop_both", "first_wins"])
def test_fields_are_exchanged_where_planes_are(policy: str, place: str) -> None:
    rules = load_text(SINKING.replace("POLICY", policy).replace("OFFSET", place), "sinking.yaml")
    run_stages(rules, CPU)
    ((part, fall),) = packed_passes(rules)
    statements = list(flat(plan(part.planes, fall, CPU).body))
    moves = [(one.op, one.offset, one.outs[0].var.type) for one in statements if isinstance(one, Move)]
    fields = [(op, offset) for op, offset, type in moves if type == REAL]
    assert fields == [(op, offset) for op, offset, type in moves if type != REAL]
    assert len(fields) == 2
    assert not any(isinstance(one, Sweeps) for one in statements)
    assert not any(out.var.type == REAL for one in statements if isinstance(one, Compute) for out in one.outs)


def test_exchanges_that_share_cells_are_computed() -> None:
    rules = load_text(SINKING.replace("POLICY", "overwrite").replace("OFFSET", "left"), "sinking.yaml")
    run_stages(rules, CPU)
    ((part, fall),) = packed_passes(rules)
    assert not any(
        isinstance(one, Move) and one.op == "swap" for one in flat(plan(part.planes, fall, CPU).body)
    )
