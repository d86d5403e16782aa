"""Torch tensors on one device, as worlds and programs use them, and flags packed into words."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from powderdsl.arrays import np
from powderdsl.targets.array_kind import ArrayKind


@dataclass(frozen=True)
class Tensors(ArrayKind):
    """Torch tensors: see `ArrayKind` for the methods."""

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    xp: ClassVar[Any] = torch

    @property
    def on_cpu(self) -> bool:
        return self.device.type == "cpu"

    def convert(self, value: Any, name: str) -> Tensor:
        flags = getattr(value, "flags", None)
        if getattr(flags, "writeable", True) is False:
            value = value.copy()  # torch warns of arrays that it could write to and may not
        try:
            return torch.as_tensor(value, device=self.device)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise TypeError(f"{name}: {' '.join(str(error).split())}") from None

    def put(self, values: Any, dtype: str | None = None) -> Tensor:
        return torch.tensor(
            values, dtype=None if dtype is None else getattr(torch, dtype), device=self.device
        )

    def zeros(self, dtype: str, shape: tuple[int, ...]) -> Tensor:
        return torch.zeros(shape, dtype=getattr(torch, dtype), device=self.device)

    def arange(self, count: int) -> Tensor:
        return torch.arange(count, device=self.device)

    def copied(self, array: Tensor) -> Tensor:
        return array.clone(memory_format=torch.contiguous_format)

    def contiguous(self, array: Tensor) -> Tensor:
        return array.contiguous()

    def entries(self, table: Tensor, index: Tensor) -> Tensor:
        rows = table.index_select(0, index.flatten().int())  # faster than an index
        return rows.view(*index.shape, *table.shape[1:])

    def sort(self, array: Tensor) -> str:
        dtype = array.dtype
        if dtype.is_complex:
            return "complex"
        return "float" if dtype.is_floating_point else "bool" if dtype == torch.bool else "int"

    def to_numpy(self, array: Tensor) -> Any:
        return array.detach().cpu().numpy()

    def from_numpy(self, array: Any) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def from_bytes(self, memory: bytearray, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
        return torch.frombuffer(memory, dtype=dtype).reshape(shape)

    def holds_any(self, array: Tensor) -> bool:
        if array.numel() > 1:  # a single number may have any stride
            array = array.view(-1).view(torch.uint8)  # 5 times as fast as floats
        return bool(array.any())

    def bytes_of(self, array: Tensor) -> Any:
        """A view: the tensor must live longer."""
        return (ctypes.c_ubyte * array.nbytes).from_address(array.data_ptr())


WORD = 64
"""Columns in a word of packed flags."""


def word_count(width: int) -> int:
    return -(-width // WORD)


_LITTLE = torch.tensor([1 << i for i in range(8)], dtype=torch.uint8)


def pack(flags: Tensor) -> Tensor:
    """bool [..., W] → int64 [..., ⌈W/64⌉]."""
    width = flags.shape[-1]
    missing = word_count(width) * WORD - width
    if missing:
        flags = torch.nn.functional.pad(flags.to(torch.uint8), (0, missing))
    octets = flags.to(torch.uint8).reshape(*flags.shape[:-1], -1, 8)
    packed = (octets * _LITTLE.to(flags.device)).sum(-1, dtype=torch.uint8)
    return packed.view(torch.int64)
