"""Levels: the elements that an agent paints, the goals, and their datasets.

Levels are JSON files; shipped ones are in `levels/`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import with_suggestion
from powderdsl.system.archives import BadArchive, open_archive
from powderdsl.system.reading import is_path, parse_json, read_bytes
from powderdsl.system.settings import Limits, checked_record

FOLDER = Path(__file__).parent / "levels"

MAX_BYTES = 1 << 22
"""Largest file of a level."""
MAX_SIDE = 512
"""Rows, and columns, of a level's worlds."""
FEWEST_ACTIONS = 8
"""Minimum size of an action space."""

Count = Annotated[int, Limits(1, 1 << 30)]
Cells = Annotated[int, Limits(0, 1 << 30)]


class PaintedBlock(NamedTuple):
    """One painted block: the element's name and the position."""

    element: str
    x: int
    y: int


@dataclass(frozen=True)
class GoalTask:
    """A goal: the world that its actions lead to, and the tolerance for success.

    An episode succeeds while fewer than `tolerance` cells of the goal have no match in the world.
    """

    name: str
    tolerance: Cells
    actions: tuple[PaintedBlock, ...]


@dataclass(frozen=True)
class TaskInfo:
    """A task as in ``options["task_info"]`` of `reset`."""

    action_seq: tuple[PaintedBlock, ...]
    tol: Cells
    task_name: str = "task_info"


@dataclass(frozen=True)
class DatasetSizes:
    """The sizes of a level's datasets: numbers of episodes for training and validation, and rows per episode."""

    episodes: Count
    validation: Count
    steps: Annotated[int, Limits(2, 1 << 20)]


@dataclass(frozen=True)
class Level:
    """Square worlds of `side` cells, `fill` with a `frame` around it, in which agents paint one of `elements`.

    Position x, y is the block of `brush` × `brush` cells whose first column is `grid` · x and first row `grid` · y.
    An episode has at most `steps` environment steps.
    """

    name: str
    rules: str
    rounded: str
    """The same rules with floats rounded as in OGBench."""
    side: Annotated[int, Limits(4, MAX_SIDE)]
    fill: str
    frame: str
    brush: Annotated[int, Limits(1, MAX_SIDE)]
    grid: Annotated[int, Limits(1, MAX_SIDE)]
    elements: Annotated[tuple[str, ...], Limits(length=(1, 256))]
    steps: Count
    play: DatasetSizes
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
        """A task's actions as (index of the element, x, y). Raises ValueError for those outside the level."""
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
    """Names of the shipped levels, by the number of their elements."""
    levels = [read_level(path) for path in sorted(FOLDER.glob("*.json"))]
    return [level.name for level in sorted(levels, key=lambda level: len(level.elements))]


def find_level(level: str | Path | Level) -> Level:
    """A level by name, or from a file. Raises ValueError for an invalid level, OSError if the file cannot be read."""
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
    """Read a level's file. Raises ValueError for an invalid level, OSError if it cannot be read."""
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


# Datasets: files of flat rows, and their environments

DEFAULT_DATASET_DIR = "~/.ogbench/data"
"""OGBench's folder of datasets, where they are looked up."""

FAMILY, VERSION = "powderworld", "v0"

ROWS = ("observations", "actions", "terminals")
"""The arrays of a file, with the rows of all episodes, one after another."""

Dataset = dict[str, NDArray[Any]]


