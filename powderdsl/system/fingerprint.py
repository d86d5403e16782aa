"""Fingerprints of models: equal models have equal fingerprints, in every process and on every machine."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from fractions import Fraction
from types import MappingProxyType

UNMEANING = MappingProxyType({"meaning": False})
"""Metadata of dataclass fields that change nothing about what happens: texts, colors, tests."""


def fingerprint(model: object, *, whole: bool = False) -> str:
    """64 hexadecimal digits for a value made of frozen dataclasses, tuples, frozen sets, numbers and text.

    Fields that take no part in comparisons, such as places in files, take none here, nor do those with `UNMEANING` as
    metadata; if `whole` is true, all do. A field at its default counts as absent, so that new fields change no
    fingerprint. The names of classes and fields are part of it. Raises TypeError for anything else.
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
