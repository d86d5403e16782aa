"""Measuring: the plan, the worlds, the order of the rounds, the figures, and what passes cost. Times are not tested."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

import powderdsl
from powderdsl.experiments.bench import make_plan, measure, report_data, report_text
from powderdsl.experiments.bench.machine import Machine, Memory, peak_growth
from powderdsl.experiments.bench.measure import interleaved, measuring
from powderdsl.experiments.bench.plan import start_worlds
from powderdsl.experiments.bench.report import CellFigures, make_report, number
from powderdsl.model.state import slots
from powderdsl.targets.cpp.build import Building, building

TINY = {"sizes": [(6, 8)], "batches": [1, 3], "rounds": 2, "seconds": 1e-3, "steps": 2}


@pytest.fixture(scope="module")
def rules():
    return powderdsl.load("core+sand+water+wind")


# The plan


def test_a_plan_is_a_cross_product_without_repeats(rules):
    plan = make_plan(
        rules, backends=["wasm", "torch"], batches=[1, 4, 1], sizes=[(8, 8), (4, 6)], elements=[2, 3]
    )
    assert len(plan.cells) == len(set(plan.cells)) == 16
    assert {cell.elements for cell in plan.cells} == {("empty", "wall"), ("empty", "wall", "sand")}


def test_few_takes_what_moves(rules):
    assert make_plan(rules, workload="few").cells[0].elements == ("sand", "water")
    assert make_plan(powderdsl.load("life"), workload="few").cells[0].elements  # nothing moves there


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"batches": [0]}, "batches"),
        ({"batches": []}, "batches"),
        ({"sizes": [(0, 4)]}, "sizes"),
        ({"threads": [0]}, "threads"),
        ({"rounds": 0}, "rounds"),
        ({"steps": 0}, "steps"),
        ({"seconds": math.nan}, "seconds"),
        ({"seconds": 0}, "seconds"),
        ({"elements": [99]}, "1 to"),
        ({"elements": [2], "only": ["sand"]}, "not by both"),
        ({"only": ["snad"]}, "did you mean `sand`"),
        ({"workload": "gust"}, "did you mean `gusts`"),
        ({"backends": ["natve"]}, "did you mean `native`"),
    ],
)
def test_bad_plans_are_refused(rules, options, words):
    with pytest.raises((ValueError, KeyError), match=words):
        make_plan(rules, **options)


def test_too_many_cells_are_refused(rules):
    with pytest.raises(powderdsl.CompileError) as caught:
        make_plan(rules, batches=[1 << 20], sizes=[(4096, 4096)])
    assert caught.value.diagnostics[0].code == "PD607"


# The worlds


def worlds(rules, workload, **options):
    plan = make_plan(rules, workload=workload, **{"batches": [3], "sizes": [(40, 50)], **options})
    return start_worlds(powderdsl.compile(rules, "torch"), plan.cells[0], workload, seed=1)


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
    assert set(worlds(rules, "noise", elements=[2]).ids.unique().tolist()) == {0, 1}
    water = rules.element("water").id
    assert set(worlds(rules, "shapes", only=["water"]).ids.unique().tolist()) == {0, water}
    assert set(worlds(rules, "shapes", elements=[1]).ids.unique().tolist()) == {0}


def test_larger_worlds_are_as_full(rules):
    full = [
        float((worlds(rules, "shapes", sizes=[(side, side)]).ids != 0).float().mean()) for side in (64, 256)
    ]
    assert full[1] == pytest.approx(full[0], abs=0.1)
    assert 0.1 < full[1] < 0.5


def test_rules_without_fields_have_worlds_too():
    assert worlds(powderdsl.load("life"), "gusts").ids.any()


# The order


def test_rounds_are_interleaved():
    """A fake clock that only work moves: each sample is charged with its own work and nothing else."""
    now, done = 0.0, []

    def work(name, seconds):
        def run(watch):
            nonlocal now
            done.append(name)
            now += 1000
            for _ in range(2):
                with watch:
                    now += seconds / 2

        return run

    works = [work("a", 1), work("b", 10), work("c", 100)]
    samples = list(interleaved(works, 2, clock=lambda: now, processor=lambda: 2 * now))
    assert "".join(done) == "abcabc"
    assert samples == [(number, index, 10**index, 2 * 10**index) for number in range(2) for index in range(3)]


def test_all_cells_are_ready_before_the_first_round_and_costs_come_last(rules, torch):
    plan = make_plan(rules, backends=["torch", "wasm"], profile=True, **TINY)
    kinds = [kind for kind, _ in measuring(plan, [])]
    assert kinds == ["compile"] * 4 + ["measure"] * 8 + ["profile"] * 4


def test_torch_has_its_threads_back(rules, torch):
    before = torch.get_num_threads()
    parts = measuring(make_plan(rules, backends=["torch"], threads=[before + 1], **TINY), [])
    next(kind for kind, _ in parts if kind == "measure")
    assert torch.get_num_threads() == before + 1
    parts.close()
    assert torch.get_num_threads() == before


# What comes out


@pytest.fixture(scope="module")
def report(rules):
    plan = make_plan(rules, backends=["reference", "wasm"], elements=[2, 4], profile=True, **TINY)
    return measure(plan)


def test_the_report_is_plain_data(report, rules):
    data = json.loads(json.dumps(report_data(report)))
    held = sum(np.dtype(slot.dtype).itemsize * slot.planes for slot in slots(rules))
    assert data["format"] == "powderdsl bench"
    assert data["rules"] == rules.name
    assert data["machine"]["torch"]
    assert data["machine"]["cpus"] >= 1
    assert not data["interrupted"]
    assert len(data["cells"]) == 8
    for cell in data["cells"]:
        assert (cell["rows"], cell["columns"], cell["threads"]) == (6, 8, 1)
        assert len(cell["round_seconds"]) == len(cell["round_processor_seconds"]) == data["rounds"] == 2
        made = cell["batch"] * cell["steps_per_call"] * cell["calls_per_round"]
        rate = cell["world_steps_per_second"]
        assert rate["min"] == pytest.approx(made / max(cell["round_seconds"]))
        assert rate["min"] <= rate["median"] <= rate["max"]
        for name, factor in (("microseconds_per_world_step", 1e6), ("nanoseconds_per_cell_step", 1e9 / 48)):
            assert cell[name]["max"] == pytest.approx(factor / rate["min"])
        assert cell["cell_updates_per_second"]["max"] == pytest.approx(48 * rate["max"])
        assert cell["state_bytes_per_cell"] == held
        assert sum(one["share"] for one in cell["passes"]) == pytest.approx(1)


def test_the_table_has_a_line_a_cell(report):
    text = report_text(report)
    table = next(part for part in text.split("\n\n") if part.startswith("backend"))
    assert len(table.splitlines()) == 1 + 8
    assert "elements" in table.splitlines()[0]
    assert "threads" not in table.splitlines()[0]  # only one number of them was asked for
    assert report.machine.processor in text


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.01234, "0.0123"), (12.34, "12.3"), (1234.5, "1,234"), (12.34e6, "12.3M"), (5e9, "5G")],
)
def test_numbers_have_three_figures(value, shown):
    assert number(value) == shown


MACHINE = Machine("Linux", "some processor", 4, "cpu", "3", "2", "none", "0", load=0.1)


def test_a_busy_machine_is_warned_of(rules):
    plan = make_plan(rules)
    assert "warning" not in report_text(make_report(plan, MACHINE, []))
    busy = Machine(**{**vars(MACHINE), "load": 3.5})
    assert "warning: others are at work" in report_text(make_report(plan, busy, []))


def test_half_a_measurement_is_reported(rules):
    plan = make_plan(rules, rounds=3)
    memory = Memory(None, "not here")
    first, second = (CellFigures(cell, 1.0, 1.0, memory, 100, 2, 5) for cell in plan.cells)
    first.seconds, first.processor_seconds = [2.0], [1.0]
    report = make_report(plan, MACHINE, [first, second], interrupted=True)
    assert report.cells == (first,)
    assert report.cells[0].rate.median == 5.0
    assert report.cells[0].processors == 0.5
    text = report_text(report)
    assert "interrupted: 1 of 3 rounds" in text
    assert "memory: not here" in text


def test_peak_memory_sees_what_was_freed():
    size = 1 << 25

    def work():
        np.ones(size, dtype=np.uint8)

    found = peak_growth(work, "cpu")
    assert found.growth is None or found.growth > 0.9 * size or "so far" in found.how


# What passes cost


@pytest.mark.parametrize("backend", ["reference", "torch", "native", "wasm"])
def test_every_backend_profiles_every_pass(backend, tmp_path, torch):
    rules = powderdsl.load("core+sand")  # little to compile
    with building(Building("-O0", tmp_path)):
        sim = powderdsl.compile(rules, backend)
        world = start_worlds(sim, make_plan(rules, **TINY).cells[1], "noise", 0)
        seconds = sim.profile(world, 3)
    assert tuple(seconds) == sim.passes
    assert all(value > 0 for value in seconds.values())


def test_profiling_runs_what_running_runs(rules, torch):
    """The watched program is the program: the same worlds come out of it."""
    sim = powderdsl.compile(rules, "torch")
    world = start_worlds(sim, make_plan(rules, **TINY).cells[1], "gusts", 0)
    seen = []
    program = sim._program
    job_seen = []
    original = program.run
    program.run = lambda job: job_seen.append(original(job)) or job_seen[-1]
    sim.profile(world, 2)
    seen.append(sim.step(world, 2).ids)
    assert len(job_seen) == 2
    assert (job_seen[0]["element"] == seen[0]).all()
