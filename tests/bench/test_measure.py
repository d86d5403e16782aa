"""Measuring: the plan, the worlds, the order of the rounds, the figures, and what passes cost. Times are not tested."""

from __future__ import annotations

import time
from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

import powderdsl
from powderdsl.experiments.bench import Plan, Program, _Subject, measuring, number, start_worlds
from powderdsl.targets.cpp.build import Building, building

TINY = {"sizes": [(6, 8)], "batches": [1, 3], "rounds": 2, "seconds": 1e-3, "steps": 2}


@pytest.fixture(scope="module")
def rules():
    return powderdsl.load("core+sand+water+wind")


def test_a_plan_is_a_cross_product_without_repeats(rules):
    plan = Plan(rules, backends=["wasm", "torch"], batches=[1, 4, 1], sizes=[(8, 8), (4, 6)], threads=[1, 2])
    assert len(plan.cells) == len(set(plan.cells)) == 16
    assert {cell.threads for cell in plan.cells} == {1, 2}


def test_few_takes_what_moves(rules):
    assert [element.name for element in Plan(rules, workload="few").elements] == ["sand", "water"]
    assert Plan(powderdsl.load("life"), workload="few").elements  # nothing moves there


def worlds(rules, workload, **options):
    plan = Plan(rules, workload=workload, seed=1, **{"batches": [3], "sizes": [(40, 50)], **options})
    return start_worlds(powderdsl.compile(rules, "torch"), plan, plan.cells[0])


@pytest.mark.parametrize("workload", ["gusts", "shapes", "noise", "few"])
def test_worlds_of_every_workload(rules, workload):
    world = worlds(rules, workload)
    assert world.shape == (3, 40, 50)
    present = set(world.ids.unique().tolist())
    names = {element.name for element in rules.elements if element.id in present}
    assert names <= ({"empty", "sand", "water"} if workload == "few" else {e.name for e in rules.elements})
    assert len(names) >= 3
    assert bool(world["velocity"].any()) == (workload in ("gusts", "noise"))
    alone = worlds(rules, workload, batches=[1])
    assert (alone.ids[0] == world.ids[0]).all()
    assert (alone["velocity"][0] == world["velocity"][0]).all()


def test_gusts_blow_at_one_speed(rules):
    assert set(worlds(rules, "gusts", sizes=[(128, 128)])["velocity"].unique().tolist()) == {-20.0, 0.0, 20.0}


def test_worlds_have_the_elements_that_were_chosen(rules):
    assert set(worlds(rules, "noise", only=["empty", "wall"]).ids.unique().tolist()) == {0, 1}
    water = rules.element("water").id
    assert set(worlds(rules, "shapes", only=["water"]).ids.unique().tolist()) == {0, water}
    assert set(worlds(rules, "shapes", only=["empty"]).ids.unique().tolist()) == {0}


def test_rounds_are_interleaved_and_loading_is_not_timed(rules, torch):
    """Each sample is charged with its own steps and nothing else."""
    called = []

    def program(name, seconds):
        def load(state):
            time.sleep(0.2)

            def run(steps):
                called.append(name)
                time.sleep(seconds)

            return run

        return Program(name, load)

    programs = [program("quick", 0), program("slow", 0.05)]
    plan = Plan(rules, backends=(), programs=programs, **{**TINY, "batches": [1]})
    figures = []
    assert [cell.backend for kind, cell in measuring(plan, figures) if kind == "measure"] == [
        *("quick", "slow", "quick", "slow")
    ]
    assert called[-4:] == ["quick", "slow", "quick", "slow"]
    quick, slow = (one.round_seconds for one in figures)
    assert max(quick) < 0.05 <= min(slow)
    assert max(slow) < 0.2


def test_all_cells_are_ready_before_the_first_round_and_costs_come_last(torch):
    plan = Plan(powderdsl.load("life"), backends=["torch", "wasm"], profile=True, **TINY)
    kinds = [kind for kind, _ in measuring(plan, [])]
    assert kinds == ["compile"] * 4 + ["measure"] * 8 + ["profile"] * 4


def test_a_backend_that_fails_in_a_round_does_not_end_the_others(torch, monkeypatch):
    plan = Plan(powderdsl.load("life"), backends=["torch", "wasm"], check=True, **{**TINY, "batches": [1]})
    figures = []
    parts = measuring(plan, figures)
    assert next(kind for kind, _ in parts if kind == "measure")
    monkeypatch.setattr("powderdsl.targets.torch.packed.PlanesProgram.run", lambda self, job: 1 // 0)
    assert len(list(parts)) == 3
    assert [(one.check.split(":")[0], len(one.round_seconds)) for one in figures] == [
        ("ZeroDivisionError", 1),
        ("equal", 2),
    ]


def test_kernels_and_copies_of_a_gpu_are_counted(torch, monkeypatch):
    """Without a GPU: the profiler's events are made up. Calls of its driver, and regions with names, do not count."""
    launch, kernel, copy, region = (
        SimpleNamespace(device_type=SimpleNamespace(name=kind), cpu_children=[], is_user_annotation=named)
        for kind, named in [("CPU", False), ("CUDA", False), ("CUDA", False), ("CUDA", True)]
    )
    trace, asked = Mock(events=lambda: [launch, kernel, launch, copy, region]), []
    monkeypatch.setattr(
        "torch.profiler.profile", lambda activities: asked.extend(activities) or nullcontext(trace)
    )
    monkeypatch.setattr("powderdsl.experiments.bench.now", lambda device: 0.0)
    subject = _Subject(Mock(), Mock(), None, Mock())
    subject.sim.device.type = "cuda"
    assert subject.kernels(4) == 2 / 4
    assert [activity.name for activity in asked] == ["CUDA"]
    assert subject.sim.step.call_args.args == (subject.world, 4)
    subject.sim.device.type = "mps"
    assert subject.kernels(4) is None


def test_torch_has_its_threads_back(rules, torch):
    before = torch.get_num_threads()
    parts = measuring(Plan(rules, backends=["torch"], threads=[before + 1], **TINY), [])
    next(kind for kind, _ in parts if kind == "measure")
    assert torch.get_num_threads() == before + 1
    parts.close()
    assert torch.get_num_threads() == before


def test_numbers_have_three_figures():
    shown = {0.01234: "0.0123", 12.34: "12.3", 1234.5: "1,234", 12.34e6: "12.3M"}
    assert {value: number(value) for value in shown} == shown


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["reference", "torch", "native", "wasm"])
def test_every_backend_profiles_every_pass(backend, tmp_path, torch):
    rules = powderdsl.load("core+sand")  # little to compile
    with building(Building("-O0", tmp_path)):
        sim = powderdsl.compile(rules, backend)
        plan = Plan(rules, workload="noise", **TINY)
        world = start_worlds(sim, plan, plan.cells[1])
        seconds = sim.profile(world, 3)
    assert tuple(seconds) == sim.passes
    assert all(value > 0 for value in seconds.values())
