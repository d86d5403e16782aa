"""Cases as files: what is written is read again, bit for bit; what is not a case is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.cases import Case, read_case, write_case
from tests.fuzz.compare import find_difference
from tests.fuzz.differential import seeded_starts
from tests.fuzz.rulemaker import random_ruleset_text
from tests.semantics.texts import load_text


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
