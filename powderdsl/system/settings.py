"""Settings of a run: fields of a dataclass that say what they are for and which values they take.

Checks and the options of commands (`cli.options.settings_of`) follow from the declaration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field, fields
from typing import Any, TypeVar

Value = TypeVar("Value", int, float, str)


def setting(
    default: Value,
    about: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] = (),
) -> Value:
    """A field of a dataclass: numbers from `low` to `high` (None: any), or one of `choices`. With `about` it has an option."""
    bounds = None if low is None else (low, high)
    return field(default=default, metadata={"about": about, "bounds": bounds, "choices": tuple(choices)})


def out_of_bounds(config: Any) -> Iterator[str]:
    """Yield a sentence for each number of a dataclass of settings that is out of bounds."""
    for one in fields(config):
        value, bounds = getattr(config, one.name), one.metadata.get("bounds")
        if bounds is None:
            continue
        low, high = bounds
        whole = isinstance(one.default, int)
        written = "," if whole else "g"
        takes = f"{'an integer' if whole else 'a number'} from {low:{written}}"
        takes += "" if high is None else f" to {high:{written}}"
        number = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
        if not number or not low <= value <= (value if high is None else high):
            yield f"`{one.name}` is {value!r}: it takes {takes}"


def check_bounds(config: Any) -> None:
    """Raise ValueError with everything that `out_of_bounds` finds."""
    if wrong := "; ".join(out_of_bounds(config)):
        raise ValueError(wrong)
