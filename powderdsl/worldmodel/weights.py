"""Weights out of checkpoints, which may hold anything."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from powderdsl.experiments.runs import Checkpoint, does_not_fit


def fit_weights(model: nn.Module, checkpoint: Checkpoint, *, grow: bool = False) -> None:
    """Give a network the weights of a checkpoint.

    Args:
        grow: the network may be larger: what the checkpoint lacks keeps the weights that it has.

    Raises:
        CompileError: PD623 if they are those of another network.
    """
    found = weights_in(checkpoint)
    try:
        model.load_state_dict(_grown(found, model) if grow else found)
    except (RuntimeError, TypeError, AttributeError) as error:
        words = [line.strip()[:200] for line in str(error).splitlines()[:4]]
        raise does_not_fit(checkpoint.path, "its weights are those of another network", *words) from None


def weights_in(checkpoint: Checkpoint) -> dict[str, Any]:
    """The weights in a checkpoint, which may hold anything; none if it has no weights."""
    state = checkpoint.state.get("model") if isinstance(checkpoint.state, dict) else None
    return dict(state) if isinstance(state, dict) else {}


def _grown(state: dict[str, Any], model: nn.Module) -> dict[str, Any]:
    """Weights in the shapes of a network that has more slots, first in each dimension."""
    for name, fresh in model.state_dict().items():
        old = state.get(name)
        if (
            isinstance(old, Tensor)
            and old.ndim == fresh.ndim
            and old.shape != fresh.shape
            and all(a <= b for a, b in zip(old.shape, fresh.shape, strict=True))
        ):
            state[name] = fresh.clone()
            state[name][tuple(slice(size) for size in old.shape)] = old
    return state
