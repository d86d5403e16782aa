"""Bit planes in torch: 64 cells an int64 word, on any device, without a toolchain. Reals stay float32 cells.

Runs IR on planes (`ir.bits`). No host sync in a step; the same numbers as every other backend.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from powderdsl.ir.gates import width as planes_of
from powderdsl.ir.ops import Program, SlotType
from powderdsl.targets import random
from powderdsl.targets import words as torch_words
from powderdsl.targets.arrays.source import pass_source
from powderdsl.targets.dense.program import Kernels, PassFunction, compiled
from powderdsl.targets.job import Job
from powderdsl.targets.laps import Laps, unwatched

_CHANGES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
}


@dataclass
class PlaneKernels:
    """What generated code calls. Words are int64 [B, H, Ww] (or broadcastable), cells float32 or bool [B, H, W]."""

    dense: Kernels
    valid: Tensor = field(init=False)
    zero: Tensor = field(init=False)
    _planes: dict[tuple[str, int], list[Tensor]] = field(default_factory=dict)
    _cache: dict[tuple[str | int, ...], Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _, _, self.width = self.dense.shape
        self.valid = torch_words.valid_words(self.width, self.dense.device)
        self.zero = torch.zeros_like(self.valid)

    def begin(self, step: Tensor) -> None:
        self.dense.begin(step)
        self._planes.clear()
        self._cache = {key: value for key, value in self._cache.items() if key[0] != "step"}

    def full(self, x: Tensor) -> Tensor:
        batch, height, _ = self.dense.shape
        return x.expand(batch, height, len(self.valid)) if x.ndim < 3 or x.shape[:2] != (batch, height) else x

    # Words

    def shift(self, x: Tensor, dy: int, dx: int, wraps: bool, dim: int = -2) -> Tensor:
        x = self.full(x) if x.ndim <= 3 else x
        if dx:
            x = torch_words.columns(x, dx, self.width, self.valid, wraps)
        return torch_words.rows(x, dy, wraps, dim) if dy else x

    @staticmethod
    def some(*flags: Tensor) -> bool:
        """Whether one of some flags may hold anywhere: to know, one would have to wait for the device."""
        return True

    @staticmethod
    def all_zero(*fields: Tensor) -> bool:
        """Whether some fields are zero everywhere: this would have to wait too."""
        return False

    def stack(self, planes: tuple[Tensor, ...]) -> Tensor:
        return torch.stack([self.full(plane) for plane in planes])

    def swap(self, block: Tensor, movers: Tensor, over: bool, dy: int, dx: int) -> Tensor:
        """Movers and targets exchanged, in all planes: by the xor of the two. `over`: the block is not needed any more."""
        difference = (block ^ self.shift(block, dy, dx, True)) & movers
        return block ^ difference ^ self.shift(difference, -dy, -dx, True)

    def leave(
        self, block: Tensor, movers: Tensor, over: bool, dy: int, dx: int, left: tuple[int, ...]
    ) -> Tensor:
        """Targets get what the movers held; where those were, the planes `left` hold and the others do not."""
        rest = block & (movers ^ self.valid)
        for plane in left:
            rest[plane] |= movers
        return self.arrive(block, movers, rest, dy, dx)

    def swap_onto(self, block: Tensor, movers: Tensor, rest: Tensor, dy: int, dx: int) -> Tensor:
        """The same where something else has changed as well: `rest` has the cells that do not move."""
        result = self.arrive(block, movers, rest, dy, dx)
        return result ^ (movers & (result ^ self.shift(block, dy, dx, True)))

    def arrive(self, block: Tensor, movers: Tensor, rest: Tensor, dy: int, dx: int) -> Tensor:
        """Targets get what the movers held."""
        targets = self.shift(movers, -dy, -dx, True)
        return rest ^ (targets & (rest ^ self.shift(block, -dy, -dx, True)))

    def pack(self, cells: Tensor) -> Tensor:
        return torch_words.pack(cells.expand(self.dense.shape))

    def cells(self, words: Tensor) -> Tensor:
        """A flag as bool cells."""
        return torch_words.unpack(self.full(words), self.width)

    places = cells

    def moved(self, cells: Tensor, dy: int, dx: int) -> Tensor:
        """The cells whose neighbours (dy, dx) some cells are."""
        return self.dense.roll(cells, dy, dx)

    # Draws

    def planes(self, stream: str, bits: int) -> list[Tensor]:
        """The inverted bit planes of a stream, most significant first."""
        position, resolution = self.dense.streams[stream]
        known = self._planes.get((stream, 0), [])
        if len(known) >= bits:
            return known[:bits]
        if stream in self.dense.given:
            given = self.dense.given[stream]
            found = [self.pack(((given >> (resolution - 1 - j)) & 1) == 0) for j in range(bits)]
        else:
            _, height, width = self.dense.shape
            halves = random.words(self.dense.keys[position], bits, height, width)
            if halves.shape[-1] % 2:
                halves = torch.nn.functional.pad(halves, (0, 1))
            found = list(((halves[..., 0::2] | (halves[..., 1::2] << 32)) ^ -1).unbind(0))
        self._planes[stream, 0] = found
        return found

    def chance(self, stream: str, bits: int, limit: int, where: Tensor | None = None) -> Tensor:
        """Draw below a constant: from its lowest set bit up, one gate a plane."""
        low = (limit & -limit).bit_length() - 1
        planes = self.planes(stream, bits - low)
        result = planes[-1]
        for i in range(low + 1, bits):
            plane = planes[bits - 1 - i]
            result = plane | result if limit >> i & 1 else plane & result
        return result & self.valid

    def below(self, stream: str, bits: int, limit: tuple[Tensor, ...], where: Tensor | None = None) -> Tensor:
        """Draw below a limit given plane by plane, most significant first: the borrow of a subtraction."""
        result = self.zero
        for plane, bound in zip(reversed(self.planes(stream, bits)), reversed(limit[1:]), strict=True):
            result = (plane & (bound | result)) | (bound & result)
        return (result | limit[0]) & self.valid

    def below_param(
        self, stream: str, bits: int, name: str, view: str, where: Tensor | None = None
    ) -> Tensor:
        """Draw below a parameter."""
        return self.below(stream, bits, tuple(self.param(name, view, i) for i in range(bits, -1, -1)))

    def draw_real(self, stream: str, bits: int) -> Tensor:
        return self.dense.draw_real(stream)

    # The same everywhere

    def param(self, name: str, view: str, bit: int | None = None) -> Tensor:
        if bit is None and view == "value":
            return (
                self.dense.param(name, "real")
                if not self._is_flag(name)
                else self._mask(self.dense.param(name, "flag"))
            )
        number = self.dense.param(name, "int" if view == "value" else view).to(torch.int64)
        return self._mask((number >> (bit or 0)) & 1 != 0)

    def _is_flag(self, name: str) -> bool:
        return name in self.dense.flags

    def _mask(self, flags: Tensor) -> Tensor:
        """bool [B, 1, 1] as words that are all ones or all zeros."""
        return torch.where(flags, self.valid, self.zero)

    def coordinate(self, axis: str, modulus: int, bit: int) -> Tensor:
        key = (axis, modulus, bit)
        if key not in self._cache:
            flags = (self.dense.coordinate(axis, modulus) >> bit) & 1 != 0
            self._cache[key] = (
                self._mask(flags)
                if axis == "step"
                else torch_words.pack(flags.expand(self.dense.shape[1:]))[None]
            )
        return self._cache[key]

    def inside(self, dy: int, dx: int) -> Tensor:
        key = ("inside", dy, dx)
        if key not in self._cache:
            self._cache[key] = torch_words.pack(self.dense.inside(dy, dx))[None]
        return self._cache[key]

    # Cells

    def shift_cells(self, x: Tensor, dy: int, dx: int, wraps: bool) -> Tensor:
        return self.dense.roll(x, dy, dx) if wraps else self.dense.reach(x, dy, dx)

    def copy(self, x: Tensor) -> Tensor:
        """A copy that is a number for each cell."""
        return self.dense.full(x).clone()

    @staticmethod
    def choose(cells: Tensor, yes: Tensor, no: Tensor, over: bool) -> Tensor:
        """`yes` where the cells hold, else `no`; `over`: `no` is not needed any more."""
        return torch.where(cells, yes, no)

    @staticmethod
    def update(cells: Tensor, no: Tensor, other: Tensor, over: bool, change: str) -> Tensor:
        """`no`, and where the cells hold `no` + `other`, or what else the change is."""
        return torch.where(cells, _CHANGES[change](no, other), no)

    def carry(
        self,
        source: Tensor,
        target: Tensor,
        no: Tensor,
        other: Tensor,
        over: bool,
        change: str,
        dy: int,
        dx: int,
    ) -> Tensor:
        """`no`, and at the target cells changed by what `other` has at the neighbour (dy, dx)."""
        return self.update(target, no, self.dense.roll(other, dy, dx), over, change)

    @staticmethod
    def sqrt(x: Tensor) -> Tensor:
        """Torch's float32 square root is not always rounded correctly on CPUs; from float64 it is."""
        return torch.sqrt(x.double()).float()

    min = staticmethod(torch.minimum)
    max = staticmethod(torch.maximum)
    div = staticmethod(Kernels.divide)

    def settle(self, x: Tensor, over: bool, low: float, high: float) -> Tensor:
        """No NaN, within bounds, nothing smaller than SNAP."""
        return self.dense.full(Kernels.settle(x, low, high))


