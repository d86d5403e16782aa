"""Statements of generated C++: scopes that release what they took, and sweeps that share one loop over worlds."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_VARIABLE = re.compile(r"\b[pf][0-9]+\b")


@dataclass(frozen=True)
class Lanes:
    """A sweep: what it writes, the rows of one world `l`, and what tells that nothing at all is going on."""

    outputs: tuple[tuple[str, bool], ...]
    """Names of fields (f…) and planes (p…), and what a flag is in cells where all reals are zero."""
    before: str
    rows: str
    after: str
    asked: tuple[str, ...] | None
    """Conditions under which all outputs are quiet, besides outputs of sweeps in the same loop; None: never."""
    by_row: bool = True
    """Whether `rows` is the body of a loop over rows `y`; else it has loops of its own."""

    @property
    def fields(self) -> set[str]:
        return {name for name, _ in self.outputs if name.startswith("f")}


@dataclass
class Block:
    """Statements of a scope; variables they define are released after their last use."""

    statements: list[str | Lanes] = field(default_factory=list)
    defined: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The statements with releases."""
        statements = self._joined()
        last: dict[str, int] = {}
        for i, statement in enumerate(statements):
            for name in _VARIABLE.findall(statement):
                last[name] = i
        lines = []
        for i, statement in enumerate(statements):
            lines.append(statement)
            lines += [f"give(c, {name});" for name in sorted(set(self.defined)) if last.get(name) == i]
        return "\n".join(lines)

    def _joined(self) -> list[str]:
        """Sweeps that follow each other become one loop over worlds: what one world needs stays in the cache."""
        result: list[str] = []
        i = 0
        while i < len(self.statements):
            run: list[Lanes] = []
            while i < len(self.statements) and isinstance(item := self.statements[i], Lanes):
                run.append(item)
                i += 1
            if run:
                outside = " ".join(
                    _all_text(s) for s in (*self.statements[: i - len(run)], *self.statements[i:])
                )
                seen_outside = set(_VARIABLE.findall(outside))
                result.append(lane_loop(run, seen_outside))
            else:
                result.append(self.statements[i])  # type: ignore[arg-type]
                i += 1
        return result


def _all_text(statement: str | Lanes) -> str:
    return (
        statement
        if isinstance(statement, str)
        else " ".join((statement.before, statement.rows, statement.after))
    )


def lane_loop(run: list[Lanes], seen_outside: set[str]) -> str:
    """One loop over lanes, which are worlds. Fields that nothing else reads are written over by each: they need one lane.

    Lanes that are strips read each other: sweeps follow each other through them block by block, see EACH_BLOCK.
    """
    written = {name for sweep in run for name in sweep.fields}
    used = sorted({name for sweep in run for name in _VARIABLE.findall(sweep.rows) if name.startswith("f")})
    places = " ".join(
        f"const int l{name} = {'l & strips' if name in written - seen_outside else 'l'};" for name in used
    )
    before = "\n".join(sweep.before for sweep in run)
    several = len(run) > 1
    rows = "\n".join(
        (f"if (!strips || part == {number}) " if several else "")
        + (
            f"for (int y = first; y < last; y++) {{\n{sweep.rows}\n}}"
            if sweep.by_row
            else f"{{\n{sweep.rows}\n}}"
        )
        for number, sweep in enumerate(run)
    )
    blocks = f"EACH_BLOCK({len(run) - 1})"
    after = "\n".join(sweep.after for sweep in run)
    loop = f"{before}\n{blocks} for (int l = 0; l < c.lanes; l++) {{ {places}\n{rows}\n}}\n{after}"
    outputs = [output for sweep in run for output in sweep.outputs]
    declared = " ".join(f"{'Field' if name.startswith('f') else 'Plane'}* {name};" for name, _ in outputs)
    if any(sweep.asked is None for sweep in run):
        return f"{declared}\n{loop}"
    asked = dict.fromkeys(
        c for sweep in run for c in sweep.asked or () if not set(_VARIABLE.findall(c)) & written
    )
    quiet_values = " ".join(
        f"{name} = keep(c.{'calm' if name.startswith('f') else 'everything' if value else 'nothing'});"
        for name, value in outputs
    )
    return f"{declared}\nif ({' && '.join(asked) or 'true'}) {{ {quiet_values} }} else {{\n{loop}\n}}"
