"""`check` prints the same under every hash seed: its output does not depend on the order of sets."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.semantics.test_differential import compositions

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.yaml"))

SEEDS = range(10)
"""Hash seeds; `make test` takes the first of them."""


def checks(rules: Sequence[str], folder: Path, seeds: range, *options: str) -> list[tuple[int, str]]:
    """What `powderdsl check` prints, with its exit code, under hash seeds; equal ones once."""
    command = [sys.executable, "-m", "powderdsl", "check", "--notes", *options, *rules]
    found = []
    for seed in seeds:
        environment = {**os.environ, "PYTHONHASHSEED": str(seed), "OMP_NUM_THREADS": "1"}
        run = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
        )
        assert run.returncode in (0, 2), run.stderr
        found.append((run.returncode, run.stdout + run.stderr))
    return list(dict.fromkeys(found))


GAIN = """\
pack: gain
needs: [core]
fields:
  heat: {type: 0..250, at: place}
  gain: {type: -63..63, at: place}
passes:
  warm:
    for side in sides, k in 1..12:
      - gain += 1 where side.heat - heat >= 4 * k
"""
"""Accepted or rejected by luck, when the search for a world in which a rule fires chose its variables from a set."""

FIELDS = "".join(f"  f{number}: {{type: 0..9, at: place}}\n" for number in range(8))
CLASHES = f"""\
pack: clashes
needs: [core, nothing, more]
tags: {{soft: a, hard: b, wet: c}}
fields:
{FIELDS}elements:
  jelly: {{id: 20, density: 5, color: "#FF00FF", tags: [soft, wet, powder?, nonsense], burns: 3, hue: 4}}
  brick: {{id: 21, density: 5, color: "#00FF00", tags: [hard]}}
passes:
  clash:
    do:
      - jelly -> brick if f0 + f1 > f2 + f3 and count(soft) > count(hard)
      - jelly -> wall if f4 + f5 > f6 + f7 and above is (hard, wet)
      - (soft, hard) swaps right if f1 > f2 and right.f3 < f4
      - f5 := 1 where f6 + right.f7 > f0
      - f5 := 2 where f6 < f1 + f2
"""
"""Many mistakes in names at once."""

WORDS = """\
pack: words
passes:
  words:
    do: empty -> wall if count(wall) == 3 or above is
"""

MEETINGS = CLASHES.replace(", nothing, more", "").replace(", nonsense", "").replace(", burns: 3, hue: 4", "")
"""The same without them: its conflicts are found, each on many variables, with an example."""


def test_check_prints_the_same_under_all_hash_seeds(tmp_path: Path) -> None:
    names = []
    nameless = CLASHES.replace(", nothing, more", "")  # where needed packs lack, nothing else is reported
    files = {"gain": GAIN, "clashes": CLASHES, "names": nameless, "words": WORDS, "meetings": MEETINGS}
    for name, text in files.items():
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
        names.append(f"core+{name}.yaml")
    printed = checks([*names, "powderworld-x-y-z-core"], tmp_path, SEEDS[:4], "--quick", "--ledger")
    assert len(printed) == 1
    _, text = printed[0]
    assert "PD508" not in text
    assert all(code in text for code in ("PD201", "PD301", "PD304", "PD305", "PD501", "PD502"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "rules", [*compositions(), *(f"powderworld+{path.relative_to(ROOT)}" for path in EXAMPLES)]
)
def test_every_composition_prints_the_same_under_all_hash_seeds(rules: str) -> None:
    assert len(checks([rules], ROOT, SEEDS, "--ledger", "--cost")) == 1
