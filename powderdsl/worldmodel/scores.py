"""Scores of predictions, for networks and baselines alike.

All except the loss follow from counts of cells, so they do not depend on the order and batches of pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from operator import add

import torch
from torch import Tensor
from torch.nn import functional as F

from powderdsl.worldmodel.worlds import Pairs

Network = Callable[[Tensor], Tensor]
"""Ids uint8 [B, H, W] -> logits [B, slots, H, W]."""

TOGETHER = 1 << 17
"""Maximum number of cells in a batch."""

BINS = 15
"""Bins of equal width of probabilities, as in Guo et al. (2017)."""

UNITS = 1 << 24
"""Probabilities are counted in integer units of this share, so that sums do not depend on their order."""

KINDS = ("all", "changed", "change")
"""Calibration tables: of the predicted element, for all cells and for those that change; and of changes."""


@dataclass(frozen=True)
class Score:
    """Counts of cells, and the sum of their losses.

    `confusion`, int64 [slots, slots], counts cells by what they became and what was predicted. A cell is *changed* if
    its element at the end differs from that at the start, and *predicted to change* if the most likely element differs
    from that at the start. `bins`, int64 [3, BINS, 3], has a table for each of `KINDS`: for each bin of probabilities
    the number of cells, how many of them the prediction was right about, and the sum of their probabilities in `UNITS`.
    """

    loss_sum: float
    confusion: Tensor
    changed: int
    changed_right: int
    predicted_changed: int
    bins: Tensor

    @property
    def cells(self) -> int:
        return int(self.confusion.sum())

    @property
    def loss(self) -> float:
        """Cross-entropy per cell, in nats."""
        return self.loss_sum / max(self.cells, 1)

    def plain(self) -> dict[str, float | int | None]:
        """The measures by name, for JSON; None for shares of no cells."""
        right, changed, predicted = self.changed_right, self.changed, self.predicted_changed
        return {
            "loss": self.loss,
            "accuracy": int(self.confusion.diagonal().sum()) / max(self.cells, 1),
            # Recall, precision and their harmonic mean. A change is right if its new element is.
            "changed_accuracy": _share(right, changed),
            "change_precision": _share(right, predicted),
            "change_f1": _share(2 * right, changed + predicted),
            "ece": self._calibration_error("all"),
            "changed_ece": self._calibration_error("changed"),
            "change_ece": self._calibration_error("change"),
            "cells": self.cells,
            "changed": changed,
            "predicted_changed": predicted,
        }

    def _calibration_error(self, kind: str) -> float | None:
        """The expected calibration error of one of `KINDS`."""
        table = self.bins[KINDS.index(kind)]
        gaps = (table[:, 1] * UNITS - table[:, 2]).abs().sum()
        return _share(int(gaps), UNITS * int(table[:, 0].sum()))

    def reliability(self) -> dict[str, list[dict[str, float | int]]]:
        """The bins with cells, for each of `KINDS`: bounds, cells, mean probability, and share of correct cells."""
        return {
            kind: [
                {
                    "low": number / BINS,
                    "high": (number + 1) / BINS,
                    "cells": cells,
                    "probability": units / (UNITS * cells),
                    "observed": right / cells,
                }
                for number, (cells, right, units) in enumerate(table)
                if cells
            ]
            for kind, table in zip(KINDS, self.bins.tolist(), strict=True)
        }

    def __add__(self, other: Score) -> Score:
        return Score(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))


def ids_of(inputs: Tensor) -> Tensor:
    """The ids, uint8 [B, H, W], of inputs: the first channel of inputs with an action."""
    return inputs if inputs.ndim == 3 else inputs[:, 0]


def score(predict: Network, pairs: Iterable[Pairs], slots: int) -> Score:
    """The score of a network, or of any callable from ids to logits [B, slots, H, W], on some pairs."""
    parts = []
    for starts, ends in pairs:
        few = max(1, TOGETHER // (starts.shape[-2] * starts.shape[-1]))
        parts += [
            _score(predict, *part, slots) for part in zip(starts.split(few), ends.split(few), strict=True)
        ]
    return reduce(add, parts)


@torch.no_grad()
def _score(predict: Network, starts: Tensor, ends: Tensor, slots: int) -> Score:
    logits = predict(starts).float()
    starts = ids_of(starts)
    truth = ends.long()
    loss = F.cross_entropy(logits, truth, reduction="none").double().sum()
    chances, predicted = logits.softmax(1), logits.argmax(1)
    most = chances.gather(1, predicted[:, None])[:, 0]
    stays = chances.gather(1, starts.long()[:, None])[:, 0]
    changed, right = starts != ends, predicted == truth
    tables = (_binned(most, right), _binned(most[changed], right[changed]), _binned(1 - stays, changed))
    return Score(
        float(loss),
        _counts(truth, predicted, slots),
        int(changed.sum()),
        int((right & changed).sum()),
        int((predicted != starts).sum()),
        torch.stack(tables),
    )


def _binned(chances: Tensor, right: Tensor) -> Tensor:
    """A table of `Score.bins`: int64 [BINS, 3]."""
    units = (chances.flatten().double() * UNITS).round().long().clamp(0, UNITS)
    number = (units * BINS // UNITS).clamp(max=BINS - 1)
    columns = torch.stack([torch.ones_like(units), right.flatten().long(), units], 1)
    table = torch.zeros(BINS, 3, dtype=torch.int64, device=units.device)
    return table.index_add_(0, number, columns).cpu()


def baseline(chances: Tensor) -> Network:
    """Log-probabilities of a cell's next element, by its current one.

    `chances` is float64 [slots, slots]: a row for each start element, which sums to 1.
    """
    logits = chances.log().float()
    return lambda inputs: logits.to(inputs.device)[ids_of(inputs).long()].permute(0, 3, 1, 2)


def outcomes(pairs: Iterable[Pairs], slots: int) -> Tensor:
    """Count the cells that went from each element to each: int64 [slots, slots]."""
    counts = torch.zeros(slots, slots, dtype=torch.int64)
    for starts, ends in pairs:
        counts += _counts(ids_of(starts).long(), ends.long(), slots)
    return counts


def _counts(rows: Tensor, columns: Tensor, slots: int) -> Tensor:
    """Count each pair of numbers below `slots`: int64 [slots, slots]."""
    both = (rows * slots + columns).flatten()
    return torch.bincount(both, minlength=slots * slots).view(slots, slots).cpu()


def still(counts: Tensor, ids: Sequence[int]) -> Network:
    """ "Nothing changes": a cell stays the same with one probability, and all other elements are equally likely.

    The probability has the lowest cross-entropy on the counted pairs: the share of cells that stayed, after adding one
    cell that stayed and one that did not. `ids` are those of existing elements.
    """
    stays = (int(counts.diagonal().sum()) + 1) / (int(counts.sum()) + 2)
    chances = torch.zeros(len(counts), len(counts), dtype=torch.float64)
    chances[:, list(ids)] = (1 - stays) / max(len(ids) - 1, 1)
    return baseline(chances.fill_diagonal_(stays))


def frequent(counts: Tensor, ids: Sequence[int]) -> Network:
    """ "Most frequent outcome": for each start element, the shares of its outcomes.

    One cell is added for each possible outcome in `ids`, so that none of them has probability 0.
    """
    seen = counts.double()
    seen[:, list(ids)] += 1
    return baseline(seen / seen.sum(1, keepdim=True))


def elements_of(total: Score, palette: tuple[str | None, ...]) -> dict[str, dict[str, float | int | None]]:
    """By element: the number of cells that became it, the share of these that was predicted (recall), and the share of
    correct predictions of it (precision). None without such cells."""
    confusion = total.confusion
    counts = zip(
        confusion.sum(1).tolist(), confusion.sum(0).tolist(), confusion.diagonal().tolist(), strict=True
    )
    return {
        name: {"cells": cells, "recall": _share(right, cells), "precision": _share(right, predicted)}
        for name, (cells, predicted, right) in zip(palette, counts, strict=True)
        if name is not None and (cells or predicted)
    }


def _share(part: int, whole: int) -> float | None:
    """The ratio of two counts; None if the second is 0."""
    return part / whole if whole else None
