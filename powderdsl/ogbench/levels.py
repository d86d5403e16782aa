"""Levels: which elements an agent paints, how, and the goals that it is given. They are JSON files, shipped ones in `levels/`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from powderdsl.diagnostics import with_suggestion
from powderdsl.system.reading import is_path, parse_json, read_bytes
from powderdsl.system.settings import Limits, checked_record

FOLDER = Path(__file__).parent / "levels"

MAX_BYTES = 1 << 22
"""Largest file of a level."""
MAX_SIDE = 512
"""Rows, and columns, of a level's worlds."""
FEWEST_ACTIONS = 8
"""Action spaces are never smaller."""

Count = Annotated[int, Limits(1, 1 << 30)]
Cells = Annotated[int, Limits(0, 1 << 30)]


class Painted(NamedTuple):
    """One painted block: the element's name, and its place."""

    element: str
    x: int
    y: int


@dataclass(frozen=True)
class GoalTask:
    """A goal: the world that its actions lead to, and how far from it an episode still succeeds.

    An episode succeeds while fewer than `tolerance` cells of the goal have no match in the world.
    """

    name: str
    tolerance: Cells
    actions: tuple[Painted, ...]


@dataclass(frozen=True)
class TaskInfo:
    """A task as `reset` takes it in ``options["task_info"]``."""

    action_seq: tuple[Painted, ...]
    tol: Cells
    task_name: str = "task_info"


@dataclass(frozen=True)
class Play:
    """The sizes of a level's data sets: episodes for training and validation, and rows of each."""

    episodes: Count
    validation: Count
    steps: Annotated[int, Limits(2, 1 << 20)]


@dataclass(frozen=True)
class Level:
    """Square worlds of `side` cells, `fill` with a `frame` around it, in which agents paint one of `elements`.

    Place x, y is the block of `brush` × `brush` cells whose first column is `grid` · x and first row `grid` · y.
    An episode has at most `steps` environment steps.
    """

    name: str
    rules: str
    rounded: str
    """The same rules, with floats rounded as in OGBench."""
    side: Annotated[int, Limits(4, MAX_SIDE)]
    fill: str
    frame: str
    brush: Annotated[int, Limits(1, MAX_SIDE)]
    grid: Annotated[int, Limits(1, MAX_SIDE)]
    elements: Annotated[tuple[str, ...], Limits(length=(1, 256))]
    steps: Count
    play: Play
    tasks: tuple[GoalTask, ...]

    @property
    def places(self) -> int:
        """The number of values of x, and of y."""
        return (self.side - self.brush) // self.grid + 1

    @property
    def actions(self) -> int:
        """The size of the action space."""
        return max(len(self.elements), self.places, FEWEST_ACTIONS)

    def choices(self, stage: int) -> int:
        """The number of valid actions at a stage: 0 chooses the element, 1 x, 2 y."""
        return self.places if stage else len(self.elements)

    def numbers(self, task: GoalTask) -> list[tuple[int, int, int]]:
        """A task's actions as (index of the element, x, y). Raises ValueError for what the level does not have."""
        triples = []
        for at, (element, x, y) in enumerate(task.actions):
            if element not in self.elements:
                message = f"action {at} of `{task.name}`: no element {element!r} to paint"
                raise ValueError(with_suggestion(message, element, self.elements, "elements here"))
            if not (0 <= x < self.places and 0 <= y < self.places):
                most = self.places - 1
                raise ValueError(
                    f"action {at} of `{task.name}`: the place ({x}, {y}) is not within 0..{most}"
                )
            triples.append((self.elements.index(element), x, y))
        return triples


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
        known = [path.stem for path in FOLDER.glob("*.json")]
        raise ValueError(with_suggestion(f"no level {level!r}", level, known, "levels"))
    return read_level(path)


def read_level(path: Path) -> Level:
    """A level's file. Raises ValueError, which says what is wrong; OSError: it cannot be read."""
    try:
        level = checked_record(Level, parse_json(read_bytes(path, MAX_BYTES)))
        if max(level.brush, level.grid) > level.side:
            raise ValueError(f"`brush` and `grid` must be at most {level.side}, the side of its worlds")
        for task in level.tasks:
            level.numbers(task)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return level


def read_task(info: Any) -> GoalTask:
    """The task of ``options["task_info"]``. Raises ValueError."""
    record = checked_record(TaskInfo, info, "task_info")
    return GoalTask(record.task_name, record.tol, record.action_seq)
