"""Levels: which elements an agent paints, how, and the goals that it is given. They are JSON files, shipped ones in `levels/`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import suggest
from powderdsl.system.reading import is_path, parse_json, read_bytes

FOLDER = Path(__file__).parent / "levels"

MAX_BYTES = 1 << 22
"""Largest file of a level."""
MAX_SIDE = 512
"""Rows, and columns, of a level's worlds."""
MAX_PAINTED = 10_000
"""Actions of a task's goal."""
FEWEST_ACTIONS = 8
"""Action spaces are never smaller."""

Painted = tuple[str, int, int]
"""One painted block: the element's name, and its place as (x, y)."""


@dataclass(frozen=True)
class GoalTask:
    """A goal: the world that its actions lead to, and how far from it an episode still succeeds.

    An episode succeeds while fewer than `tolerance` cells of the goal have no match in the world.
    """

    name: str
    tolerance: int
    actions: tuple[Painted, ...]


@dataclass(frozen=True)
class Level:
    """Square worlds of `side` cells, `fill` with a `frame` around it, in which agents paint one of `elements`.

    Place x, y is the block of `brush` × `brush` cells whose first column is `grid` · x and first row `grid` · y.
    An episode has at most `steps` environment steps; `play` has the sizes of the level's data sets.
    """

    name: str
    rules: str
    rounded: str
    """The same rules, with floats rounded as in OGBench."""
    side: int
    fill: str
    frame: str
    brush: int
    grid: int
    elements: tuple[str, ...]
    steps: int
    episodes: int
    validation: int
    episode_steps: int
    tasks: tuple[GoalTask, ...]

    @property
    def places(self) -> int:
        """How many values x has, and y."""
        return (self.side - self.brush) // self.grid + 1

    @property
    def actions(self) -> int:
        """The size of the action space."""
        return max(len(self.elements), self.places, FEWEST_ACTIONS)

    def choices(self, stage: int) -> int:
        """How many actions are valid at a stage: 0 chooses the element, 1 x, 2 y."""
        return self.places if stage else len(self.elements)

    def numbers(self, task: GoalTask) -> list[tuple[int, int, int]]:
        """A task's actions as (index of the element, x, y). Raises ValueError for what the level does not have."""
        found = []
        for at, (element, x, y) in enumerate(task.actions):
            if element not in self.elements:
                helps = "; ".join(suggest(element, self.elements, "elements here"))
                raise ValueError(f"action {at} of `{task.name}`: no element {element!r} to paint; {helps}")
            if not (0 <= x < self.places and 0 <= y < self.places):
                most = self.places - 1
                raise ValueError(
                    f"action {at} of `{task.name}`: the place ({x}, {y}) is not within 0..{most}"
                )
            found.append((self.elements.index(element), x, y))
        return found


def shipped_levels() -> list[str]:
    """Names of the levels that come with powderdsl, by the number of their elements."""
    levels = [read_level(path) for path in sorted(FOLDER.glob("*.json"))]
    return [level.name for level in sorted(levels, key=lambda level: len(level.elements))]


def find_level(level: str | Path | Level) -> Level:
    """A level by name, or from a file. Raises ValueError, which says what is wrong; OSError: the file cannot be read."""
    if isinstance(level, Level):
        return level
    if isinstance(level, Path) or is_path(level) or level.lower().endswith(".json"):
        return read_level(Path(level))
    path = FOLDER / f"{level}.json"
    if not path.is_file():
        helps = suggest(level, [one.stem for one in sorted(FOLDER.glob("*.json"))], "levels")
        raise ValueError("; ".join([f"no level {level!r}", *helps]))
    return read_level(path)


def read_level(path: Path) -> Level:
    """A level's file. Raises ValueError, which says what is wrong; OSError: it cannot be read."""
    try:
        return _level(_Fields(parse_json(read_bytes(path, MAX_BYTES)), ""))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_task(given: Any, where: str = "task_info") -> GoalTask:
    """A task as `reset` takes it in ``options["task_info"]``: ``action_seq`` and ``tol``, and optionally ``task_name``.

    Raises:
        ValueError: it is not one.
    """
    fields = _Fields(given, where, optional=("task_name",))
    name = fields.text("task_name") if "task_name" in given else where
    task = GoalTask(name, fields.integer("tol", 0, 1 << 30), _painted(fields.list("action_seq"), where))
    fields.end()
    return task


