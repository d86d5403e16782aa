"""What a command prints depends on its input alone: not on the order of sets, of folders, or of an earlier run."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from powderdsl.diagnostics import Reporter, Source
from powderdsl.model.declarations import PackDecl
from powderdsl.model.packs import read_file
from tests.set_iteration import all_faults

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "powderdsl"

SEEDS = range(10)

ORDER_DOES_NOT_MATTER = {
    "testing.mutation.equivalence": "sorts by the whole of what it sorts",
    "experiments.studies.run": "stops all processes that run, and none of them reads the others",
}
"""Modules that go through sets, and why nothing comes of it."""


# --- the code


@pytest.fixture(scope="module")
def faults() -> list[str]:
    sources = {
        ".".join(path.relative_to(root).with_suffix("").parts): path.read_text(encoding="utf-8")
        for root, folder in ((PACKAGE, PACKAGE), (ROOT, ROOT / "tests" / "fuzz"))
        for path in sorted(folder.rglob("*.py"))
    }
    assert "model.logic.satisfy" in sources
    return list(all_faults(sources))


def test_no_result_depends_on_the_order_of_a_set(faults: list[str]) -> None:
    found = [fault for fault in faults if fault.partition(":")[0] not in ORDER_DOES_NOT_MATTER]
    assert not found, "\n".join(["", *found, "", "use `sorted`, a tuple, or a dict as an ordered set"])


def test_exceptions_are_needed(faults: list[str]) -> None:
    assert {fault.partition(":")[0] for fault in faults} >= ORDER_DOES_NOT_MATTER.keys()


HEAD = """\
from dataclasses import dataclass
Ids = frozenset[int]
@dataclass
class Facts:
    ids: Ids
    order: list[int]
def ids_of(x) -> Ids: ...
def both(a: Ids, b: "set[str] | None", c: dict[str, int], facts: Facts) -> None:
    d = a | b
    e = set(c)
"""


@pytest.mark.parametrize(
    "line",
    [
        "for one in a: print(one)",
        "x = [one for one in d]",
        "x = {one: 1 for one in e}",
        "x = list(ids_of(3))",
        "x = ', '.join(b)",
        "x = next(iter(a - e))",
        "x = sorted(a, key=len)",
        "x = min(facts.ids, key=abs)",
        "x = (*facts.ids, 1)",
        "x = a.pop()",
        "x = f'{d}'",
        "x, y = a",
        "yield from a",
        "for one in c.keys() - a: print(one)",
        "x = list(a.union(e))",
        "x = [path for path in folder.iterdir()]",
        "x = sorted(range(3), key={**dict.fromkeys(a)}.get)",
    ],
)
def test_loose_order_is_found(line: str) -> None:
    assert len(list(all_faults({"m": f"{HEAD}    {line}\n"}))) == 1


@pytest.mark.parametrize(
    "line",
    [
        "for one in sorted(a): print(one)",
        "x = sorted(one for one in a)",
        "x = {one for one in a} | {*a, 3}",
        "x = any(one > 3 for one in a) and sum([*a])",
        "x = len(a) + max(a)",
        "for one in c: print(one)",
        "x = [one for one in facts.order]",
        "x = sorted(folder.glob('*'))",
        "x = 3 in a and a <= d",
        "x = f'{sorted(a)}'",
    ],
)
def test_settled_order_is_not(line: str) -> None:
    assert list(all_faults({"m": f"{HEAD}    {line}\n"})) == []


# --- the command


def checks(rules: Sequence[str], folder: Path, *options: str) -> list[tuple[int, str]]:
    """What `powderdsl check` prints, with its exit code, under ten hash seeds; equal ones once."""
    command = [sys.executable, "-m", "powderdsl", "check", "--notes", *options, *rules]
    found = []
    for seed in SEEDS:
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
    printed = checks([*names, "powderworld-x-y-z-core"], tmp_path, "--quick", "--ledger")
    assert len(printed) == 1
    _, text = printed[0]
    assert "PD508" not in text
    assert all(code in text for code in ("PD201", "PD301", "PD304", "PD305", "PD501", "PD502"))


def compositions() -> list[str]:
    """Every shipped ruleset, every shipped pack and example with what it needs, and `powderworld` with each example."""
    files = [*sorted((ROOT / "rules").glob("*.yaml")), *sorted((ROOT / "docs" / "examples").glob("*.yaml"))]
    found = {
        path: read_file(Source(path.name, path.read_text(encoding="utf-8")), Reporter()) for path in files
    }
    needs = {
        path.stem: [word.text for word in decl.needs] if isinstance(decl, PackDecl) else []
        for path, decl in found.items()
    }

    provides = {
        path.stem: [word.text for word in decl.provides] if isinstance(decl, PackDecl) else []
        for path, decl in found.items()
    }

    def before(name: str) -> list[str]:
        first = dict.fromkeys(one for need in needs[name] for one in (*before(need), need))
        provided = [other for one in first for other in provides[one]]
        return [one for one in first if one not in provided]

    rules = []
    for path in files:
        shipped = path.parent.name == "rules"
        word = path.stem if shipped else str(path.relative_to(ROOT))
        rules.append("+".join([*before(path.stem), word]))
        if not shipped:
            rules.append(f"powderworld+{word}")
    return rules


def test_compositions_are_all_there() -> None:
    found = compositions()
    assert {
        "powderworld",
        "life",
        "core+water+docs/examples/salt.yaml",
        "powderworld+docs/examples/salt.yaml",
    } <= {*found}
    assert len(found) >= 27


@pytest.mark.campaign
@pytest.mark.parametrize("rules", compositions())
def test_every_composition_prints_the_same_under_all_hash_seeds(rules: str) -> None:
    assert len(checks([rules], ROOT, "--ledger", "--cost")) == 1