def planes_kernel_source(program: Program, only: str | None = None) -> str:
    """The generated source of all passes (or one) of a program on planes."""
    return "\n\n".join(
        pass_source(p, i)[0] for i, p in enumerate(program.passes) if only is None or p.name == only
    )


class PlanesProgram:
    """A program on planes whose passes are generated torch functions.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
    """

    def __init__(self, program: Program, planes: Program, device: torch.device):
        self.device = device
        self._slots: tuple[SlotType, ...] = program.slots
        self._flags = frozenset(name for name, kind in program.params if kind == "flag")
        self._streams = {name: (i, bits) for i, (name, _, bits) in enumerate(program.streams)}
        self._idents = torch.tensor(
            [ident for _, ident, _ in program.streams], dtype=torch.int64, device=device
        )
        self._defaults = {slot.name: slot for slot in planes.slots}
        self._functions: list[tuple[str, PassFunction]] = [
            (p.name, compiled(*pass_source(p, i), device)) for i, p in enumerate(planes.passes)
        ]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later in storage dtypes; no host sync."""
        return self._run(job, unwatched)

    def profile(self, job: Job) -> Mapping[str, float]:
        """Seconds that each pass takes over `job.steps`."""
        laps = Laps(self.device)
        self._run(job, laps)
        return laps.passes()

    def _run(self, job: Job, lap: Callable[[str], None]) -> Mapping[str, Tensor]:
        seed, index, start = job.clock
        batch, height, width = job.state["element"].shape
        dense = Kernels(
            (batch, height, width), self.device, job.params, self._streams, job.draws,
            random.base_keys(seed, index), self._idents, start, self._flags,
        )  # fmt: skip
        kernels = PlaneKernels(dense)
        planes = self._unpack(job.state)
        with torch.no_grad():
            for i in range(job.steps):
                kernels.begin(start + i)
                self._reset(planes, kernels)
                lap("")
                for name, function in self._functions:
                    if job.passes is None or name in job.passes:
                        planes.update(function(kernels, planes))
                        lap(name)
        return self._pack(planes, job.state, kernels)

    def _reset(self, planes: dict[str, Tensor], kernels: PlaneKernels) -> None:
        for name, slot in self._defaults.items():
            if slot.resets:
                if slot.type.name == "flag":
                    planes[name] = kernels.valid if slot.default else kernels.zero
                else:
                    planes[name] = torch.full(
                        kernels.dense.shape, slot.default, dtype=torch.float32, device=self.device
                    )

    def _unpack(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """State slots as planes."""
        planes = {}
        for slot in self._slots:
            base, _, part = slot.name.rpartition(".")
            if part in ("row", "column") and base in state:
                planes[slot.name] = state[base][:, ("row", "column").index(part)].clone()
            elif slot.type.name == "real":
                planes[slot.name] = state[slot.name].clone()
            elif slot.type.name == "flag":
                planes[slot.name] = torch_words.pack(state[slot.name] != 0)
            else:
                count, _ = planes_of(slot.type.lo, slot.type.hi)
                for i in range(count):
                    planes[f"{slot.name}:{i}"] = torch_words.pack((state[slot.name] >> i) & 1 != 0)
        return planes

    def _pack(
        self, planes: Mapping[str, Tensor], like: Mapping[str, Tensor], kernels: PlaneKernels
    ) -> dict[str, Tensor]:
        """Planes as state slots in storage dtypes."""
        packed = {}
        types = {slot.name: slot.type for slot in self._slots}
        for name, old in like.items():
            if old.ndim == 4:
                packed[name] = torch.stack(
                    [kernels.dense.full(planes[f"{name}.{part}"]) for part in ("row", "column")], 1
                )
            elif old.dtype == torch.float32:
                packed[name] = kernels.dense.full(planes[name]).clone()
            elif types[name].name == "flag":
                packed[name] = kernels.cells(planes[name]).to(old.dtype)
            else:
                count, signed = planes_of(types[name].lo, types[name].hi)
                value = torch.zeros((), dtype=old.dtype, device=self.device)
                for i in range(count):
                    weight = -(1 << i) if signed and i == count - 1 else 1 << i
                    bit = kernels.cells(planes[f"{name}:{i}"]).to(old.dtype)
                    value = value + (bit << i if weight > 0 and old.dtype == torch.uint8 else bit * weight)
                packed[name] = value.to(old.dtype)
        return packed
