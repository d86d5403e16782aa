"""Torch tensors in the memory of this process, as programs take and return them."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor


class Tensors:
    """An `array_kind.ArrayKind`: tensors on the CPU."""

    xp: Any = torch

    def empty(self, dtype: torch.dtype, shape: tuple[int, ...]) -> tuple[Tensor, Any]:
        made = torch.empty(shape, dtype=dtype)
        return made, self.bytes_of(made)

    def bytes_of(self, array: Tensor) -> Any:
        """A view: the tensor must live longer."""
        return (ctypes.c_ubyte * array.nbytes).from_address(array.data_ptr())

    def contiguous(self, array: Tensor) -> Tensor:
        return array.contiguous()
