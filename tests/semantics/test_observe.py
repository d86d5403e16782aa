"""Ways out of a world: the same numbers on every backend, from packed memory and from tensors, in buffers of all sorts."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import powderdsl
from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import palette, rgb
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.testing.generators.cases import Choices, random_start
from tests.compilers import skip_without_compiler
from tests.fuzz import TARGETS
from tests.semantics.texts import load_text

BACKENDS = ("reference", *TARGETS)
SIZES = [(1, 1), (3, 33), (2, 64), (5, 65), (1, 130), (16, 70)]

KINDS = """\
pack: kinds
elements:
  vapour: {id: 0, color: "#102030", weight: 3}
  dust: {id: 1, color: "#FEDCBA", weight: 40000, heavy: yes}
  star: {id: 9, color: "#FFFFFF", luck: 0.3}
properties:
  weight: {type: 0..50000, default: 7}
  heavy: flag
  luck: chance
fields:
  charge: {type: -300..300, default: -300, at: place}
  level: {type: -100000..70000, default: 65535, at: place}
  small: {type: -8..7, at: element}
  lit: {type: flag, default: yes, at: place}
  seen: {type: element, default: star, at: place}
  heat: {type: real(-50..50), default: 1.5, at: place}
  drift: {type: vec2(-9..9), at: element}
streams: [coin]
passes:
  change:
    do:
      - charge += 1 where coin < 0.5
      - level -= 7 where coin < 0.5
      - small -= 1 where small > -8
      - lit := no where heavy
      - heat := heat / 3 where lit
      - dust -> vapour with chance 10%
