"""A name for what a model says: equal models have equal fingerprints, in every process and on every machine."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from fractions import Fraction


def fingerprint(model: object) -> str:
    """64 hexadecimal digits for a value made of frozen dataclasses, tuples, frozen sets, numbers and text.

    Fields that take no part in comparisons, such as places in files, take none here.

    Raises:
        TypeError: something else was found.
    """
    known: dict[int, str] = {}  # shared parts are many: once each
    return _digest(model, known)


def _digest(value: object, known: dict[int, str]) -> str:
    if is_dataclass(value):
        if id(value) not in known:
            parts = [_digest(getattr(value, field.name), known) for field in fields(value) if field.compare]
            text = f"{type(value).__name__}({','.join(parts)})"
            known[id(value)] = hashlib.sha256(text.encode()).hexdigest()
        return known[id(value)]
    if isinstance(value, tuple):
        return f"[{','.join(_digest(part, known) for part in value)}]"
    if isinstance(value, frozenset):
        return f"{{{','.join(sorted(_digest(part, known) for part in value))}}}"
    if value is None or isinstance(value, str | int | float | Fraction):
        return repr(value)
    raise TypeError(f"no fingerprint of a {type(value).__name__}")
