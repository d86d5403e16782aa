"""The checked task, with names resolved and knobs filled in. Frozen, without torch, and without NumPy except in stamps.

`tasks.file.read_task` creates it from a file; `generator` and `episodes` run it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from powderdsl.diagnostics import Source, Span
from powderdsl.model.state import Slot
from powderdsl.model.types import Expr, Ruleset
from powderdsl.system.settings import UNMEANING
from powderdsl.worlds.raster import Shape, Size

BLOW = -1
"""A choice of an agent: blow instead of placing an element."""

NO_CHANGE = -2
"""A choice of an agent: do nothing."""

MAX_SIDE = 1024
"""Maximum number of rows or columns of a task's worlds."""

MAX_NUMBER = 4096
"""Rows, columns, widths and radii of generated shapes are within ±MAX_NUMBER."""

MAX_REPEATS = 256
"""Maximum number of repetitions of a group."""

NOTHING = 255
"""In stamps and targets: no element. A stamp leaves such a cell unchanged."""


@dataclass(frozen=True)
class Knob:
    """An integer that users can set: ``--knob lines=8``. `value` is its value in this task."""

    name: str
    default: int
    lo: int
    hi: int
    value: int
    about: str = field(metadata=UNMEANING)
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class FieldValue:
    """A field, and the value that a drawing sets in cells of `owners` (None: all elements)."""

    slot: Slot
    parts: tuple[float, ...]
    owners: frozenset[int] | None


@dataclass(frozen=True)
class Drawing:
    """One statement of a generator.

    `number` is its index among all statements and part of the hash of its draws. `amounts` are in the order of
    `worlds.scene.statements.SHAPES`; None is an open end. One of `ids` is drawn uniformly, in the order given. Only
    cells of the region `where` that contain one of `over` are painted.
    """

    number: int
    kind: str
    amounts: tuple[Expr | None, ...]
    ids: tuple[int, ...]
    where: str | None = None
    over: frozenset[int] | None = None
    stamp: str | None = None
    value: FieldValue | None = None
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Group:
    """Drawings repeated `count` times (a number that may be drawn), with local names."""

    number: int
    count: Expr
    most: int
    """The largest `count`."""
    lets: tuple[tuple[str, Expr], ...]
    drawings: tuple[Drawing, ...]


@dataclass(frozen=True)
class Region:
    """A named set of cells: the union of some shapes. Its drawings have no element."""

    name: str
    shapes: tuple[Drawing, ...]
    drawn: bool
    """True if it depends on draws, so that it differs between worlds."""


@dataclass(frozen=True)
class Stamp:
    """A drawn or saved picture: rows of ids, or NOTHING."""

    name: str
    rows: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Target:
    """A picture to compare worlds with: the painted cells of its drawings, and NOTHING elsewhere."""

    name: str
    groups: tuple[Group, ...]


@dataclass(frozen=True)
class Generator:
    """A recipe for start worlds: `fill` everywhere, then all groups in order. `lets` are shared draws."""

    name: str
    fill: int
    lets: tuple[tuple[str, Expr], ...]
    groups: tuple[Group, ...]
    regions: tuple[Region, ...]
    targets: tuple[Target, ...]
    stamps: tuple[Stamp, ...]


@dataclass(frozen=True)
class ParamRange:
    """A parameter of the rules that each world draws uniformly from `low` to `high`; an integer if `whole`."""

    name: str
    low: float
    high: float
    whole: bool


@dataclass(frozen=True)
class Split:
    """A set of worlds: their start states and laws. Fixed scenes are variants.

    World n comes from variant ``n mod len(variants)``, and runs under ruleset ``n div len(variants) mod len(rulesets)``.
    """

    name: str
    about: str = field(metadata=UNMEANING)
    variants: tuple[Generator, ...]
    params: tuple[ParamRange, ...] = ()
    rulesets: tuple[tuple[str, ...], ...] = ()
    """Rules as for `compiler.load`; if empty, all worlds have the task's own."""


@dataclass(frozen=True)
class Agent:
    """The actions that an agent may take, and their number.

    An action is (x, y, choice, vx, vy). The block of `brush` (rows, columns) cells around the center of bin (y, x) of
    `bins` (rows, columns) is filled with the element ``choices[choice]``. For BLOW, its cells get the motion ``speed ·
    (vy − 1, vx − 1)`` as (rows, columns) in the field `speed_field`; for NO_CHANGE, nothing happens.
    """

    choices: tuple[int, ...]
    """Element ids, ascending, then BLOW, then NO_CHANGE. If every element may be placed, choice and id are the same number."""
    brush: Size
    bins: Size
    actions: int
    """Actions of an episode."""
    steps_per_action: int
    free_steps: int
    """Further steps that run as part of the last action."""
    speed_field: str | None
    speed: float

    @property
    def action_nvec(self) -> tuple[int, int, int, int, int]:
        """The number of values of x, y, choice, vx and vy."""
        rows, columns = self.bins
        return columns, rows, len(self.choices), 3, 3

    def first_line(self, axis: int, place: Any, side: int) -> Any:
        """The first row (axis 0) or column of the brush at bins `place`, integers or tensors; may be outside the grid."""
        return (2 * place + 1) * side // (2 * self.bins[axis]) - self.brush[axis] // 2


