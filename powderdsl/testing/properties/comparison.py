"""Two rulesets, compared: proven equal, or told apart by a small world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, cycle, islice, permutations

from powderdsl.arrays import np
from powderdsl.compiler import load
from powderdsl.ir.bits import NotBits
from powderdsl.model.types import Ruleset
from powderdsl.prover.equality import Side, differs, has_own_parameters, narrowed, why_incomparable
from powderdsl.prover.questions import Model
from powderdsl.prover.symbolic import Budget, Names, Undecided, deep_recursion
from powderdsl.simulation.simulator import Simulator, compile
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.properties.models import starts
from powderdsl.testing.properties.running import State, first_difference, random_samples, run_sample
from powderdsl.testing.properties.search import Work, shrink_while

COMPARED = 6144
"""Random worlds on which two rulesets are compared."""

RUN_STEPS = (2, 4, 8, 16, 48)
"""How many steps batches run, one after the other."""

TRIED_SEEDS = 16
"""With how many seeds a smaller world is tried."""

WORK = 1_000_000_000
"""Work for making a world smaller, see `testing.properties.search`."""


@dataclass(frozen=True)
class Distinction:
    """One world on which two compositions differ after some steps: in `slot`, if not already in elements.

    `first` and `second` are the states after the last step.
    """

    sample: Start
    steps: int
    slot: str
    first: State
    second: State


@dataclass(frozen=True)
class Comparison:
    """The result of comparing two rulesets: ``equal``, ``differ`` or ``undecided``, and why.

    `given` are assumptions of a proof; `distinction` is a world on which they differ.
    """

    status: str
    reason: str
    given: tuple[str, ...] = ()
    distinction: Distinction | None = None


def compare(
    first: Simulator,
    second: Simulator,
    seconds: float,
    focus: Sequence[int] = (),
    seed: int = 0,
    names: Names | None = None,
    search: bool = True,
) -> Comparison:
    """Prove that two rulesets are equal, or, with `search`, find a small world on which they differ.

    `seconds` of work go into the proof. `names` are the first one's names of the other's parameters and streams, if that has
    other files; otherwise all worlds of the first count.
    """
    model, reason = None, why_incomparable(first.ruleset, second.ruleset)
    fewer = [] if reason else narrowed(first.ruleset, second.ruleset)
    if fewer and names is None:
        reason = f"`{fewer[0]}` holds fewer values"
    if reason is None:
        try:
            with deep_recursion():
                sides = Side.of(first.ruleset), Side.of(second.ruleset, names)
                difference = differs(*sides, Budget.of(seconds))
        except (Undecided, NotBits) as error:
            reason = str(error)
        else:
            if difference is None:
                given = ["parameters have their defaults"] if has_own_parameters(*sides) else []
                more = narrowed(second.ruleset, first.ruleset)
                given += [f"`{name}` starts with what both can hold" for name in sorted({*fewer, *more})]
                return Comparison(
                    "equal", "each pass does the same with every well-formed world", tuple(given)
                )
            model, number = difference.moment.model, (*difference.passes[0], -1)[0]
            reason = (
                f"pass `{first.ruleset.passes[number].name}` may differ"
                if number >= 0
                else "a pass may differ"
            )
    distinction = distinguish(first, second, focus, seed, model) if search else None
    status = "undecided" if distinction is None else "differ"
    return Comparison(status, reason, distinction=distinction)


MAX_MATCHES = 24
"""Ways in which draws without a name are matched."""


def compare_rules(first: Ruleset, name: str, second: Ruleset, seconds: float) -> Comparison:
    """Compare a ruleset with another one of other files, which `name` loads: elements, fields and draws match by name.

    Draws of `with chance` have no name. If they do not match in the order of the rules, other orders are tried.
    """
    second = _with_ids_of(first, name, second)
    params = _by_last_word([p.name for p in first.params], [p.name for p in second.params])
    sim, results = compile(first, "wasm", tensors=False), list[Comparison]()
    for streams in islice(_matches(first, second), MAX_MATCHES):
        idents = {stream.name: stream.ident for stream in first.streams}
        renamed = [replace(s, ident=idents.get(streams.get(s.name, s.name), s.ident)) for s in second.streams]
        other = compile(replace(second, streams=tuple(renamed)), "wasm", tensors=False)
        result = compare(sim, other, seconds, names=Names(params, streams), search=not results)
        results.append(result)
        if result.status == "equal":
            given = tuple(f"draws of `{b}` are those of `{a}`" for b, a in streams.items() if a != b)
            return replace(result, given=(*result.given, *given))
    return results[0]


def _with_ids_of(first: Ruleset, name: str, second: Ruleset) -> Ruleset:
    """The second ruleset, loaded again so that elements of the same name have the ids of the first."""
    words = {element.name: element.qualified for element in second.elements}
    palette: list[str | None] = [None] * first.slots
    for element in first.elements:
        palette[element.id] = words.get(element.name)
    passes = {p.name for p in second.passes}
    loaded = load(name, palette=palette)
    return replace(loaded, passes=tuple(p for p in loaded.passes if p.name in passes))


def _by_last_word(first: Sequence[str], second: Sequence[str]) -> dict[str, str]:
    """The first one's names by the other's, that are the same or end in the same word after a dot."""
    known = {word.rpartition(".")[2]: word for word in first}
    return {word: word if word in first else known.get(word.rpartition(".")[2], word) for word in second}


def _matches(first: Ruleset, second: Ruleset) -> Iterator[dict[str, str]]:
    """Ways to match the draws of the second with those of the first: by name, then in any order where they have none."""
    names, others = ([stream.name for stream in ruleset.streams] for ruleset in (first, second))
    matched = _by_last_word(names, others)
    yield matched
    free = [name for name in names if "#" in name]
    open_ = [name for name in others if "#" in name]
    for order in permutations(free, len(open_)) if len(open_) <= len(free) else ():
        match = matched | dict(zip(open_, order, strict=True))
        if match != matched:
            yield match


def distinguish(
    first: Simulator, second: Simulator, focus: Sequence[int] = (), seed: int = 0, model: Model | None = None
) -> Distinction | None:
    """A small world on which two simulators differ, or None if none was found.

    Worlds of a model are tried first. Half of the others are made of elements `focus`, ids that are likely to matter.
    Equal seeds give the same worlds.
    """
    known = {slot.name for slot in second.slots}
    names = tuple(slot.name for slot in first.slots if slot.name in known)
    tries = TRIED_SEEDS if first.ruleset.streams or second.ruleset.streams else 1

    def states(sample: Start, steps: int) -> tuple[list[State], list[State]]:
        return run_sample(first, sample, steps)[0], run_sample(second, sample, steps)[0]

    def when(compared: Sequence[str], sample: Start, steps: int) -> Array:
        return first_difference(*states(sample, steps), compared)

    shown = [] if model is None else [(sample, steps) for sample, _, steps in starts(model, first.ruleset)]
    for compared in (names[:1], names):  # the worlds' elements show more than their fields
        for sample, steps in chain(shown, _samples(first, second, focus, seed)):
            steps_until = when(compared, sample, steps)
            if not steps_until.any():
                continue
            soonest = int(np.where(steps_until > 0, steps_until, steps + 1).argmin())
            small, steps = shrink_while(
                partial(when, compared),
                sample.one(soonest),
                int(steps_until[soonest]),
                tries,
                Work(first.ruleset, WORK),
            )
            if tries == 1:
                small = replace(small, seed=np.zeros_like(small.seed))
            mine, theirs = (ran[-1] for ran in states(small, steps))
            slot = next(name for name in compared if (mine[name] != theirs[name]).any())
            return Distinction(small, steps, slot, mine, theirs)
    return None


def _samples(
    first: Simulator, second: Simulator, focus: Sequence[int], seed: int
) -> Iterator[tuple[Start, int]]:
    """Worlds with the usual parameters, and how many steps they run. Every other batch is made of `focus` alone."""
    kinds, same = np.array(focus, np.uint8), set(first.slots) == set(second.slots)
    batches = zip(random_samples(first.ruleset, seed, COMPARED), cycle(RUN_STEPS), strict=False)
    for number, (sample, steps) in enumerate(batches):
        sample = replace(sample, params={}, step=np.zeros_like(sample.step))
        if number % 2 and len(kinds) > 1:
            sample = replace(sample, ids=kinds[sample.ids % len(kinds)], fields={})
        yield sample if same else replace(sample, fields={}), steps
