"""Cases as files: what is written is read again, bit for bit; what is not a case is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from powderdsl.diagnostics import CompileError
from powderdsl.testing.generators.cases import load_text
from powderdsl.testing.generators.rulemaker import random_ruleset_text
from tests.fuzz.cases import Case, read_case, write_case
from tests.fuzz.compare import find_difference
from tests.fuzz.differential import seeded_starts


@pytest.mark.parametrize("seed", [10, 43, 65])
def test_a_case_survives_being_written(seed: int, tmp_path: Path) -> None:
    text = random_ruleset_text(seed)
    for number, start in enumerate(seeded_starts(load_text(text), seed, 3)):
        case = Case(text, start, number + 1, "wasm")
        write_case(tmp_path / "case.yaml", case, "differs: here\nand there")
        again = read_case(tmp_path / "case.yaml")
        assert (again.text, again.steps, again.backend) == (case.text, case.steps, case.backend)
        assert (again.start.seed.tolist(), again.start.step.tolist()) == (
            start.seed.tolist(),
            start.step.tolist(),
        )
        assert find_difference(start.params, again.start.params) is None
        assert np.array_equal(again.start.ids, start.ids)
        assert find_difference(start.fields, again.start.fields) is None


GOOD = """\
backend: torch
steps: 1
seed: 0
step: 0
worlds:
  - - 0 0
rules: |
  pack: p
  elements: {a: {id: 0, color: "#000000"}}
"""


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("steps: 1", "steps: many", "PD602"),
        ("seed: 0\n", "", "PD602"),
        ("- - 0 0", "- - 0 900", "PD602"),
        ("- - 0 0", "- - 0 0\n    - 0", "PD602"),
        ("backend: torch", "- torch", "PD101"),
        ("pack: p", "pack: [", "PD101"),
    ],
)
def test_what_is_no_case_is_refused(old: str, new: str, code: str, tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(GOOD, encoding="utf-8")
    assert read_case(path).backend == "torch"
    path.write_text(GOOD.replace(old, new), encoding="utf-8")
    with pytest.raises(CompileError) as found:
        read_case(path)
    assert found.value.diagnostics[0].code[:3] == code[:3]
