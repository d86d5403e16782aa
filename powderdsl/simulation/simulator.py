"""Worlds and simulators, on torch tensors or on arrays without torch.

Worlds are immutable; every method returns a new one. Arrays are in the storage dtypes of `model.state`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from io import BytesIO
from operator import index
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.compiler import load
from powderdsl.model.state import (
    Slot,
    check_sides,
    fresh_values,
    property_dtype,
    property_values,
    slot_name,
    slots,
)
from powderdsl.model.types import Ruleset
from powderdsl.simulation import draw
from powderdsl.simulation.programs import array_kind, make_program
from powderdsl.simulation.state_checks import (
    check_ids,
    check_mapping,
    checked_parameter,
    checked_values,
    unknown_name,
    unknown_slot,
)
from powderdsl.system.cache import Memo
from powderdsl.system.packages import require
from powderdsl.targets.array_kind import Array
from powderdsl.targets.job import Clock, Job, PassClock, shape_of

if TYPE_CHECKING:
    from powderdsl.simulation.observe import Observer
    from powderdsl.targets.cpp.program import NativeProgram

MAX_CELLS = 1 << 31
LAST_STEP = (1 << 63) - 1
"""Maximum number of steps of a world."""
USUAL_SIDE = 400
BATCH_SIZES = 16
"""Number of batch sizes whose default parameters are cached."""


@dataclass(frozen=True, repr=False)
class World:
    """A batch of worlds of one ruleset, stored in torch tensors, or in arrays without torch.

    `Simulator.world` creates one. `sim` is its simulator. `state` has one array per slot, [B, H, W] or [B, 2, H, W] in
    the slot's dtype. `seed`, `index` and `step` (int64 [B]) determine the random numbers: equal values give the same
    future, in any batch. `step` is `since` steps after `start`, and no step of the batch is later than `since`.

    Raises:
        ValueError: a seed, index or start of another shape, dtype or device.
    """

    sim: Simulator
    state: Mapping[str, Array]
    seed: Array
    index: Array
    start: Array
    since: int = 0

    def __post_init__(self) -> None:
        batch, device = shape_of(self.state)[0], getattr(self.seed, "device", None)
        for name in ("seed", "index", "start"):
            array = getattr(self, name)
            fits = tuple(array.shape) == (batch,) and array.dtype == self.sim.kind.xp.int64
            if not fits or getattr(array, "device", None) != device:
                kind = f"int64 [{batch}], found {array.dtype} {list(array.shape)}"
                raise ValueError(f"a world's {name} must be {kind}")

    def __repr__(self) -> str:
        worlds, rows, columns = self.shape
        steps = " to ".join(str(end) for end in sorted({int(self.step.min()), int(self.step.max())}))
        return f"<World of {self.sim.ruleset.name}: {worlds} of {rows}×{columns} cells at step {steps}>"

    def _repr_png_(self) -> bytes:
        """The PNG picture shown in notebooks."""
        image, file = self.picture(), BytesIO()
        images = require("PIL.Image", "showing a world", "pip install pillow")
        images.frombytes("RGB", (image.shape[1], image.shape[0]), image.tobytes()).save(file, "PNG")
        return file.getvalue()

    @property
    def step(self) -> Array:
        """The number of steps of each world so far: int64 [B]."""
        return self.start + self.since

    @property
    def ids(self) -> Array:
        """Element ids, uint8 [B, H, W]."""
        return self.state["element"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(worlds, rows, columns)."""
        return shape_of(self.state)

    def __len__(self) -> int:
        """The number of worlds, B."""
        return int(self.seed.shape[0])  # without unpacking anything, nor torch's Python

    def __getitem__(self, name: str) -> Array:
        """A field or property by name: see `read`."""
        return self.read(name)

    def read(self, name: str, out: Array | None = None) -> Array:
        """Read a field or property: [B, H, W] in its dtype, or float32 [B, 2, H, W] as (rows, columns) of vectors.

        Args:
            name: its plain or qualified name.
            out: a tensor to write to and return, of the same shape, dtype and device, with each world contiguous. By
                default, the result is a new tensor or the world's own.

        Raises:
            KeyError: an unknown name.
            TypeError: `out` is not a tensor, or the world has no tensors.
            ValueError: `out` does not fit.
        """
        sim = self.sim
        if name not in sim.slot_by_name:
            name = slot_name(sim.ruleset, name)
        if name in sim.slot_by_name:
            return self.state[name] if out is None else sim.observer.read(self.state, name, out)
        prop = sim.ruleset.property(name)
        if prop is None:
            raise unknown_slot(sim.ruleset, name)
        table = sim.kind.put(property_values(sim.ruleset, name), property_dtype(prop))
        values = sim.kind.entries(table, self.ids)
        return values if out is None else sim.observer.buffer(out, self.shape, values.dtype).copy_(values)

    def matrix(self, out: Array | None = None) -> Array:
        """The channels of the ruleset's `matrix:`, float32 [B, C, H, W], named by `sim.observer.matrix_names`.

        Elements are one-hot. `out` and errors are as in `read`.
        """
        return self.sim.observer.matrix(self.state, out)

    def rgb(self, out: Array | None = None) -> Array:
        """Pictures in the elements' colors, uint8 [B, H, W, 3], one pixel per cell; see `read`."""
        return self.sim.observer.rgb(self.state, out)

    def picture(self, scale: int | None = None, most: int = 16) -> NDArray[np.uint8]:
        """Worlds side by side as one picture, uint8 [H', W', 3]; vectors tint cells as the rules declare.

        Args:
            scale: pixels per cell; the default gives about 400 pixels per side.
            most: maximum number of worlds shown.
        """
        ids, rules = self.ids[:most], self.sim.ruleset
        columns = math.ceil(math.sqrt(len(ids)))
        scale = scale or max(1, min(8, USUAL_SIDE // (max(self.shape[1:]) * columns)))
        fields = {name: self[name][:most] for name in draw.shown_fields(rules)}
        image = draw.rgb(ids, fields=fields, **draw.looks(rules.elements, rules.fields))
        images = draw.scale(image, scale)
        return images[0] if len(ids) == 1 else draw.contact_sheet(images, columns=columns)

    def count(self, element: str) -> Array:
        """The number of cells of an element, or of elements with a tag, in each world: int64 [B].

        Raises KeyError for an unknown name.
        """
        elements = self.sim.ruleset.elements
        ids = {entry.id for entry in elements if element in (entry.name, entry.qualified, *entry.tags)}
        if not ids:
            raise unknown_name("element", element, self.sim.elements)
        xp = self.sim.kind.xp
        cells = sum(xp.asarray(self.ids == number, dtype=xp.int64) for number in sorted(ids))
        return cells.reshape(len(self), -1).sum(-1)

    def compact(self, out: Array | None = None) -> Array:
        """All fields that persist between steps, uint8 [B, C, H, W], named by `sim.observer.compact_names`.

        `sim.observer.compact_values` has the value of each byte. `out` and errors are as in `read`.
        """
        return self.sim.observer.compact(self.state, out)

    def planes(self, out: Array | None = None) -> Array:
        """The bit planes of flags and integers, int64 [B, P, H, ⌈W/64⌉], named by `Simulator.plane_names`.

        Bit x % 64 of word x // 64 is column x; bits beyond the width are zero. Floats have no planes: `read` them.
        `out` and errors are as in `read`.
        """
        return self.sim.observer.planes(self.state, out)

    def with_state(self, state: Mapping[str, Array], **changes: Any) -> World:
        """These worlds with a new state; `changes` replaces other attributes.

        Faster than `dataclasses.replace`, and not checked.
        """
        world = object.__new__(World)
        world.__dict__.update(self.__dict__, state=state, **changes)
        return world

    def select(self, worlds: int | slice | Sequence[int] | Array) -> World:
        """Select worlds as a new batch; their random futures stay the same.

        Args:
            worlds: an index, a slice, indices, or flags, bool [B]. A negative index counts from the end.

        Raises:
            IndexError: the batch has no such world.
        """
        keys = [worlds] if isinstance(worlds, int) else worlds
        clock = {name: getattr(self, name)[keys] for name in ("seed", "index", "start")}
        return self.with_state({name: value[keys] for name, value in self.state.items()}, **clock)


class Simulator:
    """Runs one ruleset on one backend and device. Create it with `powderdsl.compile`, which takes the same arguments.

    Attributes:
        ruleset: the checked model.
        backend: the requested backend; `running` is the one that runs.
        device: the torch device of its worlds, or ``"cpu"`` without torch.
        kind: the kind of its worlds' arrays: torch tensors, or arrays without torch.
        slot_by_name: the arrays of a world's state, by name.
    """

    def __init__(
        self,
        ruleset: Ruleset,
        backend: str = "auto",
        device: Any = "cpu",
        threads: int = 1,
        *,
        tensors: bool = True,
        memo: Memo | None = None,
    ):
        self.ruleset, self.backend = ruleset, backend
        self.kind = array_kind(backend, device, tensors)
        self.device = self.kind.device
        self.slot_by_name: dict[str, Slot] = {slot.name: slot for slot in slots(ruleset)}
        self._options: dict[str, Any] = {"threads": threads, "tensors": tensors, "memo": memo}
        self.defaults = lru_cache(BATCH_SIZES)(self._default_parameters)
        """Default parameters by batch size. Programs cache the inputs of these mappings, which must not change."""
        self._program = make_program(ruleset, backend, self.kind, threads, memo)

    def __repr__(self) -> str:
        return f"<Simulator of {self.ruleset.name}: {len(self.elements)} elements, {self.running} on {self.device}>"

    def of(self, ruleset: Ruleset) -> Simulator:
        """A simulator of another ruleset on the same backend and device."""
        return Simulator(ruleset, self.backend, self.device, **self._options)

    @property
    def running(self) -> str:
        """The backend of the next step: for ``auto`` on the CPU, ``wasm`` (or ``torch``) or ``native``."""
        return str(getattr(self._program.latest, "running", self._program.name))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that name the backends that ``auto`` ran, and the reasons."""
        if self.backend == "auto" and self.running == "wasm" and self.kind.xp.__name__ != "torch":
            return ("wasm: native code takes torch and more work, or --backend native",)
        return tuple(getattr(self._program.latest, "notes", ()))

    def native(self, width: int) -> NativeProgram | None:
        """Return the native code for grids of a width that runs all passes, if it has been compiled."""
        find = getattr(self._program.whole, "native", None)
        return None if find is None else find(width)

    @cached_property
    def observer(self) -> Observer:
        """The reader of observations. Raises TypeError if worlds are not torch tensors."""
        from powderdsl.simulation.observe import Observer

        if self.kind.xp.__name__ != "torch":
            raise TypeError("observations require torch, but these worlds are compiled without it")
        return Observer(self.ruleset, self.device)

    @property
    def plane_names(self) -> tuple[str, ...]:
        """The names of the planes: a flag's name, or ``name:bit``; the last bit of a signed number is its sign."""
        return self.observer.plane_names

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
        return tuple(self.slot_by_name.values())

    def fresh_values(self, slot: Slot) -> Array:
        """The values of a slot in new cells, by element id, in the slot's dtype: [256] or [256, 2]."""
        return self.kind.put(fresh_values(self.ruleset, slot), slot.dtype)

    # Making worlds

    def world(self, ids: Any, seed: Any = 0, *, index: Any = None) -> World:
        """Create worlds from element ids.

        Args:
            ids: integers [B, H, W] or [H, W]; NumPy, torch or nested lists.
            seed: an integer of 0 or more for all worlds, or one per world.
            index: the number of each world among those with its seed; by default 0, 1, … for a common seed, 0 for a
                list of seeds.

        Raises:
            TypeError: ids, seeds or indices are not integers.
            ValueError: a wrong shape, ids that the ruleset does not have, sides that it does not allow, or more than
                MAX_CELLS cells; negative seeds or indices.
        """
        array, xp = self._integers(ids, "ids"), self.kind.xp
        if array.ndim == 2:
            array = array[None]
        shape = tuple(array.shape)
        if array.ndim != 3 or 0 in shape:
            raise ValueError(f"ids must have the shape [worlds, rows, columns], found {list(shape)}")
        batch, height, width = shape
        check_sides(self.ruleset, (height, width))
        if batch * height * width > MAX_CELLS:
            raise ValueError(f"{batch * height * width:,} cells are more than {MAX_CELLS:,}")
        check_ids(self.kind, array, "ids", self.ruleset)
        element = xp.asarray(array, dtype=xp.uint8)
        seeds = self._integers(seed, "seed")
        if index is None:
            index = range(batch) if seeds.ndim == 0 else [0] * batch
        state = {name: self._fresh(slot, element) for name, slot in self.slot_by_name.items()}
        clock = self.numbers(seeds, "seed", batch), self.numbers(index, "index", batch)
        return World(self, state, *clock, self.kind.put([0] * batch, "int64"))

    def _fresh(self, slot: Slot, ids: Array) -> Array:
        """The values of a slot in new cells of these elements."""
        values = self.kind.entries(self.fresh_values(slot), ids)
        return self.kind.contiguous(self.kind.xp.moveaxis(values, -1, 1)) if slot.planes == 2 else values

    def _renew(self, state: Mapping[str, Array], ids: Array, cells: Array) -> dict[str, Array]:
        """A state with fresh cells of the elements `ids`, uint8 [B, H, W], where `cells` is set."""
        new = dict(state)
        for name, slot in self.slot_by_name.items():
            if slot.travels:
                new[name] = self._where(slot, cells, self._fresh(slot, ids), state[name])
        return new

    def _where(self, slot: Slot, cells: Array, yes: Array, no: Array) -> Array:
        """The values of a slot, by cells bool [B, H, W]."""
        return self.kind.xp.where(cells[:, None] if slot.planes == 2 else cells, yes, no)

    def _integers(self, value: Any, name: str) -> Array:
        array = self.kind.convert(value, name)
        if self.kind.sort(array) != "int":
            raise TypeError(f"{name} must be integers, found {array.dtype}")
        return array

    def numbers(self, values: Any, name: str, batch: int) -> Array:
        """Integers of 0 or more, one for all worlds or one per world, as a new array int64 [B].

        Raises:
            TypeError: they are not integers.
            ValueError: a wrong shape, or a negative number. Messages call them `name`.
        """
        xp = self.kind.xp
        array = xp.asarray(self._integers(values, name), dtype=xp.int64)
        if array.ndim == 0:
            array = xp.broadcast_to(array, (batch,))
        if tuple(array.shape) != (batch,) or bool((array < 0).any()):
            rule = f"{name} must be one number of 0 or more, or {batch} of them"
            raise ValueError(f"{rule}, found shape {list(array.shape)}")
        return self.kind.copied(array)

    # Changing worlds

    def replace(self, world: World, /, **fields: Any) -> World:
        """The world with these fields set. New ids create fresh cells; other fields are set afterwards.

        Args:
            fields: by plain name, `ids` for the element: [B, H, W] (or [H, W], or one number for all); vectors
                [B, 2, H, W] as (rows, columns). Floats are clamped to the field's range.

        Raises:
            KeyError: an unknown field.
            TypeError: a wrong dtype; worlds whose arrays are of another kind.
            ValueError: a wrong shape, integers out of range, NaN or infinity, a value in cells whose element lacks the
                field, a property that no rule changes, or a world of other rules.
        """
        self.check(world)
        state, xp = dict(world.state), self.kind.xp
        new_ids = fields.pop("ids", None)
        if new_ids is not None:
            ids = self._broadcast(self._integers(new_ids, "ids"), "ids", world.shape)
            check_ids(self.kind, ids, "ids", self.ruleset)
            element = xp.asarray(ids, dtype=xp.uint8)
            state = self._renew(state, element, element != state["element"])
        for name, value in fields.items():
            slot = self._changeable_slot(name)
            array = self._broadcast(value, name, world.shape, slot.planes == 2)
            ids = state["element"]
            state[name] = checked_values(self.kind, array, ids, self._fresh(slot, ids), slot, self.ruleset)
        return replace(world, state=state)

    def _changeable_slot(self, name: str) -> Slot:
        """The slot of a field or property that cells can have values of. Raises KeyError, ValueError."""
        if name in self.slot_by_name:
            return self.slot_by_name[name]
        if self.ruleset.property(name) is None:
            raise unknown_slot(self.ruleset, name)
        raise ValueError(f"`{name}` follows from the element: no rule of {self.ruleset.name} changes it")

    def _broadcast(self, value: Any, name: str, shape: tuple[int, ...], vector: bool = False) -> Array:
        array = self.kind.convert(value, name)
        target = (shape[0], 2, *shape[1:]) if vector else shape
        if vector and array.ndim == 1 and len(array) == 2:
            array = array[None, :, None, None]
        try:
            return self.kind.xp.broadcast_to(array, target)
        except (RuntimeError, ValueError):
            shapes = f"{list(target)}, found {list(array.shape)}"
            raise ValueError(f"{name} must have the shape {shapes}") from None

    def paint(self, world: World, /, *, where: Any, element: str | None = None, **fields: Any) -> World:
        """Set the cells of a mask: to an element with fresh fields, to values of fields, or both.

        Args:
            where: bool [B, H, W] or [H, W], or an index of cells in all worlds, such as ``(slice(0, 8), slice(0, 8))``.
            element: the element's name, plain or qualified.
            fields: values by field name; vectors as (rows, columns).

        Raises:
            KeyError: an unknown element or field.
            TypeError: `where` is not bool, or a wrong dtype.
            ValueError: a wrong shape or value, as in `replace`.
        """
        xp = self.kind.xp
        if isinstance(where, tuple | slice):  # as arrays are indexed, in all worlds
            index, where = where, np.zeros(world.shape[1:], dtype=np.bool_)
            where[index] = True
        mask = self._broadcast(where, "where", world.shape)
        if self.kind.sort(mask) != "bool":
            raise TypeError(f"where must be a bool mask, found {mask.dtype}")
        if element is not None:
            painted = self.ruleset.element(element)
            if painted is None:
                raise unknown_name("element", element, self.elements)
            element_ids = xp.full_like(world.ids, painted.id)
            world = replace(world, state=self._renew(world.state, element_ids, mask))
        for name, value in fields.items():
            slot = self._changeable_slot(name)
            new = self._broadcast(value, name, world.shape, slot.planes == 2)
            both = (xp.asarray(values, dtype=xp.float64) for values in (new, world.state[name]))
            world = self.replace(world, **{name: self._where(slot, mask, *both)})
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
        """Run some steps and return the new world; the argument is not modified.

        Args:
            steps: the number of steps, 0 or more.
            random: draws to use instead of random numbers, by stream: [B, H, W] in [0, 1), rounded down to the stream's
                resolution. Every step uses the same draws.
            passes: run only these passes, in the ruleset's order.
            params: parameter values for this call, by name: one number, or one per world [B].
            reuse: overwrite the memory of `world`, which saves a copy. Do not use `world` afterwards.

        Raises:
            KeyError: unknown streams, passes or parameters.
            TypeError: an argument of a wrong type; worlds whose arrays are of another kind.
            ValueError: a wrong shape or value; worlds of other rules; steps beyond LAST_STEP.
        """
        self.check(world)
        steps, batch = _step_count(steps, world), world.seed.shape[0]
        values = self.defaults(batch) if params is None else self._parameters(params, batch)
        draws = self._draws(random, world) if random is not None else {}
        names = self._pass_names(passes) if passes is not None else None
        clock = Clock(world.seed, world.index, world.start, world.since)
        state = self._program.run(Job(world.state, clock, steps, values, draws, names, reuse))
        return world.with_state(state, sim=self, since=world.since + steps)

    def frames(self, world: World, steps: int, every: int = 1) -> Iterator[World]:
        """Yield the world at the start, every `every` steps, and after `steps` steps."""
        yield world
        for done in range(0, steps, every):
            world = self.step(world, min(every, steps - done))
            yield world

    def _pass_names(self, passes: Sequence[str]) -> frozenset[str]:
        if isinstance(passes, str):
            raise TypeError(f"passes takes a list of names: [{passes!r}]")
        unknown = [name for name in passes if name not in self.passes]
        if unknown:
            raise unknown_name("pass", unknown[0], self.passes, "passes")
        return frozenset(passes)

    def check(self, world: Any) -> None:
        """Raise TypeError unless `world` is a world of these arrays, ValueError if it belongs to other rules."""
        if not isinstance(world, World):
            raise TypeError(f"world must be a World, found {type(world).__name__}")
        if world.sim is self:
            return
        if world.sim.kind.xp is not self.kind.xp:
            raise TypeError(f"this world has arrays of {world.sim.kind.xp.__name__}")
        if world.sim.ruleset is not self.ruleset and world.sim.ruleset != self.ruleset:
            raise ValueError(f"this world belongs to {world.sim.ruleset.name}, not to {self.ruleset.name}")

    def _draws(self, random: Mapping[str, Any], world: World) -> dict[str, Array]:
        """Given draws as integers k below 2^bits, which stand for (k + ½) / 2^bits: int64 [B, H, W]."""
        bits = {stream.name: stream.bits for stream in self.ruleset.streams}
        draws, xp = {}, self.kind.xp
        for name, value in check_mapping("random", random).items():
            if name not in bits:
                raise unknown_name("stream", name, bits)
            array = xp.asarray(self._broadcast(value, f"random[{name!r}]", world.shape), dtype=xp.float64)
            if not bool(((array >= 0) & (array < 1)).all()):
                raise ValueError(f"random[{name!r}] must lie in [0, 1)")
            draws[name] = xp.asarray(xp.floor(array * float(1 << bits[name])), dtype=xp.int64)
        return draws

    def parameters(self, params: Mapping[str, Any], batch: int) -> dict[str, Array]:
        """All parameters of `batch` worlds by name, new arrays float64 [B]: `params`, as in `step`, and defaults.

        Raises:
            KeyError, TypeError, ValueError: as in `step`.
        """
        return {name: self.kind.copied(value) for name, value in self._parameters(params, batch).items()}

    def _default_parameters(self, batch: int) -> Mapping[str, Array]:
        params = self.ruleset.params
        return {param.name: self.kind.put([float(param.default)] * batch, "float64") for param in params}

    def _parameters(self, params: Mapping[str, Any], batch: int) -> Mapping[str, Array]:
        """Like `parameters`, but defaults share memory. Raises KeyError, TypeError, ValueError."""
        values, by_name = self.defaults(batch), {param.name: param for param in self.ruleset.params}
        for name, value in check_mapping("params", params).items():
            if name not in by_name:
                raise unknown_name("parameter", name, by_name)
            values = {**values, name: checked_parameter(self.kind, value, by_name[name], batch)}
        return values

    def profile(self, world: World, steps: int = 1) -> dict[str, float]:
        """Measure the seconds of each pass over some steps, in order; empty if the backend cannot measure passes.

        Native code reports processor time of one thread. Raises TypeError and ValueError as `step` does.
        """
        self.check(world)
        timing, params = PassClock(self.device), self.defaults(len(world))
        clock = Clock(world.seed, world.index, world.start, world.since)
        self._program.run(Job(world.state, clock, _step_count(steps, world), params, {}, None, timing=timing))
        return {name: timing.seconds[name] for name in self.passes} if timing.seconds else {}


def compile(
    ruleset: Ruleset | str,
    backend: str = "auto",
    device: Any = "cpu",
    threads: int = 1,
    *,
    tensors: bool = True,
    memo: Memo | None = None,
) -> Simulator:
    """Compile a ruleset into a simulator.

    Args:
        ruleset: from `load`, or a name to load.
        backend: one of `BACKENDS`; all compute the same worlds, bit for bit.
        device: a torch device: ``"cpu"``, ``"cuda"``, ``"cuda:1"``.
        threads: the number of threads of native code, among which a batch is split. Torch has its own setting.
        tensors: if true, worlds have torch tensors whenever torch is installed; otherwise, only if the backend or the
            device needs torch.
        memo: a cache of compiled passes, to share between rulesets.

    Raises:
        CompileError: as `load`; PD701 if the backend or the device is not available.
        TypeError: `ruleset` is neither a ruleset nor a name.
    """
    model = load(ruleset) if isinstance(ruleset, str) else ruleset
    if not isinstance(model, Ruleset):
        raise TypeError(f"ruleset must be a Ruleset or a name, found {type(model).__name__}")
    return Simulator(model, backend, device, threads, tensors=tensors, memo=memo)


def _step_count(value: Any, world: World) -> int:
    """Return an integer, Python's or NumPy's. Raises ValueError if it is negative or takes a world beyond LAST_STEP."""
    try:
        number = index(value)
    except TypeError:
        number = -1
    if number < 0 or isinstance(value, bool):
        raise ValueError(f"steps must be an integer of 0 or more, found {value!r}")
    if world.since + number > LAST_STEP:
        raise ValueError(f"step {world.since + number:,} is beyond the last one, {LAST_STEP:,}")
    return number
