"""The backend `torch` on bit planes: both libraries give the same worlds, and `torch.compile` does too."""

from __future__ import annotations

import re
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from powderdsl import CompileError, load
from powderdsl.compiler import segments_of
from powderdsl.ir.ops import FLAG, Graph, PassGraph, Program, SlotType
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.targets.job import Clock, Job
from powderdsl.targets.torch.packed import PlanesProgram
from powderdsl.targets.torch.planes import pass_source
from powderdsl.targets.torch.program import TorchProgram
from tests.compilers import skip_without_compiler
from tests.fuzz import PORTABLE
from tests.fuzz.compare import assert_same_worlds, find_difference
from tests.fuzz.differential import Plan, portable, run_seed
from tests.semantics.test_differential import agreed
from tests.semantics.texts import load_text
from tests.tiers import tiered

SHAPES = [(2, 9, 64), (3, 7, 13), (1, 6, 100), (2, 5, 130), (1, 8, 96), (1, 3, 2), (2, 4, 1)]
"""Worlds, rows and columns: part of a word, whole words, and words whose last half is unused."""

NAMED = """\
pack: named
elements:
  zero: {id: 0, color: '#000000'}
  one: {id: 1, color: '#808080'}
fields:
  n0: {type: 0..5, at: place}
  n2: {type: real(-9..9), at: place}
  b1: {type: 0..3, at: element, of: one}
streams: [s1]
passes:
  first:
    conflicts: first_wins
    do:
      - n0 := 5 - n0 where s1 < 0.5
      - n2 := n2 / 2 + n0
      - one swaps right if right is zero
      - zero -> one with chance 25%
"""


@pytest.mark.parametrize("library", ["eager", "portable"])
@pytest.mark.parametrize(
    "name", tiered(["powderworld", "powderworld2", "life", "langtons_ant"], ["powderworld"])
)
def test_shipped_rules_on_both_libraries(name: str, library: str) -> None:
    rules = load(name)
    torch_form = compile_ruleset(rules, backend="torch")
    simulator = torch_form if library == "eager" else portable(torch_form)
    assert_same_worlds([compile_ruleset(rules, backend="torch-cells"), simulator], SHAPES, 4)


@pytest.mark.parametrize("first", tiered([0, 12, 24, 36, 48], [0]))
def test_random_rules_on_the_portable_library(first: int) -> None:
    seeds = range(first, first + 12)
    assert agreed(run_seed(seed, Plan((PORTABLE,), worlds=4, steps=2)) for seed in seeds) >= 24


def test_fields_may_have_the_names_of_variables(torch: Any) -> None:
    rules = load_text(NAMED)
    backends = ("reference", "torch-cells", "torch")
    assert_same_worlds([compile_ruleset(rules, backend=name) for name in backends], [(2, 6, 20)], 4)


def test_a_step_leaves_the_worlds_before_it_alone(torch: Any) -> None:
    """Functions overwrite what they made themselves, never their arguments."""
    rules = load("powderworld")
    simulator = compile_ruleset(rules, backend="torch")
    ids = torch.randint(14, (2, 12, 40), generator=torch.Generator().manual_seed(0))
    first = simulator.step(simulator.world(ids, seed=1), 3)
    fresh = simulator.step(simulator.world(ids, seed=1), 3)
    ahead = simulator.step(first, 5)
    assert find_difference(first.state, fresh.state) is None
    assert find_difference(simulator.step(first, 5).state, ahead.state) is None
    first.state["velocity"].add_(1)  # not a tensor of inference mode


