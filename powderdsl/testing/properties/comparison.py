"""Comparison of two rulesets: a proof that they are equivalent, or a small world on which they differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, cycle, islice, permutations

from powderdsl.arrays import np
from powderdsl.compiler import load
from powderdsl.ir.bits import NotBits
from powderdsl.model.types import Ruleset
from powderdsl.prover.equality import Side, differs, has_own_parameters, narrowed, why_incomparable
from powderdsl.prover.questions import Model
from powderdsl.prover.symbolic import Budget, Renaming, Undecided, deep_recursion
from powderdsl.simulation.simulator import Simulator, compile
from powderdsl.testing.generators.cases import Array, Start
from powderdsl.testing.properties.models import starts
from powderdsl.testing.properties.running import State, first_difference, random_samples, run_sample
from powderdsl.testing.properties.search import SEEDS, Work, shrink_while

COMPARED = 6144
"""Random worlds on which two rulesets are compared."""


Draws = dict[str, Array]
"""Draws [B, H, W] by stream; without any, seeds decide."""


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
    draws: Draws = field(default_factory=dict)
    """Those of its only step, if no seed was found for them."""


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
    names: Renaming | None = None,
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
            model, numbers = difference.transition.model, difference.passes[0]
            place = f"pass `{first.ruleset.passes[numbers[0]].name}`" if numbers else "a pass"
            reason = f"{place} may differ"
    distinction = distinguish(first, second, focus, seed, model, names or Renaming()) if search else None
    status = "undecided" if distinction is None else "differ"
    return Comparison(status, reason, distinction=distinction)


def compare_rules(first: Ruleset, name: str, second: Ruleset, seconds: float) -> Comparison:
    """Compare a ruleset with another one of other files, which `name` loads: elements, fields and draws match by name.

    Draws of `with chance` have no name, and streams may have other names: those of like rules match, others in any order.
    """
    second = _with_ids_of(first, name, second)
    params = _by_last_word([p.name for p in first.params], [p.name for p in second.params])
    sim, results = compile(first, "wasm", tensors=False), list[Comparison]()
    for streams in islice(_matches(first, second), 24):
        ids = {stream.name: stream.ident for stream in first.streams}
        renamed = [replace(s, ident=ids.get(streams.get(s.name, s.name), s.ident)) for s in second.streams]
        other = compile(replace(second, streams=tuple(renamed)), "wasm", tensors=False)
        result = compare(sim, other, seconds, names=Renaming(params, streams), search=not results)
        results.append(result)
        if result.status == "equal":
            given = (
                f"draws of `{b}` are those of `{a}`" for b, a in streams.items() if a in ids.keys() - {b}
            )
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
    known, matched = {word.rpartition(".")[2]: word for word in first}, dict[str, str]()
    for word in sorted(second, key=lambda word: word not in first):  # no two have one name
        other = word if word in first else known.get(word.rpartition(".")[2], word)
        matched[word] = word if other in matched.values() else other
    return matched


def _matches(first: Ruleset, second: Ruleset) -> Iterator[dict[str, str]]:
    """Ways to match the draws of the second with those of the first: by name, by rules that are alike, or in any order."""
    mine, theirs = (_uses(ruleset) for ruleset in (first, second))
    matched = _by_last_word([*mine], [*theirs])
    named = {name: word for name, word in matched.items() if "#" not in name and word in mine}
    free = [name for name in mine if name not in named.values()]
    best = dict[str, str]()
    for name in sorted(theirs.keys() - named, key=lambda name: (theirs[name] not in mine.values(), name)):
        left = [word for word in free if word not in best.values()] or [f"another {name}"]
        best[name] = max(left, key=lambda word: (mine.get(word) == theirs[name], word == matched[name]))
    open_ = [name for name, word in best.items() if mine.get(word) != theirs[name]]
    rest = [word for word in free if word not in best.values()]
    for words in permutations([*map(best.__getitem__, open_), *rest], len(open_)):
        yield named | best | dict(zip(open_, words, strict=True))


def _uses(ruleset: Ruleset) -> dict[str, tuple[int, str]]:
    """The size of draws by stream, and the conditions of the rules that use them, without their name."""
    uses = {stream.name: (stream.bits, "") for stream in ruleset.streams}
    for rule in (rule for p in ruleset.passes for substep in p.substeps for rule in substep.rules):
        for name in {part.value for part in rule.mask.walk() if part.op == "draw"}:
            uses[name] = uses[name][0], uses[name][1] + repr(rule.mask).replace(repr(name), "")
    return uses


def distinguish(
    first: Simulator, second: Simulator, focus: Sequence[int], seed: int, model: Model | None, names: Renaming
) -> Distinction | None:
    """A small world on which two simulators differ, or None if none was found.

    Worlds of a model are tried first. Half of the others are made of elements `focus`, ids that are likely to matter.
    Equal seeds give the same worlds. `names` are the first one's names of the other's parameters and streams.
    """
    slots = tuple(slot.name for slot in first.slots if slot.name in {other.name for other in second.slots})
    sides = (first, Renaming()), (second, names)
    streams = [replace(s, name=words.stream(s.name)) for sim, words in sides for s in sim.ruleset.streams]

    def states(draws: Draws, sample: Start, steps: int) -> Iterator[list[State]]:
        for sim, words in sides:
            drawn = {s.name: draws[words.stream(s.name)] for s in sim.ruleset.streams if draws}
            own = [p.name for p in sim.ruleset.params if sample.params]
            params = {name: sample.params[words.params.get(name, name)] for name in own}
            yield run_sample(sim, replace(sample, params=params), steps, drawn or None)[0]

    def when(draws: Draws, sample: Start, steps: int) -> Array:
        mine, theirs = states(draws, sample, steps)
        return first_difference(mine, theirs, compared)

    batches = [] if model is None else starts(model, replace(first.ruleset, streams=tuple(streams)))
    shown = [(some, sample, n) for sample, draws, steps in batches for some, n in (({}, steps), (draws, 1))]
    differences: list[tuple[tuple[str, ...], Draws, Start, int, Array]] = []
    for draws, sample, steps in chain(shown, _samples(first, second, focus, seed)):
        mine, theirs = states(draws, sample, steps)
        for compared in (slots, slots[:1]):
            if (steps_until := first_difference(mine, theirs, compared)).any():
                differences.append((compared, draws, sample, steps, steps_until))
        if differences and differences[-1][0] == slots[:1]:
            break  # they show more than fields
    for compared, draws, sample, steps, steps_until in sorted(differences, key=lambda some: len(some[0]))[:1]:
        soonest = int(np.where(steps_until > 0, steps_until, steps + 1).argmin())
        small, steps = sample.one(soonest), int(steps_until[soonest])
        draws = {name: values[soonest : soonest + 1] for name, values in draws.items()}
        if draws:  # a seed that draws so, among worlds of a million cells
            many = small.repeated(max((1 << 20) // small.ids.size, 1))
            many = replace(many, seed=np.arange(len(many), dtype=np.int64))
            lucky = when({}, many, 1)
            small, draws = (many.one(int(lucky.argmax())), {}) if lucky.any() else (small, draws)
        if not draws:
            tries, work = SEEDS if streams else 1, Work(first.ruleset, 1_000_000_000)
            small, steps = shrink_while(partial(when, {}), small, steps, tries, work)
        if not streams:
            small = replace(small, seed=np.zeros_like(small.seed))
        end, other_end = (ran[-1] for ran in states(draws, small, steps))
        slot = next(name for name in compared if (end[name] != other_end[name]).any())
        return Distinction(small, steps, slot, end, other_end, draws)
    return None


def _samples(
    first: Simulator, second: Simulator, focus: Sequence[int], seed: int
) -> Iterator[tuple[Draws, Start, int]]:
    """Worlds with the usual parameters, and how many steps they run. Every other batch is made of `focus` alone."""
    kinds, same = np.array(focus, np.uint8), set(first.slots) == set(second.slots)
    batches = zip(random_samples(first.ruleset, seed, COMPARED), cycle((2, 4, 8, 16, 48)), strict=False)
    for number, (sample, steps) in enumerate(batches):
        sample = replace(sample, params={}, step=np.zeros_like(sample.step))
        if number % 2 and len(kinds) > 1:
            sample = replace(sample, ids=kinds[sample.ids % len(kinds)], fields={})
        yield {}, sample if same else replace(sample, fields={}), steps