class _Fields:
    """The values of a mapping, read one by one. Everything raises ValueError."""

    def __init__(self, values: Any, where: str, optional: tuple[str, ...] = ()):
        if not isinstance(values, dict):
            raise ValueError(f"{where or 'a level'} must be a mapping, found {type(values).__name__}")
        self.values, self.where, self.read = values, where, set(optional)

    def _value(self, name: str, kinds: tuple[type, ...], wanted: str) -> Any:
        self.read.add(name)
        place = f"{self.where}.{name}" if self.where else name
        if name not in self.values:
            raise ValueError(f"`{place}` is missing")
        value = self.values[name]
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise ValueError(f"`{place}` must be {wanted}, found {value!r:.80}")
        return value

    def text(self, name: str) -> str:
        return str(self._value(name, (str,), "a text"))

    def list(self, name: str) -> list[Any]:
        return list(self._value(name, (list, tuple), "a list"))

    def inner(self, name: str) -> _Fields:
        return _Fields(self._value(name, (dict,), "a mapping"), name)

    def integer(self, name: str, least: int, most: int) -> int:
        value = self._value(name, (int,), "an integer")
        if not least <= value <= most:
            raise ValueError(f"`{name}` must lie in {least:,}..{most:,}, found {value:,}")
        return int(value)

    def end(self) -> None:
        unknown = sorted(set(self.values) - self.read)
        if unknown:
            place = f" of `{self.where}`" if self.where else ""
            helps = "; ".join(suggest(unknown[0], self.read, "keys here"))
            raise ValueError(f"unknown key `{unknown[0]}`{place}; {helps}")


def _level(fields: _Fields) -> Level:
    play = fields.inner("play")
    side = fields.integer("side", 4, MAX_SIDE)
    brush = fields.integer("brush", 1, side)
    elements = fields.list("elements")
    if not elements or not all(isinstance(name, str) for name in elements):
        raise ValueError("`elements` must list at least one name")
    tasks = [_task(_Fields(one, f"tasks[{at}]")) for at, one in enumerate(fields.list("tasks"))]
    level = Level(
        fields.text("level"),
        fields.text("rules"),
        fields.text("rounded"),
        side,
        fields.text("fill"),
        fields.text("frame"),
        brush,
        fields.integer("grid", 1, side),
        tuple(elements),
        fields.integer("steps", 1, 1 << 30),
        play.integer("episodes", 1, 1 << 30),
        play.integer("validation", 1, 1 << 30),
        play.integer("steps", 2, 1 << 20),
        tuple(tasks),
    )
    for part in (play, fields):
        part.end()
    for task in level.tasks:
        level.numbers(task)
    return level


def _task(fields: _Fields) -> GoalTask:
    name, tolerance = fields.text("name"), fields.integer("tolerance", 0, 1 << 30)
    task = GoalTask(name, tolerance, _painted(fields.list("actions"), f"tasks.{name}"))
    fields.end()
    return task


def _painted(rows: list[Any], where: str) -> tuple[Painted, ...]:
    if len(rows) > MAX_PAINTED:
        raise ValueError(f"`{where}` has {len(rows):,} actions, more than {MAX_PAINTED:,}")
    found = []
    for at, row in enumerate(rows):
        given = tuple(row) if isinstance(row, list | tuple) else ()
        if len(given) != 3 or not isinstance(given[0], str) or not all(_is_integer(one) for one in given[1:]):
            raise ValueError(f"action {at} of `{where}` must be [element, x, y], found {row!r:.80}")
        found.append((str(given[0]), int(given[1]), int(given[2])))
    return tuple(found)


def _is_integer(value: Any) -> bool:
    return hasattr(value, "__index__") and not isinstance(value, bool)
