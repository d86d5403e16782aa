"""Values for parameters from elsewhere than rule files: commands, tasks, studies and users' programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from powderdsl.diagnostics import Reporter, suggest
from powderdsl.model.types import Kind, Param, Ruleset, Value


def set_params(ruleset: Ruleset, values: Mapping[str, Any], reporter: Reporter) -> Ruleset:
    """The ruleset with other parameter values, checked against their kinds."""
    if not isinstance(values, Mapping):
        raise TypeError(f"params takes a mapping from names to values, found {type(values).__name__}")
    known = {param.name: param for param in ruleset.params}
    found: dict[str, Value] = {}
    for name, value in values.items():
        if name not in known:
            names = ", ".join(sorted(known)) or "none"
            helps = suggest(name, known, "parameters") or (f"parameters: {names}",)
            reporter.error("PD309", f"unknown parameter `{name}`", None, helps=helps)
            continue
        try:
            found[name] = param_value(known[name], value)
        except ValueError as error:
            notes = [f"it is {_kind_in_words(known[name].kind)}"]
            reporter.error("PD402", f"parameter `{name}`: {error}", None, notes=notes)
    return ruleset.with_params(found)


def _kind_in_words(kind: Kind) -> str:
    if kind.name == "chance":
        return "a chance: write a percentage from 0% to 100%, or a number from 0 to 1"
    if kind.name == "flag":
        return "a flag: write yes or no"
    return f"{'an integer' if kind.name == 'int' else 'a number'} from {kind.lo:g} to {kind.hi:g}"


def param_value(param: Param, value: Any) -> Value:
    """A value for a parameter from text (``"5%"``, ``"yes"``) or a number. Raises ValueError."""
    text = value.strip() if isinstance(value, str) else None
    flags = {"yes": 1.0, "true": 1.0, "no": 0.0, "false": 0.0}
    try:
        if text is not None and text.endswith("%"):
            number = float(text[:-1]) / 100
        else:
            number = float(value if text is None else flags.get(text, text))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{repr(value) if text is None else f'`{text}`'} is not a number") from None
    kind = param.kind.name
    lo, hi = (0.0, 1.0) if kind in ("chance", "flag") else (param.kind.lo, param.kind.hi)
    if not lo <= number <= hi:
        bounds = "0%..100%" if kind == "chance" else f"{lo:g}..{hi:g}"
        raise ValueError(f"{text or format(number, 'g')} lies outside {bounds}")
    if kind not in ("int", "flag"):
        return number
    if number != int(number):
        raise ValueError(f"{number:g} is not an integer")
    return int(number)
