"""Arrays in plain Python give what NumPy gives, bit for bit, or raise an error."""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import product
from typing import Any

import numpy
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from powderdsl.arrays import plain
from powderdsl.arrays.numbers import promote

INTEGERS = tuple(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u"))
KINDS = ("bool", *INTEGERS, "float32", "float64")
SHAPES = ((), (1,), (3,), (0,), (1, 1), (2, 3), (4, 5), (2, 3, 4), (2, 1, 5), (3, 2, 2, 2), (8, 2, 3))
COMMON = ((3, 4, 5), (4, 5), (1, 5), (3, 1, 1), (4, 1), (5,), (1,), (), (1, 4, 5))
"""Shapes that fit together."""
FLOATS = (0.0, -0.0, 1.0, 0.1, -0.3, 1e-30, 1e30, 7.0, float("inf"), float("-inf"), float("nan"), 255.0)
UNSUPPORTED = "without NumPy"


@contextmanager
def quiet() -> Iterator[None]:
    """NumPy without its warnings, which plain arrays do not have."""
    with warnings.catch_warnings(), numpy.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def numbers_of(kind: str) -> st.SearchStrategy[Any]:
    if kind == "bool":
        return st.booleans()
    if kind.startswith("float"):
        return st.sampled_from(FLOATS) | st.floats(width=int(kind[5:]))
    bounds = numpy.iinfo(kind)
    low, high = int(bounds.min), int(bounds.max)
    return st.sampled_from((0, 1, 5, 7, high, low, min(high, 255), min(high, 256))) | st.integers(low, high)


@st.composite
def pairs(
    draw: st.DrawFn, shapes: tuple[tuple[int, ...], ...] = SHAPES, kinds: tuple[str, ...] = KINDS
) -> Any:
    """An array of NumPy and the same plain one; equal numbers throughout come often, and small ones."""
    kind, shape = draw(st.sampled_from(kinds)), draw(st.sampled_from(shapes))
    size = int(numpy.prod(shape))
    few = draw(st.sampled_from((1, 3, size)))
    some = [draw(numbers_of(kind)) for _ in range(min(max(few, 1), max(size, 1)))]
    if draw(st.booleans()) and kind not in ("bool", "float32", "float64"):
        some = [abs(one) % 100 for one in some]
    values = [some[at % len(some)] for at in range(size)]
    theirs = numpy.array(values, kind).reshape(shape)
    ours = plain.array(values, kind).reshape(shape)
    if draw(st.booleans()):  # held as its type has it, not as bytes
        ours = plain.frombuffer(theirs.tobytes(), kind).reshape(shape)
    return theirs, ours


def check_equal(theirs: Any, ours: Any) -> None:
    if isinstance(theirs, (tuple, list)):
        assert len(theirs) == len(ours)
        for one, other in zip(theirs, ours, strict=True):
            check_equal(one, other)
        return
    if isinstance(theirs, (numpy.ndarray, numpy.generic)):
        assert (str(theirs.dtype), theirs.shape) == (str(ours.dtype), ours.shape)
        again = numpy.frombuffer(ours.tobytes(), theirs.dtype).reshape(theirs.shape)
        if theirs.dtype.kind == "f":  # the bits of NaN mean nothing
            wrong = numpy.isnan(theirs)
            assert (wrong == numpy.isnan(again)).all()
            theirs, again = (numpy.where(wrong, 0, one) for one in (theirs, again))
        assert theirs.tobytes() == again.tobytes(), (theirs, again)
        return
    assert type(theirs) is type(ours)
    assert theirs == ours or theirs != theirs


def compare(call: Callable[..., Any], theirs: tuple[Any, ...], ours: tuple[Any, ...]) -> None:
    """Both give the same, or both raise; only the plain one may lack something, which it then says."""
    with quiet():
        try:
            wanted: Any = call(numpy, *theirs)
        except Exception:
            with pytest.raises((ValueError, TypeError, IndexError, OverflowError)):
                call(plain, *ours)
            return
    try:
        found = call(plain, *ours)
    except (ZeroDivisionError, OverflowError):
        return
    except (TypeError, ValueError, IndexError) as error:
        if UNSUPPORTED not in str(error):
            raise
        return
    check_equal(wanted, found)


OPERATORS = "add sub mul truediv floordiv mod and_ or_ xor eq ne lt le gt ge"


def operated(name: str, np: Any, a: Any, b: Any) -> Any:
    return getattr(operator, name)(a, b)


BINARY: dict[str, Callable[..., Any]] = {
    **{name: partial(operated, name) for name in OPERATORS.split()},
    "minimum": lambda np, a, b: np.minimum(a, b),
    "maximum": lambda np, a, b: np.maximum(a, b),
    "where": lambda np, a, b: np.where(a == b, a, b),
    "where_flag": lambda np, a, b: np.where(a.astype(bool), b, a),
    "shift": lambda np, a, b: (a >> (b % 70), a << (b % 70)),
    "array_equal": lambda np, a, b: np.array_equal(a, b),
    "clip": lambda np, a, b: np.clip(a, b, b) + a.dtype.type(0),
}


@settings(max_examples=400, deadline=None, derandomize=True)
@given(st.sampled_from(sorted(BINARY)), pairs(COMMON), pairs(COMMON))
def test_operations_on_two_arrays(name: str, first: Any, second: Any) -> None:
    compare(BINARY[name], (first[0], second[0]), (first[1], second[1]))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    st.sampled_from(sorted(BINARY.keys() - {"clip"})),
    pairs(),
    st.booleans()
    | st.sampled_from((0, 1, 2, 8, 7, -1, -3, 255, 256, 300, 2**31, 2**63 - 1, -(2**63), 0.5, 0.1, 2.0)),
    st.booleans(),
)
def test_operations_with_numbers(name: str, pair: Any, number: Any, swapped: bool) -> None:
    def call(np: Any, array: Any) -> Any:
        if name == "where_flag":
            return np.where(array.astype(bool), number, array)
        return BINARY[name](np, number, array) if swapped else BINARY[name](np, array, number)

    compare(call, (pair[0],), (pair[1],))


