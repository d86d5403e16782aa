"""Scores and baselines against sums by hand; the network's shapes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from powderdsl.worldmodel.networks import UNet, fresh_unet
from powderdsl.worldmodel.scores import Score, elements_of, frequent, outcomes, score, still

START = torch.tensor([[[0, 0, 1, 1], [2, 2, 2, 0]]], dtype=torch.uint8)
END = torch.tensor([[[0, 1, 1, 1], [2, 0, 2, 0]]], dtype=torch.uint8)
"""Eight cells: 0 stays twice and becomes 1 once, 1 stays twice, 2 stays twice and becomes 0 once."""

PAIRS = [(START, END)]


def values(found: Score, *names: str) -> tuple[float | None, ...]:
    return tuple(found.plain()[name] for name in names)


def test_baselines_are_what_a_hand_computes() -> None:
    found = outcomes(PAIRS, 4)
    assert found.tolist() == [[2, 1, 0, 0], [0, 2, 0, 0], [1, 0, 2, 0], [0, 0, 0, 0]]
    # Six of eight cells stay; one of either kind is counted besides: 7/10. Two other elements share the rest.
    nothing = score(still(found, ids=(0, 1, 2)), PAIRS, 4)
    assert nothing.loss == pytest.approx(-(6 * math.log(0.7) + 2 * math.log(0.15)) / 8)
    assert values(nothing, "accuracy", "changed_accuracy", "changed") == (0.75, 0.0, 2)
    # Of 0: 2 stay, 1 becomes 1, of 3; one more for each of three elements: 3/6 and 2/6. Of 1: 3/5. Of 2: 3/6 and 2/6.
    usual = score(frequent(found, ids=(0, 1, 2)), PAIRS, 4)
    assert usual.loss == pytest.approx(-(4 * math.log(3 / 6) + 2 * math.log(2 / 6) + 2 * math.log(3 / 5)) / 8)
    assert values(usual, "accuracy", "changed_accuracy") == (0.75, 0.0)


def test_a_network_is_scored_as_torch_would() -> None:
    torch.manual_seed(0)
    network = UNet(5, 2)
    starts, ends = (torch.randint(0, 5, (300, 9, 7), dtype=torch.uint8) for _ in range(2))
    found = score(network, [(starts[:100], ends[:100]), (starts[100:], ends[100:])], 5)
    with torch.no_grad():
        logits = network(starts)
    assert found.loss == pytest.approx(float(F.cross_entropy(logits, ends.long())), rel=1e-5)
    right = logits.argmax(1) == ends
    expected = float(right.double().mean()), float(right[starts != ends].double().mean())
    assert values(found, "accuracy", "changed_accuracy") == pytest.approx(expected)
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


def test_cells_beyond_a_grid_hold_no_element() -> None:
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


def test_weights_depend_on_the_seed_alone() -> None:
    torch.manual_seed(5)
    one = fresh_unet(4, 2, 7).state_dict()
    before = torch.random.get_rng_state()
    other = fresh_unet(4, 2, 7).state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(one["head.weight"], fresh_unet(4, 2, 8).state_dict()["head.weight"])
    assert before.shape == torch.random.get_rng_state().shape


def test_changes_have_recall_precision_and_f1() -> None:
    # Two cells change, 0 to 1 and 2 to 0. The first is predicted, the second predicted to become 1; one more is predicted
    # to change and does not.
    predicted = torch.tensor([[[0, 1, 0, 1], [2, 1, 2, 0]]])
    found = score(lambda ids: F.one_hot(predicted, 3).permute(0, 3, 1, 2).float(), PAIRS, 3)
    assert (found.changed, found.predicted_changed, found.changed_right) == (2, 3, 1)
    assert values(found, "changed_accuracy", "change_precision") == (1 / 2, 1 / 3)
    assert found.plain()["change_f1"] == pytest.approx(2 / (2 / 1 + 3 / 1))
    nothing = score(lambda ids: F.one_hot(ids.long(), 3).permute(0, 3, 1, 2).float(), [(START, START)], 3)
    assert values(nothing, "changed_accuracy", "change_precision", "change_f1") == (None, None, None)
    assert values(nothing, "changed_ece", "change_ece") == (None, pytest.approx(1 - math.e / (math.e + 2)))


def test_calibration_is_what_a_hand_computes() -> None:
    # Every cell most likely stays: the upper row with probability 0.9, the lower one with 0.75. Bins of a fifteenth: the
    # 13th has the upper row, three of four right; the 11th the lower one, three of four right.
    chances = torch.full((2, 4, 3), 0.05)
    chances[1] = 0.125
    stay = torch.tensor([0.9, 0.75])[:, None].expand(2, 4)
    chances.scatter_(2, START[0].long()[..., None], stay[..., None])
    logits = chances.double().log().permute(2, 0, 1)[None]
    found = score(lambda ids: logits, PAIRS, 3)
    assert found.plain()["ece"] == pytest.approx((abs(0.9 - 3 / 4) * 4 + abs(0.75 - 3 / 4) * 4) / 8, abs=1e-6)
    # Of the two that change none is right, and the probability of a change is one minus that to stay.
    assert found.plain()["changed_ece"] == pytest.approx((0.9 + 0.75) / 2, abs=1e-6)
    expected = (abs(0.1 - 1 / 4) * 4 + abs(0.25 - 1 / 4) * 4) / 8
    assert found.plain()["change_ece"] == pytest.approx(expected, abs=1e-6)
    table = found.reliability()
    assert [(round(one["low"] * 15), one["cells"], one["observed"]) for one in table["all"]] == [
        (11, 4, 0.75),
        (13, 4, 0.75),
    ]
    assert [round(one["probability"], 5) for one in table["change"]] == [0.1, 0.25]
    assert [one["cells"] for one in table["changed"]] == [1, 1]