@dataclass(frozen=True)
class Measure:
    """A number computed from a whole world.

    `how` is ``count sum mean share highest`` of the cell expression `value` over a region (all cells if None), or
    ``match``: the share of a target's cells that contain its element.
    """

    how: str
    value: Expr | None
    region: str | None
    target: str | None = None


@dataclass(frozen=True)
class Goal:
    """Rewards and ends of episodes. `each` is given after every action, `final` with the last; conditions end an episode early.

    Each is arithmetic on one number per world: the arithmetic, comparisons and logic of `model.operations.OPS`, and
    ``measure`` (value: Measure), ``action`` (value: ``taken``, ``left``, ``painted``, ``blown``, ``placed``), ``start``
    and ``before`` (the argument at the start, and after the previous action). Conditions are 0 or 1; x / 0 is 0; ``mod``
    has two arguments.

    `shaped` is not part of the task's definition: it is a reward after every action that can replace `each` and `final`
    in training. See `Task.with_shaped_reward`.
    """

    each: Expr | None
    final: Expr | None
    success: Expr | None
    failure: Expr | None
    shaped: Expr | None = field(default=None, metadata=UNMEANING)


@dataclass(frozen=True)
class ExpertMove:
    """A move of a scripted player.

    `choice` is an index into `Agent.choices`, `toward` the rows and columns (−1, 0 or 1) in which it blows. It acts on
    the bin of `cell`, or on the bin whose block has most cells of the measure `most`. `condition` is a condition as in
    `Goal`, of measures and ``action`` (``taken`` and ``left``); None holds always. `most` counts cells of the shape
    `within` only, and needs `least` of them.
    """

    choice: int
    toward: tuple[int, int]
    cell: tuple[int, int] | None
    most: Measure | None
    condition: Expr | None
    within: Shape | None = None
    least: int = 1


@dataclass(frozen=True)
class Expert:
    """A scripted player. Before each action, it plays the first move whose condition holds and for which enough cells
    of `most` exist. The last move always applies.

    If `search` is not 0, there are no moves: that many random plans are simulated in each world, and the best is
    played.
    """

    moves: tuple[ExpertMove, ...]
    search: int = 0


@dataclass(frozen=True)
class Origin:
    """The file and settings of a task, to read it again under other rules."""

    source: Source
    knobs: Mapping[str, int]
    params: Mapping[str, Any]
    packs: tuple[str, ...]
    shaped: bool = False
    """True if its `shaped` reward has replaced the others."""


@dataclass(frozen=True)
class Task:
    """A checked task. `knobs` are filled in; `ruleset` has the task's parameters."""

    name: str
    about: str = field(metadata=UNMEANING)
    ruleset: Ruleset
    size: Size
    knobs: tuple[Knob, ...]
    agent: Agent
    goal: Goal
    splits: tuple[Split, ...]
    expert: Expert | None = field(default=None, metadata=UNMEANING)
    rules: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """The loaded rules, as for `compiler.load`."""
    family: str = field(default="", metadata=UNMEANING)
    """The kind of task; empty if the file has none."""
    origin: Origin | None = field(default=None, compare=False, repr=False)

    def with_shaped_reward(self) -> Task:
        """The same task with its `shaped` reward instead of the others. Raises ValueError if it has none."""
        if self.goal.shaped is None:
            raise ValueError(f"the task {self.name} has no `shaped` reward")
        goal = replace(self.goal, each=self.goal.shaped, final=None, shaped=None)
        return replace(self, goal=goal, origin=self.origin and replace(self.origin, shaped=True))

    def is_held_out(self, split: Split) -> bool:
        """Return True if all worlds of a split have rules, or a parameter's value, that no world of `train` has."""
        train = self.split("train")
        if split.rulesets and not {*split.rulesets} & ({*train.rulesets} or {self.rules}):
            return True
        usual = {part.name: part for part in train.params}
        pairs = [(part, usual[part.name]) for part in split.params if part.name in usual]
        return any(own.low > trained.high or own.high < trained.low for own, trained in pairs)

    def split(self, name: str) -> Split:
        """The split with a name. Raises KeyError."""
        for split in self.splits:
            if split.name == name:
                return split
        raise KeyError(name)


def still_action(task: Task) -> tuple[int, int, int, int, int]:
    """The action ``nothing`` or, for agents without it that can blow, a blow without speed in the first bin.

    Raises ValueError if the task has neither.
    """
    choices = task.agent.choices
    choice = next((number for number in (NO_CHANGE, BLOW) if number in choices), None)
    if choice is None:
        raise ValueError(
            f"the policy `nothing`: the agent of {task.name} may neither `blow` nor do `nothing`"
        )
    return 0, 0, choices.index(choice), 1, 1
