"""Scalars of tasks: one number a world."""

from __future__ import annotations

import torch

from powderdsl.model.expressions.operators import NUMBER
from powderdsl.model.types import Expr
from powderdsl.tasks.task import Measure
from powderdsl.tasks.tensors.measures import ScalarInputs, scalar_value

COUNT = Measure("count", None, None)


def facts() -> ScalarInputs:
    now = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    return ScalarInputs({COUNT: 0}, now, now * 10, now * 100, {})


def test_a_constant_is_a_number_of_its_own_in_each_world() -> None:
    value = scalar_value(Expr("const", NUMBER, value=4), facts())
    assert value.tolist() == [4.0, 4.0, 4.0]
    value[0] = 5.0
    assert value.tolist() == [5.0, 4.0, 4.0]


def test_measures_are_taken_now_at_the_start_and_before() -> None:
    now = Expr("measure", NUMBER, value=COUNT)
    values = {
        word: scalar_value(Expr(word, NUMBER, (now,)), facts()).tolist() for word in ("start", "before")
    }
    assert values == {"start": [10.0, 20.0, 30.0], "before": [100.0, 200.0, 300.0]}
    assert scalar_value(Expr("add", NUMBER, (now, now)), facts()).tolist() == [2.0, 4.0, 6.0]