def make_env_and_datasets(
    dataset_name: str,
    dataset_dir: str | Path = DEFAULT_DATASET_DIR,
    dataset_path: str | Path | None = None,
    compact_dataset: bool = False,
    env_only: bool = False,
    dataset_only: bool = False,
    cur_env: Any = None,
    add_info: bool = False,
    **env_kwargs: Any,
) -> Any:
    """Create an environment and load a dataset, as `ogbench.make_env_and_datasets` does, but without downloading.

    Args:
        dataset_name: ``powderworld-easy-play-v0``, also ``medium`` and ``hard``.
        dataset_dir: the folder of ``NAME.npz`` and ``NAME-val.npz``, as written by `powderdsl ogbench`.
        dataset_path: path of the first file; the second is expected in the same folder.
        compact_dataset: if False, transitions with ``next_observations``; if True, all rows, and ``valids``.
        env_only: do not load data.
        dataset_only: do not create an environment; `env_only` takes precedence.
        cur_env: accepted as by OGBench, and ignored.
        add_info: accepted as by OGBench, and ignored.
        env_kwargs: those of `PowderworldEnv`, and `max_episode_steps`.

    Returns:
        (environment, training data, validation data); or the environment alone, or the data alone, as a pair. Data are
        arrays by name, see `load_dataset`: observations uint8, actions int32, the others float32.

    Raises:
        ValueError: an unknown name, or a file that is not such a dataset.
        FileNotFoundError: there is no such file.
    """
    levels = shipped_levels()
    named = re.fullmatch(rf"{FAMILY}-({'|'.join(levels)})-[^-]+-{VERSION}", dataset_name)
    if named is None:
        known = [f"{FAMILY}-{name}-play-{VERSION}" for name in levels]
        message = f"no dataset named {dataset_name!r}"
        raise ValueError(with_suggestion(message, dataset_name, known, "data sets"))
    level = named[1]
    env = None
    if env_only or not dataset_only:
        spec = gymnasium.spec(f"powderdsl/{FAMILY}-{level}-{VERSION}")
        env = gymnasium.make(spec, **env_kwargs)
    if env_only:
        return env
    train = Path(dataset_dir).expanduser() / f"{dataset_name}.npz"
    if dataset_path is not None:
        train = Path(dataset_path).expanduser()
    datasets = []
    for path in (train, train.with_name(f"{train.stem}-val.npz")):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} does not exist, and nothing is downloaded. To collect it: "
                f"powderdsl ogbench {level} --out {path.parent}"
            )
        datasets.append(load_dataset(path, np.uint8, np.int32, compact_dataset=compact_dataset))
    return (datasets[0], datasets[1]) if dataset_only else (env, datasets[0], datasets[1])


def load_dataset(
    dataset_path: str | Path,
    ob_dtype: Any = np.float32,
    action_dtype: Any = np.float32,
    compact_dataset: bool = False,
    add_info: bool = False,
) -> Dataset:
    """Load a file of successive episodes as arrays by name; `terminals` marks their last rows.

    Args:
        dataset_path: path of the file, .npz.
        ob_dtype: dtype of observations.
        action_dtype: dtype of actions.
        compact_dataset: False: the last row of each episode, whose action leads nowhere, is only the last row of
            ``next_observations``; ``terminals`` is 1 on the last transition of each. True: all rows stay; ``valids`` is 0
            on the last rows, and ``terminals`` is 1 there and on the rows before.
        add_info: accepted as by OGBench, and ignored.

    Returns:
        ``observations`` and, unless compact, ``next_observations``, of `ob_dtype` [N, H, W, C]; ``actions``, of
        `action_dtype` [N]; ``terminals`` and, if compact, ``valids``, float32 [N].

    Raises:
        ValueError: the file is not such a dataset; the text gives the reason.
        OSError: it cannot be read.
    """
    path = Path(dataset_path)
    try:
        with open_archive(path) as archive:
            shapes = []
            for name in ROWS:
                head = archive.headers.get(name)
                if head is None or head.dtype == "str" or not head.shape:
                    raise BadArchive(f"`{name}` must be an array of numbers")
                shapes.append(head.shape[0])
            if len(set(shapes)) > 1:
                raise BadArchive(f"its arrays have different numbers of rows: {shapes}")
        # NumPy reads into writable memory, as learners expect; the contents have been checked above.
        with np.load(path, allow_pickle=False) as file:
            observations, actions, ends = (file[name] for name in ROWS)
    except BadArchive as error:
        raise ValueError(f"{path} is not a dataset of OGBench: {error}") from None
    last = ends.astype(bool)
    if not len(last) or not last[-1] or last[0] or (last[1:] & last[:-1]).any():
        raise ValueError(
            f"{path} is not a dataset of OGBench: `terminals` does not end episodes of at least two rows"
        )
    before = np.append(last[1:], False)
    observations = observations.astype(ob_dtype, copy=False)
    actions = actions.astype(action_dtype, copy=False)
    if compact_dataset:
        return {
            "observations": observations,
            "actions": actions,
            "terminals": (last | before).astype(np.float32),
            "valids": (~last).astype(np.float32),
        }
    rows = np.flatnonzero(~last)
    return {
        "observations": observations[rows],
        "actions": actions[rows],
        "terminals": before[rows].astype(np.float32),
        "next_observations": observations[rows + 1],
    }
