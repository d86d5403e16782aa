"""Loops over floats run together row by row, and swaps exchange floats in place if no cell belongs to two of them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from powderdsl.compiler import load
from powderdsl.ir.ops import REAL
from powderdsl.schedule.stages import CPU, plan
from powderdsl.schedule.types import Compute, Move, Statement, Sweeps, flat
from tests.ir.verify import InvalidIR
from tests.schedule.test_stages import packed_passes, run_stages
from tests.schedule.verify import verify
from tests.semantics.texts import load_text


def test_a_row_is_not_read_before_it_is_there() -> None:
    ((part, wind),) = (pair for pair in packed_passes(load("core+wind")) if pair[1].name == "wind")
    schedule = plan(part.planes, wind, CPU)
    early = tuple(
        replace(one, body=tuple(replace(loop, lag=0) for loop in one.body))
        if isinstance(one, Sweeps)
        else one
        for one in schedule.body
    )
    with pytest.raises(InvalidIR, match="before it is"):
        verify(replace(schedule, body=early), "join")


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


def planned(policy: str, place: str) -> list[Statement]:
    """The statements of the pass, every stage of which means the same."""
    rules = load_text(SINKING.replace("POLICY", policy).replace("OFFSET", place), "sinking.yaml")
    run_stages(rules, CPU)
    ((part, fall),) = packed_passes(rules)
    return list(flat(plan(part.planes, fall, CPU).body))


@pytest.mark.parametrize("place", ["left", "above.right", "at(-2, 3)"])
@pytest.mark.parametrize("policy", ["drop_both", "first_wins"])
def test_fields_are_exchanged_where_planes_are(policy: str, place: str) -> None:
    statements = planned(policy, place)
    moves = [(one.op, one.offset, one.outs[0].var.type) for one in statements if isinstance(one, Move)]
    fields = [(op, offset) for op, offset, type in moves if type == REAL]
    assert fields == [(op, offset) for op, offset, type in moves if type != REAL]
    assert len(fields) == 2
    assert not any(isinstance(one, Sweeps) for one in statements)
    assert not any(out.var.type == REAL for one in statements if isinstance(one, Compute) for out in one.outs)


def test_exchanges_that_share_cells_are_computed() -> None:
    statements = planned("overwrite", "left")
    assert not any(isinstance(one, Move) and one.op == "swap" for one in statements)