UNARY: dict[str, Callable[..., Any]] = {
    "neg": lambda np, a: -a,
    "invert": lambda np, a: ~a,
    "abs": lambda np, a: np.abs(a),
    "sqrt": lambda np, a: np.sqrt(a),
    "isnan": lambda np, a: np.isnan(a),
    "isfinite": lambda np, a: np.isfinite(a),
    "floor": lambda np, a: np.floor(a),
    "tolist": lambda np, a: a.tolist(),
    "any": lambda np, a: a.any(),
    "all": lambda np, a: a.all(),
    "sum": lambda np, a: a.sum(),
    "min": lambda np, a: a.min() + a.dtype.type(0),  # which zero it takes depends on their order
    "max": lambda np, a: a.max() + a.dtype.type(0),
    "argmax": lambda np, a: a.argmax(),
    "axis": lambda np, a: (a.any(0), a.all(-1), a.max(0) + a.dtype.type(0), a.min(-1) + a.dtype.type(0), a.argmax(0)),
    "sums": lambda np, a: (a.sum(0), a.sum(-1)),
    "pair": lambda np, a: (a.any((0, 1)), a.any((1, 2)), a.max((0, 2)) + a.dtype.type(0)),
    "nonzero": lambda np, a: (*np.nonzero(a),),
    "unique": lambda np, a: np.unique(a) + a.dtype.type(0),
    "stack": lambda np, a: (np.stack([a, a + 1]), np.stack([a, -a], 1)),
    "concatenate": lambda np, a: (np.concatenate([a, a[:1]]), np.concatenate([a, a], -1), np.concatenate([a, np.arange(2)])),
    "repeat": lambda np, a: (np.repeat(a, 3, 0), np.repeat(a, 2, -1)),
    "reshape": lambda np, a: (a.reshape(-1), a.reshape(len(a), -1), a.reshape(-1, 1)),
    "axes": lambda np, a: (np.moveaxis(a, -1, 0), np.moveaxis(a, 0, -1)),
    "roll": lambda np, a: (np.roll(a, (1, -2), (-2, -1)), np.roll(a, 3, 0)),
    "isin": lambda np, a: (np.isin(a, [1, 5, 300, -1]), np.isin(a, [])),
    "broadcast": lambda np, a: np.broadcast_to(a, (3, 4, 5)),
    "broadcast_2": lambda np, a: np.broadcast_to(a, (4, 2, *a.shape)) + 1,
    "likes": lambda np, a: (np.zeros_like(a), np.full_like(a, 1), np.full(a.shape, 3, a.dtype)),
    "searchsorted": lambda np, a: (np.searchsorted(np.array([0, 5, 7]), a), np.searchsorted(np.array([0, 5, 7]), a, side="right")),
    "astype": lambda np, a: [a.astype(kind) for kind in KINDS[:9]],
    "floats": lambda np, a: (a.astype("float32"), a.astype(float)),
    "asarray": lambda np, a: (np.asarray(a), np.asarray(a, np.float64), np.array([a, a])),
    "iterate": lambda np, a: (len(a), list(a), [int(one) for one in a.reshape(-1)]),
    "bool": lambda np, a: bool(a),
    "bytes": lambda np, a: a.tobytes(),
}  # fmt: skip


