"""Dataclasses whose fields declare allowed values, for settings of runs and records in untrusted files; and
fingerprints of dataclasses.

Checks, the reader of records and the options of commands (`cli.options.settings_of`) follow from the declarations. The
type of a record's field is the kind of its values: ``bool``, ``int``, ``float``, ``str``, another record, a named tuple
of these, ``tuple[T, ...]``, ``Mapping[str, T]``, ``T | None``, or any of these with limits: ``Annotated[int, Limits(1, 9)]``.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from fractions import Fraction
from functools import cache
from operator import index
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from powderdsl.diagnostics import with_suggestion

Record = TypeVar("Record")

MAX_TEXT = 500
"""Maximum number of characters of a text in a record."""


@dataclass(frozen=True)
class Limits:
    """Limits of numbers, or of texts, or of lists and mappings."""

    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    pattern: str = f"(?s:.{{1,{MAX_TEXT}}})"
    """A regular expression that texts match."""
    form: str = "a text"
    """A noun for such texts."""
    keys: str = f".{{1,{MAX_TEXT}}}"
    """A regular expression that the keys of a mapping match."""
    length: tuple[int, int] = (0, 10_000)
    """The minimum and maximum number of values of a list or a mapping."""


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
        about: the help of its option; without it, there is no option. option: the option's name, by default the
            field's.
        low, high, choices, form: see `Limits`.
        may_change: allow a run to be resumed with another value.
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


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise ValueError if an argument is not one of some texts."""
    if value not in choices:
        raise ValueError(f"{name} is one of {', '.join(choices)}; found {value!r}")


def check_settings(config: Any) -> None:
    """Raise ValueError with a sentence for each invalid setting."""
    problems: list[str] = []
    for name, (hint, _) in _fields_of(type(config)).items():  # type: ignore[arg-type]  # types are hashable
        if get_origin(hint) is Annotated:
            _read(hint, getattr(config, name), name, problems)
    if problems:
        raise ValueError("; ".join(problems))


def read_record(kind: type[Record], data: Any, problems: list[str], path: str = "") -> Record | None:
    """The record in a file, or None after adding all mistakes to `problems`.

    `path`: the location of `data` in its file for messages, such as ``shards[3]``.
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
        problems.append(with_suggestion(f"unknown key `{start}{key[:80]}`", key, declared, "keys here"))
    return None if len(problems) > before else kind(**values)


def checked_record(kind: type[Record], data: Any, path: str = "") -> Record:
    """The record in a file. Raises ValueError with all mistakes."""
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
    fits, expected = _check(kind, value, limits)
    if not fits:
        problems.append(f"`{path}` must be {expected}, found {value!r:.80}")
        return None
    if names := getattr(kind, "_fields", ()):
        hints = get_type_hints(kind, include_extras=True)
        parts = zip(names, value, strict=True)
        return kind(*(_read(hints[name], part, f"{path}.{name}", problems) for name, part in parts))
    if get_origin(kind) is tuple:
        return tuple(
            _read(get_args(kind)[0], part, f"{path}[{at}]", problems) for at, part in enumerate(value)
        )
    if get_origin(kind) is Mapping:
        return {key: _read(get_args(kind)[1], part, f"{path}.{key}", problems) for key, part in value.items()}
    return value


def _check(kind: Any, value: Any, limits: Limits) -> tuple[bool, str]:
    """True if a value fits a type, and the name of such values. Values in lists and mappings are not checked."""
    names = getattr(kind, "_fields", ())
    low, high = (len(names), len(names)) if names else limits.length
    if names or get_origin(kind) is tuple:
        expected = f"[{', '.join(names)}]" if names else f"a list of {low:,} to {high:,} values"
        return isinstance(value, list | tuple) and low <= len(value) <= high, expected
    if get_origin(kind) is Mapping:
        fits = isinstance(value, Mapping) and low <= len(value) <= high
        expected = f"a mapping of {low:,} to {high:,} values, with keys that match {limits.keys}"
        return fits and all(re.fullmatch(limits.keys, str(key)) for key in value), expected
    if kind is bool:
        return isinstance(value, bool), "true or false"
    if limits.choices:
        return value in limits.choices, " or ".join(f"`{word}`" for word in limits.choices)
    if kind is str:
        return isinstance(value, str) and re.fullmatch(limits.pattern, value) is not None, limits.form
    least = -math.inf if limits.low is None else limits.low
    most = math.inf if limits.high is None else limits.high
    fits = isinstance(value, int if kind is int else int | float) and not isinstance(value, bool)
    written = "," if kind is int else "g"
    expected = "an integer" if kind is int else "a number"
    expected += f" from {least:{written}}" if least > -math.inf else ""
    expected += f" to {most:{written}}" if most < math.inf else ""
    return fits and least <= value <= most, expected


# Fingerprints: equal models have equal ones, in every process and on every machine

UNMEANING = MappingProxyType({"meaning": False})
"""Metadata of dataclass fields that do not affect behavior: texts, colors, tests."""


def fingerprint(model: object, *, whole: bool = False) -> str:
    """64 hexadecimal digits for a value made of frozen dataclasses, tuples, frozen sets, numbers and text.

    Fields excluded from comparison, such as locations in files, and those with `UNMEANING` as metadata are ignored,
    unless `whole` is true. A field at its default counts as absent, so that new fields do not change fingerprints. The
    names of classes and fields are included. Raises TypeError for anything else.
    """
    known: dict[int, tuple[object, str]] = {}  # shared parts are many: once each
    return _digest(model, known, whole)


def _digest(value: object, known: dict[int, tuple[object, str]], whole: bool) -> str:
    if is_dataclass(value):
        if id(value) not in known:
            parts = []
            for field in fields(value):
                part = getattr(value, field.name)
                means = field.compare and field.metadata.get("meaning", True)
                if (means or whole) and part != field.default:
                    parts.append(f"{field.name}={_digest(part, known, whole)}")
            text = f"{type(value).__name__}({','.join(parts)})"
            # The value is kept: another object could get its id.
            known[id(value)] = value, hashlib.sha256(text.encode()).hexdigest()
        return known[id(value)][1]
    if isinstance(value, tuple):
        return f"[{','.join(_digest(part, known, whole) for part in value)}]"
    if isinstance(value, frozenset):
        return f"{{{','.join(sorted(_digest(part, known, whole) for part in value))}}}"
    if value is None or isinstance(value, str | int | float | Fraction):
        return repr(value)
    raise TypeError(f"no fingerprint of a {type(value).__name__}")
