"""Every backend against the oracle, bit by bit: shipped rulesets, random rulesets, odd worlds.

A pair is one ruleset with one world. The random pairs are the same in every run: they come from seeds. `make test`
takes the first of them, `make test-all` all. `python -m tests.fuzz` tries others and reduces what fails. Or:

    POWDERDSL_SEEDS=1000..3000 pytest --slow tests/semantics/test_differential.py -k random
"""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from powderdsl.compiler import BACKENDS as powderdsl_backends
from powderdsl.compiler import load, shipped_rules, shipped_tests, shipped_variants
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.syntax.sources import shipped
from powderdsl.targets.cpp.build import ARCHITECTURE, Building, building, find_compiler, flags_for, processor
from powderdsl.testing.generators.cases import Choices, Start, random_start
from tests.compilers import skip_without_compiler
from tests.fuzz import COMPARED, STARTS_AT_ONCE, differential
from tests.fuzz.compare import assert_same, assert_same_worlds, find_difference
from tests.fuzz.differential import Outcome, Plan, run_seed
from tests.fuzz.exercised import constructs, missing, operations
from tests.fuzz.rulemaker import random_ruleset
from tests.semantics.texts import load_text
from tests.tiers import tiered

BACKENDS = ("reference", *STARTS_AT_ONCE)
"""What needs no compiler; the two that do are compared on fewer seeds."""
FIRST, LAST = (int(seed) for seed in os.environ.get("POWDERDSL_SEEDS", "0..1000").split(".."))
CHUNK = 10
CHUNKS = range(FIRST, LAST, CHUNK)
SMOKE = CHUNKS[:1]
MAX_REJECTED = 0.08
"""Share of random texts that the static checks may refuse: it is 0.014."""

COVERED_BY = 200
"""So many random rulesets exercise everything."""


def compositions() -> list[str]:
    """Everything shipped, as it can be loaded: rulesets, and packs with what they need, unless another one provides it."""

    def listed(name: str, key: str) -> list[str]:
        text = (shipped("rules") / f"{name}.yaml").read_text(encoding="utf-8")
        line = re.search(rf"^{key}:(.*)", text, re.MULTILINE)
        return re.findall(r"\w+", line[1]) if line else []

    def with_needs(name: str) -> list[str]:
        return [*(one for word in listed(name, "needs") for one in with_needs(word)), name]

    def loaded(name: str) -> list[str]:
        names = list(dict.fromkeys(with_needs(name)))
        provided = [other for one in names for other in listed(one, "provides")]
        return [one for one in names if one not in provided]

    return ["+".join(loaded(name)) for name in shipped_rules()]


SIZES = [(2, 9, 33), (3, 5, 16), (3, 4, 5), (2, 1, 64), (2, 65, 1), (1, 1, 1), (1, 2, 31), (1, 20, 97)]
STRIPS = [(2, 16, 70), (3, 6, 8), (1, 64, 16), (1, 64, 64), (1, 256, 256), (9, 520, 20), (2, 8, 1)]
"""Worlds that native code cuts into strips: of one row, of more rows than one list of active rows has; large and many."""

QUICK = ["core+bird", "core+fish", "core+wind", "langtons_ant", "life", "margolus"]


@pytest.mark.parametrize("name", tiered(compositions(), QUICK))
def test_shipped_rulesets(name: str) -> None:
    compare_shipped(load(name), BACKENDS, SIZES)


@pytest.mark.parametrize("seed", tiered(range(5), [3]))
def test_universes(seed: int) -> None:
    compare_shipped(load(f"universe:{seed}"), BACKENDS, SIZES[:3])


@pytest.mark.parametrize(
    "name", tiered(sorted(set(shipped_tests()) - shipped_variants()), ["life", "powderworld"])
)
def test_shipped_rulesets_as_native_code(name: str) -> None:
    skip_without_compiler()
    compare_shipped(load(name), ("reference", "native"), SIZES + STRIPS)


def compare_shipped(
    ruleset: Ruleset, backends: Sequence[str], shapes: Sequence[tuple[int, int, int]]
) -> None:
    assert_same_worlds([compile_ruleset(ruleset, backend=backend) for backend in backends], shapes, 3)


