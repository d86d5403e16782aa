"""Programs and their jobs: clocks, states in a backend's memory, the time that each pass takes, and mixed programs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple, Protocol, Self

from powderdsl.diagnostics import CompileError
from powderdsl.ir.bits import Segment
from powderdsl.ir.ops import Program
from powderdsl.system.writing import failure
from powderdsl.targets.array_kind import Array


def now(device: Any) -> float:
    """The time in seconds, after a GPU, which works asynchronously, has finished its work."""
    if getattr(device, "type", "") == "cuda":
        import torch

        torch.cuda.synchronize(device)
    return time.perf_counter()


class PassClock:
    """Seconds by pass. Work before the first pass has the name ``""``."""

    def __init__(self, device: Any):
        self._device = device
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = now(device)

    def tick(self, name: str) -> None:
        """Count the time since the last call for a pass."""
        last, self._last = self._last, now(self._device)
        self.seconds[name] += self._last - last

    def add(self, name: str, seconds: float) -> None:
        """Add time that a program measured itself."""
        self.seconds[name] += seconds


class Clock(NamedTuple):
    """Seed and world index of each world, int64 [B], and its step: `since` steps after `start`, int64 [B].

    The sum is computed only when it is read: a step of one small world takes no longer than a few torch operations.
    """

    seed: Array
    world: Array
    start: Array
    since: int = 0

    @property
    def step(self) -> Array:
        """The step of each world: int64 [B]."""
        return self.start + self.since if self.since else self.start


Like = Mapping[str, tuple[Any, tuple[int, ...]]]
"""The dtype and shape of each array of a state."""


class PackedArrays(Mapping[str, Array]):
    """A batch's state in memory of a backend. Slots are unpacked into arrays one by one, on first access."""

    __slots__ = ("_arrays", "like")

    def __init__(self, like: Like):
        self.like = like
        self._arrays: dict[str, Array] = {}

    def unpack(self, name: str) -> Array:
        """One slot as a new array of its storage dtype."""
        raise NotImplementedError

    def __getitem__(self, name: str) -> Array:
        if name not in self._arrays:
            self._arrays[name] = self.unpack(name)
        return self._arrays[name]

    def forget(self) -> None:
        """Unpack again on the next access: the backend has written to the memory."""
        self._arrays.clear()

    def has(self, name: str) -> bool:
        """True if a slot's array has been unpacked."""
        return name in self._arrays

    def __iter__(self) -> Iterator[str]:
        return iter(self.like)

    def __len__(self) -> int:
        return len(self.like)


class OwnedBatch(PackedArrays):
    """A batch that its owner releases when it is no longer used."""

    __slots__ = ("_handle",)

    def __init__(self, handle: int, like: Like):
        super().__init__(like)
        self._handle: int | None = handle

    def release(self, handle: int) -> None:
        """Use the memory of a batch for others."""
        raise NotImplementedError

    def __del__(self) -> None:
        # Not a weakref.finalize, which takes as long as a quiet step. A signal may have interrupted `__init__`.
        if (handle := getattr(self, "_handle", None)) is not None:
            self.release(handle)

    @property
    def handle(self) -> int:
        """The batch, for the backend. Raises RuntimeError after `take`."""
        if self._handle is None:
            problem = "these worlds were stepped with `reuse`"
            raise RuntimeError(f"{problem}: only those that came of it can be used")
        return self._handle

    def take(self) -> int:
        """The batch, for a new owner. This state must not be used afterwards."""
        handle, self._handle = self.handle, None
        self._arrays.clear()
        return handle

    def __deepcopy__(self, memo: Any) -> Self:
        return copy(self)


def like_of(state: Mapping[str, Array]) -> Like:
    """The dtypes and shapes of a state, without unpacking anything."""
    like: Like | None = getattr(state, "like", None)  # `isinstance` is slow with an abstract class
    if like is not None:
        return like
    return {name: (value.dtype, tuple(value.shape)) for name, value in state.items()}


def shape_of(state: Mapping[str, Array]) -> tuple[int, int, int]:
    """(worlds, rows, columns) of a state, without unpacking anything."""
    like = getattr(state, "like", None)
    batch, height, width = state["element"].shape if like is None else like["element"][1]
    return batch, height, width


class Job(NamedTuple):  # created at each call, faster than a frozen dataclass
    """Steps of a batch of worlds.

    `state` has one array per slot, in storage dtypes, and is not changed unless `reuse`. `params` are float64 [B], in
    a mapping that must not change: programs cache inputs by its identity. `draws`, int64 [B, H, W] below 2^bits,
    replace a stream's numbers; `passes` names the passes to run, None for all.
    """

    state: Mapping[str, Array]
    clock: Clock
    steps: int
    params: Mapping[str, Array]
    draws: Mapping[str, Array]
    passes: frozenset[str] | None
    reuse: bool = False
    """True if `state` may be overwritten because nothing reads it afterwards."""
    timing: PassClock | None = None
    """Measures the time of passes, in programs that can report it."""

    def tick(self, name: str) -> None:
        """Called by programs after each pass, and with ``""`` before the first one of a step."""
        if self.timing is not None:
            self.timing.tick(name)


def unavailable(backend: str, problem: str, help: str) -> CompileError:
    """The error (PD701) for a backend that does not run here."""
    notes = tuple(problem.splitlines())
    return failure("PD701", f"the {backend} backend is not available", notes=notes, helps=(help,))


class Runnable(Protocol):
    """A ruleset, or some of its passes, made executable."""

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""


class MixedProgram:
    """Parts that take turns. The whole state is unpacked and packed again between them."""

    def __init__(self, parts: Sequence[Runnable]):
        self.parts = parts

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        clock, state = job.clock, job.state
        for i in range(job.steps):
            now = clock._replace(since=clock.since + i)
            for part in self.parts:
                state = part.run(job._replace(state=state, clock=now, steps=1))
        return state


def mixed_program(
    segments: Sequence[Segment],
    packed: Callable[[Program, Program], Runnable],
    cells: Callable[[Program], Runnable],
) -> Runnable:
    """The program of some segments. A single segment needs no wrapper.

    `packed` makes the program of a segment from its numeric program and the same program on bit planes, `cells` that of
    a segment that bit planes cannot represent.
    """
    parts = [
        cells(segment.program) if segment.planes is None else packed(segment.program, segment.planes)
        for segment in segments
    ]
    return parts[0] if len(parts) == 1 else MixedProgram(parts)