"""


@cache
def rules_of(name: str) -> Ruleset:
    return load_text(KINDS) if name == "kinds" else powderdsl.load(name)


@cache
def simulator(name: str, backend: str) -> Simulator:
    skip_without_compiler(backend)
    return powderdsl.compile(rules_of(name), backend=backend)


def ways_out(world: World) -> dict[str, object]:
    """Every way out of a world, by name, as a function of a buffer."""
    names = [slot.name for slot in world.sim.slots] + [p.name for p in world.sim.ruleset.properties]
    ways: dict[str, object] = {
        f"read {name}": lambda out=None, name=name: world.read(name, out) for name in names
    }
    return ways | {"matrix": world.matrix, "rgb": world.rgb, "planes": world.planes, "compact": world.compact}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["kinds", "powderworld"])
def test_the_same_on_every_backend(name: str, backend: str, torch) -> None:  # type: ignore[no-untyped-def]
    """After a step (so that native worlds are packed), new or into the middle of a larger buffer, nothing else touched."""
    sim, oracle = simulator(name, backend), simulator(name, "reference")
    for number, (height, width) in enumerate(SIZES):
        start = random_start(sim.ruleset, Choices.seeded(number), (9 if width == 33 else 2, height, width))
        expected = ways_out(oracle.step(start.world(oracle), 2))
        world = sim.step(start.world(sim), 2)
        for way, look in ways_out(world).items():
            wanted = expected[way]()  # type: ignore[operator]
            large = torch.full((len(wanted) + 5, *wanted.shape[1:]), 77).to(wanted.dtype)
            out = large[3:-2]
            assert look(out) is out  # type: ignore[operator]
            assert out.dtype == wanted.dtype
            assert torch.equal(out, wanted), (way, height, width)
            assert bool((large[:3] == 77).all() & (large[-2:] == 77).all()), (way, height, width)
            assert torch.equal(look(), wanted), (way, height, width)  # type: ignore[operator]


def test_meaning(torch) -> None:  # type: ignore[no-untyped-def]
    """What the numbers are: palette colors, one-hot channels in the declared order, columns from the lowest bit."""
    sim = simulator("kinds", "torch")
    world = random_start(sim.ruleset, Choices.seeded(5), (2, 3, 70)).world(sim)
    assert np.array_equal(world.rgb().numpy(), rgb(world.ids.numpy(), palette(sim.ruleset.elements)))
    matrix, at = world.matrix(), sim.ruleset.slots
    assert torch.equal(matrix[:, :at].argmax(1).to(torch.uint8), world.ids)
    for name in dict.fromkeys(channel.source for channel in sim.ruleset.matrix[at:]):
        value = world[name].float()
        parts = value.unbind(1) if value.ndim == 4 else (value,)
        for part in parts:
            assert torch.equal(matrix[:, at], part), name
            at += 1
    assert at == matrix.shape[1]
    planes = world.planes()
    assert planes.shape == (2, len(sim.plane_names), 3, 2)
    names = [name.partition(":") for name in sim.plane_names]
    columns = torch.arange(128)
    bits = (planes.repeat_interleave(64, -1) >> columns % 64) & 1
    assert not bits[..., 70:].any()
    for slot in sim.slots:
        own = [i for i, (name, _, _) in enumerate(names) if name == slot.name]
        assert bool(own) != slot.is_real
        if own:
            assert [int(names[i][2] or 0) for i in own] == list(range(len(own)))
            value = sum(bits[:, i, :, :70] << n for n, i in enumerate(own))
            wrapped = world[slot.name].long() & (1 << len(own)) - 1
            assert torch.equal(value, wrapped), slot.name


@pytest.mark.parametrize("name", ["kinds", "powderworld"])
def test_bytes_stand_for_all_that_lasts(name: str, torch) -> None:  # type: ignore[no-untyped-def]
    """Exactly where 256 numbers suffice, else within a sixteenth of the value, and the matrix follows from them."""
    sim = simulator(name, "torch")
    world = sim.step(random_start(sim.ruleset, Choices.seeded(8), (2, 16, 70)).world(sim), 1)
    codes, values = world.compact(), sim.observer.compact_values
    assert codes.shape[1] == len(sim.observer.compact_names)
    for at, channel in enumerate(sim.observer.compact_names):
        base, _, part = channel.partition(".")
        wanted = world[base][:, ("row", "column").index(part)] if part else world[base]
        slot = next(one for one in sim.slots if one.name == base)
        found = values[at][codes[:, at].long()]
        if slot.dtype in ("uint8", "int8"):
            assert torch.equal(found, wanted.float()), channel
        else:
            least = max(abs(slot.kind.lo), abs(slot.kind.hi)) * 2.0**-17
            assert ((found - wanted).abs() <= wanted.abs() / 16 + least).all(), channel
            assert (values[at][128], values[at].diff().min() > 0) == (0, True)
    sources, tables = sim.observer.matrix_tables
    matrix = torch.stack([table[codes[:, at].long()] for at, table in zip(sources, tables, strict=True)], 1)
    assert len(sim.observer.matrix_names) == matrix.shape[1]
    wanted = world.matrix()
    assert ((matrix - wanted).abs() <= wanted.abs() / 16 + 2).all()
    assert torch.equal(matrix[:, : sim.ruleset.slots], wanted[:, : sim.ruleset.slots])


@pytest.mark.parametrize("backend", ["torch", "native"])
def test_buffers_that_do_not_fit(backend: str, torch) -> None:  # type: ignore[no-untyped-def]
    sim = simulator("kinds", backend)
    world = sim.step(random_start(sim.ruleset, Choices.seeded(5), (2, 3, 70)).world(sim))
    for way, look in ways_out(world).items():
        good = look()  # type: ignore[operator]
        other = torch.float64 if good.dtype != torch.float64 else torch.float32
        bad = {
            r"out must be torch\..* \[2, .*found .* \[1, ": good[:1],
            r"out must be torch\..*, found torch\.float64": good.to(other),
            r"out must be .* on cpu, found .* on meta": good.to("meta"),
            r"must be contiguous": good.repeat_interleave(2, -1)[..., ::2],
            r"worlds must not overlap": good[:1].expand(good.shape),
        }
        if backend == "torch" and way.startswith("read"):
            bad[r"must be contiguous.*strides"] = good.mT.contiguous().mT
        for message, out in bad.items():
            with pytest.raises(ValueError, match=message):
                look(out)  # type: ignore[operator]
        with pytest.raises(TypeError, match="out must be a torch tensor, found ndarray"):
            look(good.numpy())  # type: ignore[operator]
    with pytest.raises(KeyError, match="no field or property `wieght`; did you mean `weight`"):
        world.read("wieght", torch.zeros(2, 3, 70))


def test_packed_worlds_are_not_unpacked(torch) -> None:  # type: ignore[no-untyped-def]
    """Pictures, channels and planes come straight from native memory."""
    sim = simulator("kinds", "native")
    world = sim.step(sim.world(torch.ones(9, 5, 70, dtype=torch.uint8)))
    ids = torch.empty(9, 5, 70, dtype=torch.uint8)
    for look in (world.rgb, world.matrix, world.planes, lambda: world.read("element", ids)):
        look()
    assert not any(world.state.has(slot.name) for slot in sim.slots)
    assert torch.equal(ids, world.ids)
