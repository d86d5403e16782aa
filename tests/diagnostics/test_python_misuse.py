"""Wrong arguments to the Python API: an error of Python's that names the argument, or a CompileError."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

import powderdsl
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.simulation.simulator import Simulator
from tests.refusals import refused_codes

NAN = float("nan")
SHAPE = (2, 4, 5)


LIBRARY = ["torch"]
"""The library of the arrays that calls are made with."""


def simulator() -> Any:
    return simulator_of(LIBRARY[0])


@cache
def simulator_of(library: str, rules: str = "powderworld") -> Any:
    ruleset = powderdsl.load(rules)
    if library == "arrays":
        return Simulator(ruleset, backend="reference", tensors=False)
    return powderdsl.compile(ruleset, backend="reference")


def world() -> Any:
    return world_of(LIBRARY[0])


@cache
def world_of(library: str) -> Any:
    return simulator_of(library).world(np.zeros(SHAPE, np.uint8))


def life() -> Any:
    return simulator_of(LIBRARY[0], "life").world(np.zeros(SHAPE, np.uint8))


@pytest.fixture(params=["torch", "arrays"])
def library(request: pytest.FixtureRequest) -> Iterator[None]:
    LIBRARY[0] = request.param
    yield
    LIBRARY[0] = "torch"


def full(value: Any, *shape: int) -> np.ndarray:
    return np.full(shape or SHAPE, value)


def make(ids: Any, **rest: Any) -> Callable[[], Any]:
    return lambda: simulator().world(ids, **rest)


def replace(**fields: Any) -> Callable[[], Any]:
    return lambda: simulator().replace(world(), **fields)


def paint(where: Any = None, **fields: Any) -> Callable[[], Any]:
    mask = full(True, 4, 5) if where is None else where
    return lambda: simulator().paint(world(), where=mask, **fields)


def step(**rest: Any) -> Callable[[], Any]:
    return lambda: simulator().step(world(), **rest)


def env(**how: Any) -> Callable[[], Any]:
    return lambda: TensorEnv("sand-pushing", **how)


ROWS: list[tuple[str, Callable[[], Any], type[Exception], str]] = [
    # what is done, how, what is raised, what the message names
    ("ids that are fractions", make(full(0.5)), TypeError, "ids"),
    ("a ledger of a name", lambda: powderdsl.ledger("core"), TypeError, "Ruleset"),  # type: ignore[arg-type]
    ("a ledger of nothing", lambda: powderdsl.ledger(None), TypeError, "Ruleset"),  # type: ignore[arg-type]
    ("saving nothing", lambda: powderdsl.save(None, "x.npz"), TypeError, "World"),  # type: ignore[arg-type]
    (
        "loading into rules",
        lambda: powderdsl.load_world("x.npz", simulator().ruleset),
        TypeError,
        "Simulator",
    ),
    ("a thousand million worlds", env(num_envs=10**9), ValueError, "num_envs"),
    ("ids that are flags", make(full(True)), TypeError, "ids"),
    ("ids that are text", make("sand"), TypeError, "ids"),
    ("ids in one dimension", make([0, 1]), ValueError, "ids"),
    ("ids in four dimensions", make(full(0, 1, 1, 1, 1)), ValueError, "ids"),
    ("ids of no world", make(full(0, 0, 4, 4)), ValueError, "ids"),
    ("ragged ids", make([[0, 1], [0]]), TypeError, "ids"),
    ("ids below 0", make(full(-1)), ValueError, "ids[0, 0, 0] is -1"),
    ("ids of no element", make(full(14)), ValueError, "ids[0, 0, 0] is 14"),
    ("ids above 255", make(full(256)), ValueError, "ids[0, 0, 0] is 256"),
    ("a seed below 0", make(full(0), seed=-1), ValueError, "seed"),
    ("a seed that is a fraction", make(full(0), seed=1.5), TypeError, "seed"),
    ("a seed beyond 64 bits", make(full(0), seed=1 << 64), TypeError, "seed"),
    ("too many seeds", make(full(0), seed=[1, 2, 3]), ValueError, "seed"),
    ("too few places", make(full(0), index=[0]), ValueError, "index"),
    ("a place below 0", make(full(0), index=[-1, 0]), ValueError, "index"),
    ("an unknown field", lambda: world()["velocty"], KeyError, "did you mean `velocity`?"),
    ("a field by number", lambda: world()[0], KeyError, "`0`"),
    ("another field", replace(velocty=0), KeyError, "did you mean `velocity`?"),
    ("a velocity of NaN", replace(velocity=full(NAN, 2, 2, 4, 5)), ValueError, "velocity"),
    ("a velocity of three parts", replace(velocity=(1, 2, 3)), ValueError, "velocity"),
    ("a velocity of another size", replace(velocity=full(0.0, 2, 2, 4, 6)), ValueError, "velocity"),
    ("a momentum out of range", replace(momentum=full(99)), ValueError, "momentum takes -10..10"),
    ("a momentum of halves", replace(momentum=full(0.5)), TypeError, "momentum"),
    ("a momentum that is text", replace(momentum="up"), TypeError, "momentum"),
    ("other ids of no element", replace(ids=full(77)), ValueError, "ids[0, 0, 0] is 77"),
    ("other ids of another size", replace(ids=full(0, 3, 4, 5)), ValueError, "ids"),
    ("a clone of no element", replace(clone=full(77)), ValueError, "clone[0, 0, 0] is 77"),
    ("a clone where none can be", replace(clone=full(2)), ValueError, "clone can only differ"),
    ("gravity where it is fixed", replace(gravity=full(0)), ValueError, "gravity can only differ"),
    ("a density", replace(density=full(0)), ValueError, "`density` follows from the element"),
    ("ids of other rules", lambda: simulator().replace(life(), ids=0), ValueError, "belongs to life"),
    ("the time of other rules", lambda: simulator().profile(life()), ValueError, "belongs to life"),
    ("an unknown element", paint(element="snd"), KeyError, "did you mean `sand`?"),
    ("an element unlike all others", paint(element="zzzzzz"), KeyError, "no element `zzzzzz`"),
    ("a mask of numbers", paint(where=full(1.0, 4, 5), element="sand"), TypeError, "where"),
    ("a mask of another size", paint(where=full(True, 4, 6), element="sand"), ValueError, "where"),
    ("a painted velocity of NaN", paint(velocity=(NAN, 0)), ValueError, "velocity"),
    ("a painted property", paint(density=3), ValueError, "`density` follows from the element"),
    ("an unknown painted field", paint(velocty=(1, 2)), KeyError, "did you mean `velocity`?"),
    ("steps backwards", step(steps=-1), ValueError, "steps"),
    ("half a step", step(steps=0.5), ValueError, "steps"),
    ("a step of nothing", lambda: simulator().step(None), TypeError, "world"),
    ("an unknown pass", step(passes=["gravty"]), KeyError, "did you mean `gravity`?"),
    ("passes that are text", step(passes="gravity"), TypeError, "passes takes a list"),
    ("an unknown stream", step(random={"movment": full(0.0)}), KeyError, "did you mean `movement`?"),
    ("draws of 1", step(random={"movement": full(1.0)}), ValueError, "random['movement']"),
    ("draws of another size", step(random={"movement": full(0.0, 2, 4)}), ValueError, "random['movement']"),
    ("draws in a list", step(random=[full(0.0)]), TypeError, "random takes a mapping"),
    ("an unknown parameter", step(params={"water.mlt": 0.1}), KeyError, "did you mean `water.melt`?"),
    ("a parameter out of range", step(params={"water.melt": 2}), ValueError, "water.melt takes 0..1"),
    ("too many parameters", step(params={"water.melt": [0.1, 0.2, 0.3]}), ValueError, "water.melt"),
    ("a parameter that is text", step(params={"water.melt": "5%"}), TypeError, "water.melt"),
    ("parameters in a list", step(params=["water.melt"]), TypeError, "params takes a mapping"),
    ("parameters of nothing", lambda: powderdsl.load("life", params=5), TypeError, "params takes a mapping"),
    ("rules that are a number", lambda: powderdsl.compile(3), TypeError, "ruleset"),  # type: ignore[arg-type]
]

DIAGNOSTICS: list[tuple[str, Callable[[], Any], str]] = [
    ("another parameter", lambda: powderdsl.load("powderworld", params={"water.mlt": 1}), "PD309"),
    ("a parameter by number", lambda: powderdsl.load("powderworld", params={3: 4}), "PD309"),
    ("no value", lambda: powderdsl.load("powderworld", params={"water.melt": None}), "PD402"),
    ("NaN", lambda: powderdsl.load("powderworld", params={"water.melt": NAN}), "PD402"),
    ("200%", lambda: powderdsl.load("powderworld", params={"water.melt": "200%"}), "PD402"),
    ("no rules", lambda: powderdsl.load(), "PD304"),
    ("rules by number", lambda: powderdsl.load(3), "PD304"),  # type: ignore[arg-type]
    ("a backend of others", lambda: powderdsl.compile("life", backend="jax"), "PD701"),
    ("a device of others", lambda: powderdsl.compile("life", device="gpu"), "PD701"),
    ("a device without values", lambda: powderdsl.compile("life", device="meta"), "PD701"),
    ("an extension's device", lambda: powderdsl.compile("life", device="privateuseone"), "PD701"),
    ("a world that is not there", lambda: powderdsl.load_world("nowhere.npz", simulator()), "PD602"),
]


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize(("call", "kind", "words"), [pytest.param(*row[1:], id=row[0]) for row in ROWS])
def test_a_wrong_argument_is_named(call: Callable[[], Any], kind: type[Exception], words: str) -> None:
    with pytest.raises((ValueError, TypeError, KeyError)) as caught:
        call()
    assert caught.type is kind
    assert words in caught.value.args[0]
    assert "\n" not in caught.value.args[0]
    assert not caught.value.args[0].endswith("; ")


@pytest.mark.parametrize(("call", "code"), [pytest.param(*row[1:], id=row[0]) for row in DIAGNOSTICS])
def test_a_wrong_value_from_outside_is_a_diagnostic(call: Callable[[], Any], code: str) -> None:
    assert refused_codes(call) == [code]


@pytest.mark.usefixtures("library")
def test_values_that_look_odd_and_are_right() -> None:
    sim = simulator()
    ids = np.broadcast_to(np.uint16(0), (1, 2, 2))
    assert sim.world(ids, seed=np.int64(3)).shape == (1, 2, 2)
    assert sim.step(sim.world([[0, 2]]), steps=np.int32(0), random={}, params={}, passes=[]).shape == (
        1,
        1,
        2,
    )
    assert bool((sim.replace(world(), velocity=(1, 2))["velocity"][:, 1] == 2).all())
