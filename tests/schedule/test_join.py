"""Loops over floats that run together row by row."""

from __future__ import annotations

from dataclasses import replace

import pytest

from powderdsl.compiler import load
from powderdsl.ir.ops import InvalidIR
from powderdsl.schedule.stages import CPU, plan
from powderdsl.schedule.types import Compute, Schedule, Sweeps, field_reads, flat
from powderdsl.schedule.verify import verify
from tests.schedule.test_stages import packed_passes


def planned(name: str) -> Schedule:
    """The pass of that name in powderworld, as native code runs it."""
    (found,) = (pass_ for _, pass_ in packed_passes(load("powderworld")) if pass_.name == name)
    return plan(found, CPU)


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
        assert out.otherwise is not None
        assert out.into == out.otherwise.attr
