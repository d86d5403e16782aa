"""Worlds and the simulator: state in, state out. Worlds are immutable; every method returns a new one.

All arrays are torch tensors on the simulator's device, in the storage dtypes of `model.state`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from powderdsl.compiler import BACKENDS, current_backend, load, starting_backend
from powderdsl.model.state import Slot, check_sides
from powderdsl.model.types import Ruleset
from powderdsl.simulation.observe import Observer
from powderdsl.simulation.parameters import Parameters
from powderdsl.simulation.programs import find_device, make_program
from powderdsl.simulation.state_checks import (
    check_ids,
    checked_floats,
    checked_integers,
    given_mapping,
    given_tensor,
    looked_up,
    unknown_name,
)
from powderdsl.system.writing import failure
from powderdsl.targets.job import Clock, Job, shape_of
from powderdsl.targets.profiling import profile_of

MAX_CELLS = 1 << 31


@dataclass(frozen=True)
class World:
    """A batch of worlds of one ruleset.

    `state` has one tensor a slot; `seed`, `index` and `step` (int64 [B]) decide the random numbers: the same three
    give the same future, alone or in any batch.
    """

    sim: Simulator
    state: Mapping[str, Tensor]
    seed: Tensor
    index: Tensor
    step: Tensor

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The step of a world that a simulator has made, counted when it is first read."""
            clock = self.__dict__.get("_clock")
            if name != "step" or clock is None:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return self.__dict__.setdefault("step", clock.start + clock.since)

    @property
    def ids(self) -> Tensor:
        """Element ids, uint8 [B, H, W]."""
        return self.state["element"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(worlds, rows, columns)."""
        return shape_of(self.state)

    def __len__(self) -> int:
        return int(self.seed.shape[0])  # without unpacking anything, nor torch's Python

    def __getitem__(self, name: str) -> Tensor:
        """A field or property by name, or KeyError: [B, H, W], or float32 [B, 2, H, W] as (rows, columns) of vectors."""
        return self.read(name)

    def with_state(self, state: Mapping[str, Tensor]) -> World:
        """These worlds in another state, at the same step with the same random futures."""
        world = object.__new__(World)
        world.__dict__.update(self.__dict__, state=state)
        return world

    def select(self, worlds: int | slice | Sequence[int] | Tensor) -> World:
        """Some worlds of the batch, with their random futures unchanged."""
        keys = [worlds] if isinstance(worlds, int) else worlds
        chosen = {name: value[keys] for name, value in self.state.items()}
        return replace(self, state=chosen, seed=self.seed[keys], index=self.index[keys], step=self.step[keys])

    def read(self, name: str, out: Tensor | None = None) -> Tensor:
        """`world[name]`, written into `out`.

        Args:
            out: written to and returned, instead of a new tensor or the world's own: of the same shape, dtype and
                device, each of its worlds contiguous. The methods below take one too.

        Raises:
            KeyError: an unknown name. TypeError, ValueError: `out` is not a tensor, or does not fit.
        """
        return self.sim.observer.read(self.state, name, out)

    def matrix(self, out: Tensor | None = None) -> Tensor:
        """All channels of the ruleset's `matrix:` as float32 [B, C, H, W]: elements one-hot, then fields."""
        return self.sim.observer.matrix(self.state, out)

    def rgb(self, out: Tensor | None = None) -> Tensor:
        """Pictures in the elements' colors, a pixel a cell: uint8 [B, H, W, 3]."""
        return self.sim.observer.rgb(self.state, out)

    def compact(self, out: Tensor | None = None) -> Tensor:
        """Everything that lasts from step to step, as bytes: uint8 [B, C, H, W]. `sim.observer.compact_names` has their names."""
        return self.sim.observer.compact(self.state, out)

    def planes(self, out: Tensor | None = None) -> Tensor:
        """Flags and integers in bits: int64 [B, P, H, ⌈W/64⌉].

        Bit x % 64 of word x // 64 is column x; bits beyond the width are zero. The planes are those of
        `Simulator.plane_names`. Fields of floats have none: `read` them.
        """
        return self.sim.observer.planes(self.state, out)


class Simulator:
    """Runs one ruleset on one backend and device. Made by `powderdsl.compile`."""

    def __init__(self, ruleset: Ruleset, backend: str, device: str | torch.device, threads: int = 1):
        self.ruleset = ruleset
        self.backend = backend
        self.device = find_device(device)
        self.observer = Observer(ruleset, self.device)
        self._slots: dict[str, Slot] = self.observer.slots
        self._program = make_program(ruleset, backend, self.device, threads)
        self._params = Parameters(ruleset, self.device)

    @property
    def running(self) -> str:
        """The backend that the next step runs on: for ``auto`` on the CPU, ``wasm`` (or ``torch``) or ``native``."""
        at_once = starting_backend(self.device.type) if self.backend == "auto" else self.backend
        return str(getattr(self._program, "running", at_once))

    @property
    def notes(self) -> tuple[str, ...]:
        """For ``auto``: sentences about which backend ran, and why."""
        return tuple(getattr(self._program, "notes", ()))

    @property
    def elements(self) -> tuple[str, ...]:
        """The elements' names in id order."""
        return tuple(element.name for element in self.ruleset.elements)

    @property
    def passes(self) -> tuple[str, ...]:
        """The passes' names in the order they run."""
        return tuple(p.name for p in self.ruleset.passes)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The arrays of a world's state."""
        return tuple(self._slots.values())

    # Making worlds

    def world(self, ids: Any, seed: Any = 0, *, index: Any = None) -> World:
        """Fresh worlds from element ids.

        Args:
            ids: integers [B, H, W] or [H, W]; NumPy, torch or nested lists.
            seed: one integer for all, or one a world.
            index: which world of its seed each is; 0, 1, … for one common seed, 0 for seeds of their own.

        Raises:
            TypeError: ids are not integers. ValueError: wrong shape, or ids that the ruleset does not have.
        """
        tensor = self._integers(ids, "ids")
        if tensor.ndim == 2:
            tensor = tensor[None]
        if tensor.ndim != 3 or 0 in tensor.shape:
            raise ValueError(f"ids must have the shape [worlds, rows, columns], found {list(tensor.shape)}")
        check_sides(self.ruleset, (int(tensor.shape[1]), int(tensor.shape[2])))
        if tensor.numel() > MAX_CELLS:
            raise ValueError(f"{tensor.numel():,} cells are more than {MAX_CELLS:,}")
        check_ids(tensor, "ids", self.ruleset)
        element = tensor.to(torch.uint8)
        batch = len(element)
        seeds = self._integers(seed, "seed")
        if index is None:
            index = range(batch) if seeds.ndim == 0 else [0] * batch
        return World(
            self,
            {name: self._fresh(slot, element) for name, slot in self._slots.items()},
            self._numbers(seeds, "seed", batch),
            self._numbers(self._integers(index, "index"), "index", batch),
            torch.zeros(batch, dtype=torch.int64, device=self.device),
        )

    def _fresh(self, slot: Slot, ids: Tensor) -> Tensor:
        """A slot's values in new cells of these elements."""
        if slot.name == "element":
            return ids.clone()
        prop = self.ruleset.property(slot.name)
        dtype = getattr(torch, slot.dtype)
        if prop is not None:
            return looked_up(self.observer.table(prop.name), ids, dtype)
        values = torch.tensor([slot.fresh(i) for i in range(256)], dtype=dtype, device=self.device)
        return looked_up(values, ids, dtype)

    def _renewed(self, state: Mapping[str, Tensor], ids: Tensor, cells: Tensor) -> dict[str, Tensor]:
        """A state with fresh cells of the elements `ids`, uint8 [B, H, W], where `cells` is set."""
        return {
            name: _where(slot, cells, self._fresh(slot, ids), state[name]) if slot.travels else state[name]
            for name, slot in self._slots.items()
        }

    def _integers(self, value: Any, name: str) -> Tensor:
        tensor = given_tensor(value, name, self.device)
        if tensor.dtype.is_floating_point or tensor.dtype.is_complex or tensor.dtype == torch.bool:
            raise TypeError(f"{name} must be integers, found {tensor.dtype}")
        return tensor

    def _numbers(self, tensor: Tensor, name: str, batch: int) -> Tensor:
        """Integers of 0 or more, one a world: int64 [B] in memory of their own."""
        tensor = tensor.to(torch.int64)
        if tensor.ndim == 0:
            tensor = tensor.expand(batch)
        if tensor.shape != (batch,) or bool((tensor < 0).any()):
            raise ValueError(
                f"{name} must be one number of 0 or more, or {batch} of them, found shape {list(tensor.shape)}"
            )
        return tensor.clone()

    # Reading and changing worlds

    @property
    def plane_names(self) -> tuple[str, ...]:
        """What the planes are: a flag's name, or ``name:bit`` from bit 0; the last bit of a signed number is its sign."""
        return self.observer.plane_names

    def replace(self, world: World, **fields: Any) -> World:
        """The world with these fields set. New ids make fresh cells; other fields are set after that.

        Args:
            fields: by name: [B, H, W] (or [H, W], or one number for all); vectors [B, 2, H, W] as (rows, columns).

        Raises:
            KeyError: an unknown field. TypeError, ValueError: wrong dtype, shape, range, NaN, or a value where the
                element cannot hold one.
        """
        state = dict(world.state)
        if "ids" in fields or "element" in fields:
            given = fields.pop("ids", None) if "ids" in fields else fields.pop("element")
            ids = self._shaped(self._integers(given, "ids"), "ids", world.shape, False)
            check_ids(ids, "ids", self.ruleset)
            element = ids.to(torch.uint8)
            state = self._renewed(state, element, element != state["element"])
        for name, value in fields.items():
            if name not in self._slots:
                prop = self.ruleset.property(name)
                if prop is None:
                    world.read(name)
                if not torch.equal(
                    self._shaped(value, name, world.shape, False).double(),
                    self.observer.table(name)[state["element"].long()],
                ):
                    raise ValueError(
                        f"`{name}` follows from the element here: no rule of {self.ruleset.name} changes it"
                    )
                continue
            state[name] = self._checked(self._slots[name], value, state["element"])
        return replace(world, state=state)

    def _shaped(self, value: Any, name: str, shape: tuple[int, ...], vector: bool) -> Tensor:
        tensor = given_tensor(value, name, self.device)
        target = (shape[0], 2, *shape[1:]) if vector else shape
        if vector and tensor.ndim == 1 and len(tensor) == 2:
            tensor = tensor[None, :, None, None]
        try:
            return tensor.broadcast_to(target)
        except RuntimeError:
            raise ValueError(
                f"{name} must have the shape {list(target)}, found {list(tensor.shape)}"
            ) from None

    def _checked(self, slot: Slot, value: Any, ids: Tensor) -> Tensor:
        tensor = self._shaped(value, slot.name, tuple(ids.shape), slot.planes == 2)
        if tensor.dtype.is_complex:
            raise TypeError(f"{slot.name} takes floats, found {tensor.dtype}")
        if slot.is_real:
            return checked_floats(tensor, slot)
        usual = None if self.ruleset.property(slot.name) is None else self.observer.table(slot.name)
        return checked_integers(tensor, ids, slot, usual, self.ruleset)

    def paint(self, world: World, *, where: Any, element: str | None = None, **fields: Any) -> World:
        """Set cells of a mask: fresh cells of an element, and values of fields.

        Args:
            where: bool [B, H, W] or [H, W].
            element: the element's name, plain or qualified.
            fields: values by field name; vectors as (rows, columns).

        Raises:
            KeyError: an unknown element or field. ValueError: a wrong shape or value.
        """
        mask = self._shaped(where, "where", world.shape, False)
        if mask.dtype != torch.bool:
            raise TypeError(f"where must be a bool mask, found {mask.dtype}")
        if element is not None:
            found = self.ruleset.element(element)
            if found is None:
                raise unknown_name("element", element, self.elements)
            element_ids = torch.full_like(world.ids, found.id)
            world = replace(world, state=self._renewed(world.state, element_ids, mask))
        for name, value in fields.items():
            if name not in self._slots:
                world.read(name)
                raise ValueError(f"`{name}` follows from the element: it cannot be painted")
            slot = self._slots[name]
            new = self._shaped(value, name, world.shape, slot.planes == 2)
            painted = _where(slot, mask, new.to(torch.float64), world.state[name].to(torch.float64))
            world = self.replace(world, **{name: painted})
        return world

    # Running

    def step(
        self,
        world: World,
        steps: int = 1,
        *,
        random: Mapping[str, Any] | None = None,
        passes: Sequence[str] | None = None,
        params: Mapping[str, Any] | None = None,
        reuse: bool = False,
    ) -> World:
        """The world some steps later; the argument stays as it was.

        Args:
            steps: how many, 0 or more.
            random: draws to use instead of our own, by stream: [B, H, W] in [0, 1). A draw r counts as the draw of
                the stream's resolution that it falls into. The same draws serve every step.
            passes: run only these passes, in the ruleset's order.
            params: parameter values for this call, one number each or [B] values, one a world.
            reuse: the memory of `world` may be written to, and it must not be used afterwards: saves a copy.

        Raises:
            KeyError: unknown streams, passes or parameters. ValueError: wrong shapes or values.
        """
        self.check(world)
        steps = _count(steps, "steps")
        draws: Mapping[str, Tensor] = _NOTHING
        chosen = None
        clock = _clock_of(world)
        batch = clock.seed.shape[0]
        if params is None:
            values = self._params.defaults(batch)
        else:
            values = self._params.checked(given_mapping("params", params), batch)
        if random is not None:
            draws = self._draws(given_mapping("random", random), world)
        if passes is not None:
            chosen = self._chosen(passes)
        state = self._program.run(Job(world.state, clock, steps, values, draws, chosen, reuse))
        return _stepped(self, state, clock, steps)

    def _chosen(self, passes: Sequence[str]) -> frozenset[str]:
        if isinstance(passes, str):
            raise TypeError(f"passes takes a list of names: [{passes!r}]")
        unknown = [name for name in passes if name not in self.passes]
        if unknown:
            raise unknown_name("pass", unknown[0], self.passes, "passes")
        return frozenset(passes)

    def check(self, world: Any) -> None:
        """Raises TypeError for what is not a world, ValueError for a world of other rules."""
        if not isinstance(world, World):
            raise TypeError(f"world must be a World, found {type(world).__name__}")
        if world.sim.ruleset is not self.ruleset and world.sim.ruleset != self.ruleset:
            raise ValueError(f"this world belongs to {world.sim.ruleset.name}, not to {self.ruleset.name}")

    def profile(self, world: World, steps: int = 1) -> dict[str, float]:
        """Seconds that each pass takes over some steps, in the order they run; empty if the backend cannot report them.

        Native code counts processor time on one thread, and is compiled once more for it.
        """
        params = self._params.defaults(len(world))
        job = Job(world.state, _clock_of(world), _count(steps, "steps"), params, {}, None)
        seconds = profile_of(self._program, job)
        return {name: seconds.get(name, 0.0) for name in self.passes} if seconds else {}

    def _draws(self, random: Mapping[str, Any], world: World) -> dict[str, Tensor]:
        """Given draws as integers k below 2^bits, which stand for (k + ½) / 2^bits: int64 [B, H, W]."""
        bits = {stream.name: stream.bits for stream in self.ruleset.streams}
        draws = {}
        for name, value in random.items():
            if name not in bits:
                raise unknown_name("stream", name, bits)
            tensor = self._shaped(value, f"random[{name!r}]", world.shape, False).to(torch.float64)
            if not bool(((tensor >= 0) & (tensor < 1)).all()):
                raise ValueError(f"random[{name!r}] must lie in [0, 1)")
            draws[name] = (tensor * float(1 << bits[name])).floor().to(torch.int64)
        return draws

    def parameters(self, params: Mapping[str, Any], batch: int) -> dict[str, Tensor]:
        """All parameters as float64 [B]: given values, and defaults. Raises KeyError, TypeError, ValueError."""
        return {name: value.clone() for name, value in self._params.checked(params, batch).items()}


_NOTHING: Mapping[str, Tensor] = {}


def _clock_of(world: World) -> Clock:
    """What decides the random numbers of a world's next step. Raises ValueError for tensors that do not fit.

    A world that a simulator has made has a clock whose `start` nobody else sees, until its `step` is read: that tensor
    may have been written to, so it counts from then on.
    """
    known = world.__dict__
    clock: Clock | None = known.get("_clock")
    if clock is not None and "step" not in known:
        return clock
    batch, device = shape_of(world.state)[0], world.seed.device
    for name in ("seed", "index", "step"):
        tensor = getattr(world, name)
        if tensor.shape != (batch,) or tensor.dtype != torch.int64 or tensor.device != device:
            raise ValueError(
                f"a world's {name} must be int64 [{batch}], found {tensor.dtype} {list(tensor.shape)}"
            )
    return Clock(world.seed, world.index, world.step.clone())


def _stepped(sim: Simulator, state: Mapping[str, Tensor], clock: Clock, steps: int) -> World:
    """The world of a state that is some steps after a clock; made without the calls that a frozen dataclass takes."""
    world = object.__new__(World)
    known = world.__dict__
    known["sim"], known["state"], known["seed"], known["index"] = sim, state, clock.seed, clock.world
    known["_clock"] = Clock(clock.seed, clock.world, clock.start, clock.since + steps)
    return world


def _where(slot: Slot, cells: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """`torch.where` for the values of a slot, by cells bool [B, H, W]."""
    return torch.where(cells[:, None] if slot.planes == 2 else cells, yes, no)


def _count(value: Any, name: str) -> int:
    """An integer of 0 or more, Python's or NumPy's."""
    try:
        number = index(value)
    except TypeError:
        number = -1
    if number < 0 or isinstance(value, bool):
        raise ValueError(f"{name} must be an integer of 0 or more, found {value!r}")
    return number


def compile(
    ruleset: Ruleset | str, backend: str = "auto", device: str = "cpu", threads: int = 1
) -> Simulator:
    """A simulator that runs a ruleset.

    Args:
        ruleset: from `load` (or a name to load).
        backend: one of `BACKENDS`; all give the same worlds, bit for bit.
        device: a torch device: ``"cpu"``, ``"cuda"``, ``"cuda:1"``.
        threads: for native code, which shares a batch out among them. Torch has its own setting.

    Raises:
        CompileError: PD701 if the backend or the device is not available.
    """
    model = load(ruleset) if isinstance(ruleset, str) else ruleset
    if not isinstance(model, Ruleset):
        raise TypeError(f"ruleset must be a Ruleset or a name, found {type(model).__name__}")
    backend = current_backend(backend)
    if backend not in BACKENDS:
        raise failure("PD701", f"no backend `{backend}`", helps=("backends: " + ", ".join(BACKENDS),))
    return Simulator(model, backend, device, threads)
