"""The clock of worlds: it counts to a last step, and no file or call takes it further."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import powderdsl
from powderdsl.simulation.simulator import LAST_STEP
from tests.cli.commands import powderdsl as command
from tests.fuzz import TARGETS
from tests.refusals import refusal

STEPS = (5, LAST_STEP - 2)


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two worlds, the second of them two steps before the last one."""
    sim = powderdsl.compile("powderworld", "reference")
    ids = np.random.default_rng(1).integers(0, 5, (2, 8, 8))
    path = tmp_path_factory.mktemp("worlds") / "late.npz"
    powderdsl.save(sim.world(ids, seed=3).with_state(sim.world(ids).state, start=torch.tensor(STEPS)), path)
    return path


@pytest.mark.parametrize("backend", ["reference", *TARGETS])
def test_a_world_makes_its_last_step_and_no_further_one(backend: str, late: Path, tmp_path: Path) -> None:
    sim = powderdsl.compile("powderworld", backend)
    world = powderdsl.load_world(late, sim)
    assert world.step.tolist() == list(STEPS)
    with pytest.raises(ValueError, match="is beyond the last one, 9,223,372,036,854,775,807"):
        sim.step(world, 3)
    last = sim.step(sim.step(world), 1)
    powderdsl.save(last, tmp_path / "last.npz")
    again = powderdsl.load_world(tmp_path / "last.npz", sim)
    assert again.step.tolist() == [7, LAST_STEP]
    # Draws follow from the low 32 bits of the step.
    alone = sim.world(world.ids, seed=3).with_state(world.state, start=torch.tensor([5, 2**32 - 3]))
    assert torch.equal(again.ids, sim.step(alone, 2).ids)
    for refused in (lambda: sim.step(again), lambda: sim.profile(again)):
        with pytest.raises(ValueError, match="the last one"):
            refused()


def test_commands_refuse_further_steps_before_they_run(late: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.npz"
    for words in (("run", "--steps", 3, "--out", out), ("trace", "--step", 3, "--at", "1,1")):
        ended = command(words[0], "powderworld", "--world", late, *words[1:], exits=2)
        assert "error[PD602]" in ended.stderr
        assert "can make 2 more steps: the last one is" in ended.stderr
    assert not out.exists()
    command("run", "powderworld", "--world", late, "--steps", 2, "--out", out, exits=0)
    command("run", "powderworld", "--world", out, "--steps", 0, exits=0)


@pytest.mark.parametrize("step", [np.uint64(2**63), np.int64(-1)])
def test_a_file_with_another_step_is_refused(step: np.integer, late: Path, tmp_path: Path) -> None:
    with np.load(late) as data:
        np.savez(tmp_path / "w.npz", **{**data, "step": np.array([5, step], step.dtype)})
    sim = powderdsl.compile("powderworld", "reference")
    (error,) = refusal(powderdsl.load_world, tmp_path / "w.npz", sim)
    assert error.code == "PD602"
    assert "`step` does not lie in 0..9,223,372,036,854,775,807" in error.message
