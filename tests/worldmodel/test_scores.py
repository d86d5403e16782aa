"""Scores and baselines against sums by hand; the network's shapes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.worldmodel import UNet, frequent, fresh_unet, outcomes, score, still
from powderdsl.worldmodel.scores import Table, elements_of

START = torch.tensor([[[0, 0, 1, 1], [2, 2, 2, 0]]], dtype=torch.uint8)
END = torch.tensor([[[0, 1, 1, 1], [2, 0, 2, 0]]], dtype=torch.uint8)
"""Eight cells: 0 stays twice and becomes 1 once, 1 stays twice, 2 stays twice and becomes 0 once."""

PAIRS = [(START, END)]


def test_outcomes_are_counted() -> None:
    assert outcomes(PAIRS, 4).tolist() == [[2, 1, 0, 0], [0, 2, 0, 0], [1, 0, 2, 0], [0, 0, 0, 0]]


def test_nothing_changes_is_what_a_hand_computes() -> None:
    # Six of eight cells stay; one of either kind is counted besides: 7/10. Two other elements share the rest.
    found = score(still(outcomes(PAIRS, 4), ids=(0, 1, 2)), PAIRS, 4)
    assert found.loss == pytest.approx(-(6 * math.log(0.7) + 2 * math.log(0.15)) / 8)
    assert (found.accuracy, found.changed_accuracy, found.changed) == (0.75, 0.0, 2)


def test_the_most_frequent_outcome_is_what_a_hand_computes() -> None:
    # Of 0: 2 stay, 1 becomes 1, of 3; one more for each of three elements: 3/6 and 2/6. Of 1: 3/5. Of 2: 3/6 and 2/6.
    found = score(frequent(outcomes(PAIRS, 4), ids=(0, 1, 2)), PAIRS, 4)
    expected = (
        2 * math.log(3 / 6) + math.log(2 / 6) + 2 * math.log(3 / 5) + 2 * math.log(3 / 6) + math.log(2 / 6)
    )
    assert found.loss == pytest.approx(-expected / 8)
    assert (found.accuracy, found.changed_accuracy) == (0.75, 0.0)


def test_frequencies_of_much_data_give_the_conditional_entropy() -> None:
    many = outcomes(PAIRS, 4) * 100_000
    found = score(frequent(many, ids=(0, 1, 2)), PAIRS, 4)
    entropy = -(4 * math.log(2 / 3) + 2 * math.log(1 / 3)) / 8
    assert found.loss == pytest.approx(entropy, rel=1e-4)


def test_no_other_chance_that_cells_stay_does_better() -> None:
    counts = outcomes(PAIRS, 4) * 100_000
    best = score(still(counts, ids=(0, 1, 2)), PAIRS, 4).loss
    for stays in (0.70, 0.74, 0.76, 0.80):
        chances = torch.full((3, 3), (1 - stays) / 2, dtype=torch.float64).fill_diagonal_(stays)
        assert score(Table(chances), PAIRS, 3).loss > best


def test_a_network_is_scored_as_torch_would() -> None:
    torch.manual_seed(0)
    network = UNet(5, 2)
    starts, ends = (torch.randint(0, 5, (300, 9, 7), dtype=torch.uint8) for _ in range(2))
    found = score(network, [(starts[:100], ends[:100]), (starts[100:], ends[100:])], 5)
    with torch.no_grad():
        logits = network(starts)
    assert found.loss == pytest.approx(float(F.cross_entropy(logits, ends.long())), rel=1e-5)
    right = logits.argmax(1) == ends
    assert found.accuracy == pytest.approx(float(right.double().mean()))
    assert found.changed_accuracy == pytest.approx(float(right[starts != ends].double().mean()))
    assert found.cells == 300 * 63


def test_elements_have_recall_and_precision() -> None:
    def always_one(ids: Tensor) -> Tensor:
        return torch.tensor([0.0, 1.0, 0.0])[None, :, None, None].expand(len(ids), 3, *ids.shape[1:])

    found = elements_of(score(always_one, PAIRS, 3), ["a", "b", "c"])
    assert found == {
        "a": {"cells": 3, "recall": 0.0, "precision": None},
        "b": {"cells": 3, "recall": 1.0, "precision": 3 / 8},
        "c": {"cells": 2, "recall": 0.0, "precision": None},
    }


@pytest.mark.parametrize("size", [(64, 64), (1, 1), (13, 6), (7, 32)])
def test_grids_of_any_size_keep_it(size: tuple[int, int]) -> None:
    ids = torch.randint(0, 6, (2, *size), dtype=torch.uint8)
    assert fresh_unet(6, 3, 0)(ids).shape == (2, 6, *size)


def test_what_lies_beyond_a_grid_is_no_element() -> None:
    """A grid whose sides are no multiple of four is seen as one that ends there, not as one of element 0 beyond."""
    network = fresh_unet(4, 4, 0)
    ids = torch.ones((1, 8, 8), dtype=torch.uint8)
    with torch.no_grad():
        assert not torch.allclose(
            network(ids[:, :6, :6]), network(F.pad(ids[:, :6, :6], (0, 2, 0, 2)))[..., :6, :6]
        )


def test_the_network_is_the_papers() -> None:
    network = UNet(14, 32)
    convolutions = [layer for layer in network.modules() if isinstance(layer, nn.Conv2d)]
    shapes = [(one.in_channels, one.out_channels, one.kernel_size[0]) for one in convolutions]
    down = [(14, 32, 3), (32, 32, 3), (32, 64, 3), (64, 64, 3), (64, 128, 3), (128, 128, 3)]
    up = [(128, 64, 3), (64, 64, 3), (64, 32, 3), (32, 32, 3), (32, 14, 1)]
    assert sorted(shapes) == sorted([*down, *up])
    assert sum(isinstance(layer, nn.ReLU) for layer in network.modules()) == 10


def test_weights_hang_on_the_seed_alone() -> None:
    torch.manual_seed(5)
    one = fresh_unet(4, 2, 7).state_dict()
    before = torch.random.get_rng_state()
    other = fresh_unet(4, 2, 7).state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(one["head.weight"], fresh_unet(4, 2, 8).state_dict()["head.weight"])
    assert before.shape == torch.random.get_rng_state().shape