LEVELS = {"x86-64-v2": "sse4_2", "x86-64-v3": "avx2", "x86-64-v4": "avx512bw"}
"""Levels of processors, and an instruction set that a machine needs for each."""


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_worlds_do_not_depend_on_vectors(level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    skip_without_compiler()
    if platform.machine() not in ("x86_64", "AMD64") or LEVELS[level] not in processor():
        pytest.skip(f"this processor is not {level}")
    monkeypatch.setenv(ARCHITECTURE, level)
    assert any(one.replace("_", "-") == f"-march={level}" for one in flags_for(find_compiler(), "-O0"))
    with building(Building("-O0", tmp_path)):
        compare_shipped(
            load("core+sand+water+wind"),
            ("torch", "native"),
            [(5, 8, 70), (9, 7, 33), (33, 7, 16), (1, 64, 16), (40, 7, 8), (3, 16, 8)],
        )


def test_parameters_may_differ_by_world(torch) -> None:  # type: ignore[no-untyped-def]
    """A batch with a value for each world equals the worlds alone with theirs, on cells, planes and native code."""
    rules = load("powderworld")
    rates = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    ids = torch.randint(14, (3, 8, 40), generator=torch.Generator().manual_seed(1))
    oracle = compile_ruleset(rules, backend="reference")
    for backend in ("torch", "native", "wasm"):
        skip_without_compiler(backend)
        sim = compile_ruleset(rules, backend=backend)
        together = sim.step(sim.world(ids, seed=4), 3, params={"water.melt": rates, "fire.spread": rates})
        for i, rate in enumerate(rates.tolist()):
            alone = oracle.world(ids[i : i + 1], seed=4, index=[i])
            alone = oracle.step(alone, 3, params={"water.melt": rate, "fire.spread": rate})
            assert find_difference(alone.state, together.select([i]).state) is None, backend


@pytest.mark.parametrize("seed", range(4))
def test_what_is_skipped_changes_nothing(seed: int, torch) -> None:  # type: ignore[no-untyped-def]
    """Full worlds and nearly empty ones, with wind and without: the same worlds."""
    rules = load("powderworld")
    oracle, other = compile_ruleset(rules, backend="torch"), compile_ruleset(rules, backend="wasm")
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randint(14, (5, 30, 64), generator=generator)
    ids[torch.rand(ids.shape, generator=generator) < (0.2, 0.2, 0.9, 0.9)[seed]] = 0
    velocity = torch.randn((5, 2, 30, 64), generator=generator) * 5
    velocity[:, :, :, 40:] = 0
    for wind in (velocity, 0 * velocity):
        worlds = [sim.replace(sim.world(ids, seed=seed), velocity=wind) for sim in (oracle, other)]
        for _ in range(6):
            worlds = [world.sim.step(world, 2) for world in worlds]
            assert find_difference(worlds[0].state, worlds[1].state) is None


def test_elements_that_appear_are_found_by_later_passes(torch) -> None:  # type: ignore[no-untyped-def]
    rules = load_text(
        "pack: appearing\nelements:\n  zero: {id: 0, color: '#000000'}\n  one: {id: 1, color: '#808080'}\n"
        "  two: {id: 2, color: '#F0F0F0'}\npasses:\n  first: {do: any -> one}\n  second: {do: '(zero, one) -> zero'}\n"
    )
    for shape in ((1, 8, 64), (2, 3, 5)):
        for start in range(3):
            ids = torch.full(shape, start)
            for backend in ("reference", "wasm", "native"):
                skip_without_compiler(backend)
                sim = compile_ruleset(rules, backend=backend)
                assert not sim.step(sim.world(ids)).ids.any(), (backend, shape, start)


def agreed(outcomes: Iterable[Outcome]) -> int:
    """How many worlds agreed. Fails with the first that did not, and how to run it again."""
    worlds = 0
    for outcome in outcomes:
        for found in outcome.findings:
            again = f"python -m tests.fuzz --seeds {outcome.seed}..{outcome.seed + 1} --backends {found.case.backend}"
            pytest.fail(
                f"{found.case.backend} {found.problem}\n{again}\n{found.case.start}\n{found.case.text}"
            )
        worlds += outcome.worlds
    return worlds


@pytest.mark.parametrize("first", tiered(CHUNKS, SMOKE))
def test_random_rulesets(first: int) -> None:
    seeds = range(first, min(first + CHUNK, LAST))
    assert agreed(run_seed(seed, Plan(worlds=4, steps=2)) for seed in seeds) >= 3 * len(seeds)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "level"), [(range(40, 46), "-O0"), (range(46, 48), "-O1"), (range(48, 60), "-O2")]
)
def test_random_rulesets_as_native_code(seeds: range, level: str, tmp_path: Path) -> None:
    """Few, since each takes seconds to compile; the level of optimization changes nothing."""
    skip_without_compiler()
    plan = Plan(("native",), worlds=4, steps=3, building=Building(level, tmp_path))
    assert agreed(run_seed(seed, plan) for seed in seeds) >= 4


