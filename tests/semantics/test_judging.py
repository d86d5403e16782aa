"""What notices a mutant, and that the number of processes has no part in it."""

from __future__ import annotations

from multiprocessing import active_children

import pytest

from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import load_text
from powderdsl.testing.mutation.judging import Original, broken_invariant, run_campaign

ROCK = """\
pack: rocks
elements:
  soil: {id: 0, color: "#101010"}
  rock: {id: 1, color: "#202020", weight: 3, tags: hard}
  seed: {id: 2, color: "#303030"}
tags: {hard: stays whole}
properties: {weight: 0..7}
passes:
  harden:
    do: soil -> rock if left is seed
invariants:
  - never (rock and weight < 2)
  - never (rock and not hard)
"""


@pytest.mark.parametrize(
    ("right", "wrong", "claim"),
    [
        ("weight: 3", "weight: 1", "never (rock and weight < 2)"),
        (", tags: hard", "", "never (rock and not hard)"),
    ],
)
def test_invariants_about_properties_and_tags_are_asked_where_no_world_differs(tmp_path, right, wrong, claim):
    path = tmp_path / "rocks.yaml"
    path.write_text(ROCK)
    mutant = load_text(ROCK.replace(right, wrong))
    broken, _ = broken_invariant(Original.of(str(path)), compile(mutant, backend="wasm"))
    assert broken is not None
    assert broken.span.text == claim


def test_several_processes_change_no_outcome():
    numbers = [0, 7, 14, 21, 28]
    alone = dict(run_campaign("wireworld", (), numbers, jobs=1, seed=0))
    together = dict(run_campaign("wireworld", (), numbers, jobs=2, seed=0))
    assert together == alone
    assert {verdict.status for verdict in alone.values()} - {"survived"}


def test_a_process_that_is_killed_is_an_error():
    campaign = run_campaign("wireworld", (), list(range(40)), jobs=2, seed=0)
    next(campaign)
    for process in active_children():
        process.kill()
    with pytest.raises(OSError, match="was killed"):
        list(campaign)
    assert active_children() == []
