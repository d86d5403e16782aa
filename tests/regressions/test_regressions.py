"""Cases that a backend once got wrong, as `python -m tests.fuzz` saved them: all backends run them forever."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from powderdsl.targets.cpp.build import Building
from tests.compilers import skip_without_compiler
from tests.fuzz import COMPARED, COMPILED
from tests.fuzz.cases import read_case
from tests.fuzz.differential import check_case
from tests.tiers import tiered

FOLDER = Path(__file__).parent
LONG = ("a-float-squared-many-times", "choices-that-many-choices-need", "more-planes-than-parameters")
CASES = [(path.stem, backend) for path in sorted(FOLDER.glob("*.yaml")) for backend in COMPARED]
QUICK = [(name, backend) for name, backend in CASES if name not in LONG and backend not in COMPILED]


@pytest.mark.parametrize("case", tiered(CASES, QUICK), ids="-".join)
def test_backends_agree(case: tuple[str, str], tmp_path: Path) -> None:
    name, backend = case
    skip_without_compiler(backend)
    path = FOLDER / f"{name}.yaml"
    found = check_case(replace(read_case(path), backend=backend), Building("-O0", tmp_path))
    assert found is None, f"{found}\npython -m tests.fuzz --replay {path.relative_to(FOLDER.parents[1])}"