@settings(max_examples=600, deadline=None, derandomize=True)
@given(st.sampled_from(sorted(UNARY)), pairs())
def test_operations_on_one_array(name: str, pair: Any) -> None:
    if name in ("axis", "sums", "repeat", "nonzero") and pair[0].shape == ():
        return  # numbers have no axis, and NumPy takes 0 for one at times
    if name == "floats" or (name == "astype" and pair[0].dtype.kind != "f"):
        with quiet():
            compare(UNARY[name], (pair[0],), (pair[1],))
    elif name != "astype":  # floats beyond the range of integers: what they become is undefined
        compare(UNARY[name], (pair[0],), (pair[1],))


KEYS: tuple[Callable[..., Any], ...] = (
    lambda np: 0,
    lambda np: -1,
    lambda np: 9,
    lambda np: slice(None),
    lambda np: slice(1, -1),
    lambda np: (slice(None), slice(None, None, 2)),
    lambda np: (0, 1),
    lambda np: (..., 0),
    lambda np: (..., slice(None, None, -1)),
    lambda np: (0, ..., 1),
    lambda np: ...,
    lambda np: None,
    lambda np: (slice(None), None, None),
    lambda np: (..., None, 0),
    lambda np: np.array([0, -1, 0]),
    lambda np: np.array([[0, 1], [1, 0]]),
    lambda np: (slice(None), [0, -1], slice(None)),
    lambda np: (np.array([[0], [1]]), np.array([1, 0])),
    lambda np: ([0, 1], slice(None), [0, 1]),
    lambda np: (slice(None), 1, [0, 1]),
    lambda np: (slice(None), np.array([True, False, True])),
    lambda np: np.array([[True, False, True], [False, False, True]]),
    lambda np: (np.array([[True, False, True], [False, False, True]]), 0),
    lambda np: np.array([True, False, True, True]),
    lambda np: np.int64(1),
    lambda np: (slice(None), [1, 0], None),
    lambda np: [],
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.sampled_from(KEYS), pairs())
def test_indexing(key: Callable[..., Any], pair: Any) -> None:
    compare(lambda np, a: a[key(np)], (pair[0],), (pair[1],))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.sampled_from(KEYS), pairs(), pairs(((), (1,), (3,), (2, 3), (4,), (1, 3))))
def test_writing(key: Callable[..., Any], pair: Any, value: Any) -> None:
    if value[0].dtype.kind == "f" and pair[0].dtype.kind in "iu":
        return  # undefined

    def call(np: Any, a: Any, b: Any) -> Any:
        changed = a.copy()
        changed[key(np)] = b
        again = a.copy()
        again[a == a.max()] = 1
        again[key(np)] = 1
        return changed, again, a

    compare(call, (pair[0], value[0]), (pair[1], value[1]))


def test_types_of_results() -> None:
    for a, b in product(KINDS, repeat=2):
        name = str(numpy.result_type(a, b))
        types = plain.dtype(a), plain.dtype(b)
        if {"i", "u"} == {one.kind for one in types} and name not in (a, b):
            with pytest.raises(TypeError, match=UNSUPPORTED):
                promote(*types)
        else:
            assert str(promote(*types)) == name, (a, b)
    for kind, number in product(KINDS[1:], (True, 1, 0.5)):
        assert str((plain.zeros(2, kind) * number).dtype) == str((numpy.zeros(2, kind) * number).dtype)
        assert plain.dtype(kind) == kind
        assert plain.dtype(kind).str == numpy.dtype(kind).str


def test_views_are_not_written_through() -> None:
    array: Any = plain.zeros((3, 4), plain.int32)
    row = array[0]
    with pytest.raises(ValueError, match="writing to a view is not supported without NumPy"):
        row[0] = 1
    array[0, 0] = 1
    assert array.tolist()[0] == [1, 0, 0, 0]
    with pytest.raises(TypeError):  # in NumPy every view of the array would see it
        array += 1
    with pytest.raises(
        ValueError, match="view of an array that was written to is not supported without NumPy"
    ):
        row.tolist()
    with pytest.raises(ValueError, match="writing to a view"):
        plain.broadcast_to(array, (2, 3, 4))[0, 0, 0] = 1


@pytest.mark.parametrize(
    "call",
    [
        lambda np: np.linalg,
        lambda np: np.zeros(3, "complex64"),
        lambda np: np.array(["a"]),
        lambda np: np.array([0.5]).sum(),
        lambda np: np.array([0.5]) % 2,
    ],
)
def test_what_is_missing_is_an_error(call: Callable[[Any], Any]) -> None:
    with pytest.raises((ModuleNotFoundError, TypeError), match=UNSUPPORTED):
        call(plain)