def test_every_target_is_compared_once() -> None:
    """Each backend but `auto`, which runs one of the others, those that compile for minutes, and CUDA as what runs here."""
    targets = set(powderdsl_backends) - {"auto", "cuda", "torch-fused"}
    assert set(BACKENDS) < {"reference", *COMPARED} == targets | {"cuda-emulated"}
    assert len(set(COMPARED)) == len(COMPARED)
    skip_without_compiler()
    made = {
        name: differential._compiled(load("life"), name, Building("-O0"), 1)._program for name in COMPARED
    }
    programs = {name: (type(one), getattr(one, "running", name)) for name, one in made.items()}
    assert len(set(programs.values())) == len(COMPARED), programs


def test_draws_from_outside() -> None:
    """Draws that the caller gives count the same on every backend; extremes among them."""
    generator = np.random.default_rng(5)
    for seed in range(FIRST, FIRST + 12):
        ruleset = random_ruleset(seed)
        if ruleset is None or not ruleset.streams:
            continue
        start = random_start(ruleset, Choices.seeded(seed), (2, 3, 33))
        edges = [0.0, 0.5, 0.05, 1 - 2.0**-24, 2.0**-16, 0.2]
        draws = {
            stream.name: np.where(generator.random(start.ids.shape) < 0.5, generator.random(start.ids.shape), generator.choice(edges, start.ids.shape))
            for stream in ruleset.streams
        }  # fmt: skip
        simulators = [compile_ruleset(ruleset, backend=backend) for backend in BACKENDS]
        assert_same(start, simulators, random=draws)


@pytest.mark.slow
def test_random_rulesets_use_all_that_targets_see_and_few_are_refused() -> None:
    """Every construct and every operation, on numbers and on bit planes; the lists come from the compiler's tables."""
    used: set[tuple[str, str]] = set()
    seed = refused = 0
    while missing(used) and seed < COVERED_BY:
        ruleset = random_ruleset(seed)
        seed += 1
        if ruleset is None:
            refused += 1
        else:
            used |= {*constructs(ruleset)} | operations(ruleset)
    assert not missing(used)
    assert refused <= MAX_REJECTED * seed


def test_a_difference_is_found_and_located() -> None:
    ruleset = load_text(
        "pack: p\nfields: {f: {type: 0..9, at: place}}\nelements: {a: {id: 0, color: '#000000'}}\n"
        "passes:\n  first: {do: f += 1}\n  second: {do: f += step mod 2}\n"
    )
    start = Start.fresh(np.zeros((2, 3, 4), np.uint8))
    right, wrong = compile_ruleset(ruleset, backend="reference"), compile_ruleset(ruleset, backend="torch")
    assert_same(start, [right, wrong], 3)
    step = wrong.step

    def broken(world, **options):  # type: ignore[no-untyped-def]
        after = step(world, **options)
        if int(after.step[0]) < 2:
            return after
        values = after["f"].clone()
        values[1, 2, 3] = 7
        return wrong.replace(after, f=values)

    wrong.step = broken  # type: ignore[method-assign]
    with pytest.raises(
        AssertionError, match=r"differ after step 2: `f` at \(1, 2, 3\): 3 and 7 \(1 differ\)"
    ) as found:
        assert_same(start, [right, wrong], 3)
    assert "f += step mod 2" in str(found.value)


def test_floats_are_compared_by_their_bits() -> None:
    one = np.array([1.0, 0.0, np.nan], np.float32)
    assert find_difference({"f": one}, {"f": np.array([1.0, -0.0, np.nan], np.float32)}) is None
    difference = find_difference(
        {"f": one}, {"f": np.array([np.nextafter(np.float32(1), 2), 0.0, np.nan], np.float32)}
    )
    assert difference.cell == (0,)
    assert find_difference({"f": one}, {"f": one.astype(np.float64)}) is not None
