"""Dataclasses whose fields declare which values they take: settings of runs, and records in files of strangers.

Checks, the reader of records and the options of commands (`cli.options.settings_of`) follow from the declarations. The
type of a record's field is the kind of its values: ``bool``, ``int``, ``float``, ``str``, another record, a named tuple
of these, ``tuple[T, ...]``, ``Mapping[str, T]``, ``T | None``, or any of these with limits: ``Annotated[int, Limits(1, 9)]``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from operator import index
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from powderdsl.diagnostics import suggest

Record = TypeVar("Record")

MAX_TEXT = 500
"""Characters of a text in a record."""


@dataclass(frozen=True)
class Limits:
    """Limits of numbers, or of texts, or of lists and mappings."""

    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    pattern: str = f"(?s:.{{1,{MAX_TEXT}}})"
    """A regular expression that texts match."""
    form: str = "a text"
    """What such texts are called."""
    keys: str = f".{{1,{MAX_TEXT}}}"
    """A regular expression that the keys of a mapping match."""
    length: tuple[int, int] = (0, 10_000)
    """The least and most values of a list or a mapping."""


def setting(
    default: Any,
    about: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    choices: Sequence[str] = (),
    form: str = "a text",
    option: str = "",
    may_change: bool = False,
) -> Any:
    """A field of a dataclass of settings. A text may be empty only if it is by default.

    Args:
        default: a value, or a type that makes one, such as `dict`.
        about: the help of its option; without it there is none. option: the option's name, unless it is the field's.
        low, high, choices, form: see `Limits`.
        may_change: whether a run may be resumed with another value.
    """
    pattern = f"(?s:.{{{1 if default else 0},{MAX_TEXT}}})"
    limits = Limits(low, high, tuple(choices), pattern, form)
    metadata = {"about": about, "limits": limits, "option": option, "may_change": may_change}
    if isinstance(default, type):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def check_count(name: str, value: Any, most: int, *, least: int = 1) -> None:
    """Raise ValueError if an argument is not an integer from `least` to `most`."""
    if isinstance(value, bool) or not hasattr(value, "__index__") or not least <= value <= most:
        raise ValueError(f"{name} must be an integer from {least:,} to {most:,}, found {value!r}")


def mistakes(config: Any) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield a sentence and suggestions for each setting whose value it does not take."""
    hints = get_type_hints(type(config))
    for item in fields(config):
        value, limits = getattr(config, item.name), item.metadata.get("limits")
        if limits is not None and (wanted := _mismatch(hints[item.name], value, limits)):
            yield f"`{item.name}` is {value!r}: it takes {wanted}", suggest(str(value), limits.choices)


def check_settings(config: Any) -> None:
    """Raise ValueError with all `mistakes`."""
    if wrong := "; ".join(sentence for sentence, _ in mistakes(config)):
        raise ValueError(wrong)


def read_record(kind: type[Record], data: Any, problems: list[str], path: str = "") -> Record | None:
    """The record that a file describes, or None after adding everything that is wrong to `problems`.

    Args:
        path: the place of `data` in its file, such as ``shards[3]``, with which problems name places.
    """
    if not isinstance(data, Mapping):
        problems.append(f"`{path or 'file'}` must be a mapping, found {data!r:.80}")
        return None
    start, before = f"{path}." if path else "", len(problems)
    declared, values = _fields_of(kind), {}  # type: ignore[arg-type]  # types are hashable
    for name, (hint, required) in declared.items():
        if name in data:
            values[name] = _read(hint, data[name], start + name, problems)
        elif required:
            problems.append(f"`{start}{name}` is missing")
    for key in sorted(str(key) for key in data if key not in declared):
        helps = suggest(key, declared, "keys here")
        problems.append("; ".join([f"unknown key `{start}{key[:80]}`", *helps]))
    return None if len(problems) > before else kind(**values)


def checked_record(kind: type[Record], data: Any, path: str = "") -> Record:
    """The record that a file describes. Raises ValueError with what is wrong."""
    problems: list[str] = []
    record = read_record(kind, data, problems, path)
    if record is None:
        raise ValueError("; ".join(problems[:8]))
    return record


@cache
def _fields_of(kind: Any) -> dict[str, tuple[Any, bool]]:
    """The type of each field of a record, and whether it is required."""
    hints, declared = get_type_hints(kind, include_extras=True), {}
    for item in fields(kind):
        hint, limits = hints[item.name], item.metadata.get("limits")
        required = item.default is MISSING and item.default_factory is MISSING
        declared[item.name] = (hint if limits is None else Annotated[hint, limits], required)
    return declared


def _read(kind: Any, value: Any, path: str, problems: list[str]) -> Any:
    """A value of a type; None after adding to `problems`."""
    limits = Limits()
    if get_origin(kind) is Annotated:
        kind, limits = get_args(kind)
    if kind is Any or (value is None and NoneType in get_args(kind)):
        return value
    if isinstance(kind, UnionType):
        kind = next(arm for arm in get_args(kind) if arm is not NoneType)
    if is_dataclass(kind):
        return read_record(kind, value, problems, path)  # type: ignore[arg-type]  # it is a type, not an instance
    if kind is int and hasattr(value, "__index__") and not isinstance(value, bool):
        value = index(value)  # also of NumPy's integers
    if wanted := _mismatch(kind, value, limits):
        problems.append(f"`{path}` must be {wanted}, found {value!r:.80}")
        return None
    if names := getattr(kind, "_fields", ()):
        hints = get_type_hints(kind, include_extras=True)
        parts = zip(names, value, strict=True)
        return kind(*(_read(hints[name], part, f"{path}.{name}", problems) for name, part in parts))
    if get_origin(kind) is tuple:
        item = get_args(kind)[0]
        return tuple(_read(item, part, f"{path}[{at}]", problems) for at, part in enumerate(value))
    if get_origin(kind) is Mapping:
        item = get_args(kind)[1]
        return {key: _read(item, part, f"{path}.{key}", problems) for key, part in value.items()}
    return value


def _mismatch(kind: Any, value: Any, limits: Limits) -> str:
    """What a value should be, if it is something else. The values in lists and mappings are not looked at."""
    low, high = limits.length
    if names := getattr(kind, "_fields", ()):
        fits = isinstance(value, list | tuple) and len(value) == len(names)
        wanted = f"[{', '.join(names)}]"
    elif get_origin(kind) is tuple:
        fits = isinstance(value, list | tuple) and low <= len(value) <= high
        wanted = f"a list of {low:,} to {high:,} values"
    elif get_origin(kind) is Mapping:
        fits = isinstance(value, Mapping) and low <= len(value) <= high
        fits = fits and all(re.fullmatch(limits.keys, str(key)) for key in value)
        wanted = f"a mapping of {low:,} to {high:,} values, with keys that match {limits.keys}"
    elif kind is bool:
        fits, wanted = isinstance(value, bool), "true or false"
    elif kind is str and limits.choices:
        fits, wanted = value in limits.choices, " or ".join(f"`{word}`" for word in limits.choices)
    elif kind is str:
        fits = isinstance(value, str) and re.fullmatch(limits.pattern, value) is not None
        wanted = limits.form
    else:
        fits = isinstance(value, int if kind is int else int | float) and not isinstance(value, bool)
        fits = fits and (limits.low is None or limits.low <= value)
        fits = fits and (limits.high is None or value <= limits.high)
        written = "," if kind is int else "g"
        wanted = "an integer" if kind is int else "a number"
        wanted += "" if limits.low is None else f" from {limits.low:{written}}"
        wanted += "" if limits.high is None else f" to {limits.high:{written}}"
    return "" if fits else wanted
