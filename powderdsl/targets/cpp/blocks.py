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
    reads: frozenset[tuple[str, int, int]]
    """Fields, and the rows and columns away that they are read at."""
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
            statement = self.statements[i]
            if isinstance(statement, str):
                result.append(statement)
                i += 1
                continue
            run: list[Lanes] = []
            while i < len(self.statements) and isinstance(item := self.statements[i], Lanes):
                run.append(item)
                i += 1
            outside = " ".join(_all_text(s) for s in (*self.statements[: i - len(run)], *self.statements[i:]))
            seen_outside = set(_VARIABLE.findall(outside))
            result.append(lane_loop(run, seen_outside))
        return result


def _all_text(statement: str | Lanes) -> str:
    return (
        statement
        if isinstance(statement, str)
        else " ".join((statement.before, statement.rows, statement.after))
    )


def lane_loop(run: list[Lanes], seen_outside: set[str]) -> str:
    """One loop over lanes, which are worlds. Fields that nothing else reads are written over by each: they need one lane.

    Lanes that are strips read each other: a sweep that reads other rows of an earlier one follows it block by block,
    see EACH_BLOCK.
    """
    written = {name for sweep in run for name in sweep.fields}
    used = sorted({name for sweep in run for name in _VARIABLE.findall(sweep.rows) if name.startswith("f")})
    over = _written_over(run, written - seen_outside)
    lasting = {_first(name, over) for name in used if name not in written or name in seen_outside}
    places = " ".join(
        f"const int l{name} = {'l' if _first(name, over) in lasting else 'l & strips'};" for name in used
    )
    before = "\n".join(sweep.before for sweep in run)
    for name, old in over.items():
        before = before.replace(f"{name} = take_field(c);", f"{name} = keep({old});")
    parts = _parts(run)
    rows = "\n".join(
        (f"if (!strips || part == {part}) " if parts[-1] else "")
        + (
            f"for (int y = first; y < last; y++) {{\n{sweep.rows}\n}}"
            if sweep.by_row
            else f"{{\n{sweep.rows}\n}}"
        )
        for part, sweep in zip(parts, run, strict=True)
    )
    blocks = f"EACH_BLOCK({parts[-1]})"
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


def _parts(run: list[Lanes]) -> list[int]:
    """Which sweeps may go together, row by row: those that read other rows of an earlier one come in a later part."""
    parts: list[int] = []
    made: dict[str, int] = {}
    for sweep in run:
        far = [made[name] + 1 for name, dy, _ in sweep.reads if dy and name in made]
        parts.append(max([*far, *parts[-1:]], default=0))
        made |= dict.fromkeys(sweep.fields, parts[-1])
    return parts


def _written_over(run: list[Lanes], passing: set[str]) -> dict[str, str]:
    """Outputs that take the place of a field which only the run needs, and which is read for the last time: it by it."""
    over: dict[str, str] = {}
    earlier: set[str] = set()
    for number, sweep in enumerate(run):
        others = [read for other in (*run[:number], *run[number + 1 :]) for read in other.reads]
        later = {name for other in run[number + 1 :] for name, _, _ in other.reads}
        far = {name for name, dy, _ in others if dy} | {name for name, dy, dx in sweep.reads if dy or dx}
        free = sorted({name for name, _, _ in sweep.reads} & earlier & passing - later - far)
        if sweep.by_row:
            over |= dict(zip((name for name, _ in sweep.outputs if name.startswith("f")), free, strict=False))
        earlier |= sweep.fields
    return over


def _first(name: str, over: dict[str, str]) -> str:
    """Whose place a field has taken in the end."""
    while name in over:
        name = over[name]
    return name