def test_worlds_beyond_a_chunk_are_the_same(torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("powderdsl.targets.torch.packed.CHUNK", 3 * 8 * 10)
    rules = load("core+sand+water+fire")
    assert_same_worlds([compile_ruleset(rules, backend=name) for name in ("wasm", "torch")], [(8, 8, 10)], 4)


def test_threads_share_a_simulator(torch: Any) -> None:
    simulator = compile_ruleset(load("powderworld"), backend="torch")
    ids = torch.randint(14, (4, 16, 64), generator=torch.Generator().manual_seed(0))
    want = simulator.step(simulator.world(ids, seed=2), 6).ids
    results: list[Any] = []
    threads = [
        Thread(target=lambda: results.append(simulator.step(simulator.world(ids, seed=2), 6).ids))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    assert all(torch.equal(ids, want) for ids in results)


def test_planes_that_move_alike_move_together() -> None:
    """One movement for each way to fall, not one for each plane."""
    (segment,) = segments_of(load("powderworld"))
    assert segment.planes is not None
    texts = {p.name: pass_source(segment.planes, p, i).text for i, p in enumerate(segment.planes.passes)}
    assert len(re.findall(r"k\.swap\(", texts["gravity"])) == 4
    assert len(re.findall(r"k\.leave\(", texts["wind"])) == 16
    assert "torch.where" not in "".join(texts.values())


def test_equal_planes_may_leave_other_things_behind(torch: Any) -> None:
    graph = Graph()
    content, movers = graph.input("element", FLAG), graph.input("movers", FLAG)
    rests = [content, graph.and_(content, graph.not_(movers)), graph.or_(content, movers), movers]
    moved = [graph.derive("arrive", content, movers, rest, attr=(0, 1)) for rest in rests]
    names = ("a", "b", "c", "d")
    slots = [SlotType(name, FLAG, 0, resets=False) for name in ("element", "movers", *names)]
    pass_ = PassGraph("moving", "", (), tuple(zip(names, moved, strict=True)))
    program, cpu = Program("moving", tuple(slots), (), (), (pass_,)), torch.device("cpu")
    generator = torch.Generator().manual_seed(0)
    state = {slot.name: torch.rand(2, 5, 70, generator=generator) < 0.5 for slot in slots}
    clock = Clock(*torch.zeros(3, 2, dtype=torch.int64))
    job = Job(state, clock, 1, {}, {}, None)
    eager = PlanesProgram(program, program, cpu)
    other = PlanesProgram(program, program, cpu)
    other.eager = False
    want = TorchProgram(program, cpu).run(job)
    for planes in (eager, other):
        assert find_difference(want, planes.run(job)) is None


@pytest.fixture
def one_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler with an empty cache, which must not compile a function twice."""
    import powderdsl.targets.torch.fuse as fuse

    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    compile, known = fuse._compiled, list[Any]()

    def once(function: Any, *args: Any) -> Any:
        assert not any(function is other for other in known), "compiled twice"
        known.append(function)
        return compile(function, *args)

    monkeypatch.setattr(fuse, "_compiled", once)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["life", "core+water", "powderworld"])
@pytest.mark.usefixtures("one_graph")
def test_compiled_functions_give_the_same_worlds(name: str, torch: Any) -> None:
    """They are compiled once, whatever the step, the seed and the parameters."""
    skip_without_compiler()
    rules = load(name)
    simulators = [compile_ruleset(rules, backend=name) for name in ("wasm", "torch-fused")]
    known = torch.tensor([element.id for element in rules.elements])
    ids = known[torch.randint(len(known), (4, 16, 64), generator=torch.Generator().manual_seed(0))]
    params = [{}, {rules.params[0].name: torch.tensor([0.0, 0.2, 0.5, 1.0])}] if rules.params else [{}]
    for seed, settings in enumerate(params):
        worlds = [simulator.world(ids, seed=seed) for simulator in simulators]
        for steps in (1, 3, 7):
            worlds = [world.sim.step(world, steps, params=settings) for world in worlds]
            assert find_difference(worlds[0].state, worlds[1].state) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(200, 250))
def test_random_rules_compiled(seed: int) -> None:
    skip_without_compiler()
    agreed([run_seed(seed, Plan(("torch-fused",), worlds=1, steps=2))])


def test_settings_of_exactness() -> None:
    """Inductor refuses options that it does not know; here each is named. Why each is needed: docs/compiler.md."""
    import torch._inductor.config as config

    from powderdsl.targets.torch.fuse import SETTINGS

    assert set(SETTINGS) <= set(config.get_config_copy())
    exact = {name: value for name, value in SETTINGS.items() if "threshold" not in name}
    assert exact == {
        "cpp.enable_floating_point_contract_flag": "off",
        "emulate_precision_casts": True,
        "eager_numerics.division_rounding": True,
        "eager_numerics.disable_ftz": True,
    }


def test_settings_of_exactness_reach_triton() -> None:
    """What they do to kernels of a GPU, in inductor's own source: no GPU is needed to read it."""
    import torch._inductor.codegen.triton as triton

    source = Path(str(triton.__file__)).read_text()
    assert '"enable_fp_fusion": not config.emulate_precision_casts' in source
    assert '"disable_ftz": config.eager_numerics.disable_ftz' in source
    assert "div_rn(" in source[source.index("config.eager_numerics.division_rounding") :][:400]


def test_compiled_functions_are_kept_in_our_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in a folder in /tmp, whose name everybody knows: torch sets that when it is imported."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    from powderdsl.targets.torch.fuse import fused

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    assert not Path(cache_dir()).is_relative_to(tmp_path)
    fused(lambda number: number)
    assert cache_dir() == str(tmp_path / "powderdsl" / "inductor")
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "mine"))
    fused(lambda number: number)
    assert cache_dir() == str(tmp_path / "mine")


def test_a_missing_compiler_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "/nowhere/g++")
    with pytest.raises(CompileError) as caught:
        compile_ruleset("life", backend="torch-fused")
    (error,) = caught.value.diagnostics
    assert error.code == "PD701"
    assert "apt install g++" in error.helps[0]
