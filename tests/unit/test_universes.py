"""Universes: the same text from the same seed, checked rules without remarks, and the laws of roles that tasks count on."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from hashlib import sha256
from itertools import product
from pathlib import Path

import pytest

import powderdsl
from powderdsl.analysis.ledger import ledger
from powderdsl.analysis.proofs import prove
from powderdsl.compiler import load_with_diagnostics, shipped_words
from powderdsl.model.types import Ruleset
from powderdsl.tasks.shipped import load_task
from powderdsl.universes import MAX_SEED, universe_text
from powderdsl.universes.invent import Draws, pieces
from tests.refusals import refusal

ROLES = (
    "grain_a", "grain_b", "pool", "cargo", "crust", "reagent_a", "reagent_b", "reagent_c", "wild_a", "wild_b", "wild_c",
    "fume",
)  # fmt: skip
"""The tags of one element each, in the order of ids, which begin with 2."""
GOLDEN = {0: "241f384f1a878fcf", 7: "41cbb75b8f633bdf", MAX_SEED: "6c76708ad0f9b622"}
"""Hashes of texts. They change with `rules/universes/laws.yaml`: whatever has been measured on universes is void then."""
WALL, GRAINS, POOL, CARGO, CRUST, REAGENTS = 1, (2, 3), 4, 5, 6, (7, 8, 9)
SEEDS = [pytest.param(seed, marks=pytest.mark.slow if seed > 2 else ()) for seed in (*range(39), MAX_SEED)]


def digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()[:16]


@pytest.mark.golden
def test_the_text_of_a_seed_is_the_same_everywhere() -> None:
    assert {seed: digest(universe_text(seed)) for seed in GOLDEN} == GOLDEN


def test_hashes_of_this_process_do_not_matter() -> None:
    program = "from powderdsl.universes import universe_text as t; print(hash('') * 0, [*map(t, range(40))])"
    texts = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
        ).stdout
        for seed in "12"
    }
    assert len(texts) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_universe_is_free_of_remarks_and_its_claims_are_proven(seed: int) -> None:
    rules, remarks = load_with_diagnostics(f"universe:{seed}")
    assert remarks == ()
    assert rules.packs[-1] == f"universe_{seed}"
    for number, role in enumerate(ROLES, 2):
        assert [element.id for element in rules.elements if role in element.tags] == [number]
    known = ledger(rules, needs=False)
    own = [claim for claim in rules.invariants if claim.pack == f"universe_{seed}"]
    assert len(own) > 6
    for claim in own:
        assert prove(claim.claim, rules, known, frozenset()) is not None, claim.span.text


@pytest.mark.parametrize("seed", SEEDS[:20])
def test_one_grain_floats_and_one_reagent_dissolves(seed: int) -> None:
    rules = powderdsl.load(f"universe:{seed}")
    defaults = {param.name.partition(".")[2]: param.default for param in rules.params}
    (sunk,) = sinking(rules)
    assert [defaults[f"grain_{letter}_floats"] < 0 for letter in "ab"] == [sunk == grain for grain in GRAINS]
    (solvent,) = dissolving(rules)
    assert [defaults[f"reagent_{letter}_dissolves"] > 0 for letter in "abc"] == [
        solvent == one for one in REAGENTS
    ]
    assert defaults["wind"] in (-1, 1)


def sinking(rules: Ruleset) -> list[int]:
    """The grains that have sunk in the pool after some steps."""
    columns = [
        [column for grain in GRAINS for column in (row[grain == 3], WALL)] for row in ([2, 3], [POOL, POOL])
    ]
    sim = powderdsl.compile(rules, backend="reference")
    world = sim.step(sim.world([[WALL] * 4, *columns, [WALL] * 4]), 12)
    return [grain for grain in GRAINS if grain in world.ids[0][2].tolist()]


def dissolving(rules: Ruleset) -> list[int]:
    """The reagents beside which the crust is gone after some steps."""
    columns = [
        [column for reagent in REAGENTS for column in (cell or reagent, WALL)] for cell in (0, 0, CRUST)
    ]
    sim = powderdsl.compile(rules, backend="reference")
    world = sim.step(sim.world([[WALL] * 6, *columns, [WALL] * 6], seed=5), 60)
    ids = world.ids[0]
    return [reagent for place, reagent in enumerate(REAGENTS) if CRUST not in ids[:, 2 * place].tolist()]


@pytest.mark.parametrize(
    "word", ["-1", "abc", "", "99999999999999", str(MAX_SEED + 1), "1.5", "٣", "7 ", "0x7"]
)
def test_universes_that_there_are_not(word: str) -> None:
    (error,) = refusal(powderdsl.load, f"core+universe:{word}")
    assert error.code == "PD304"
    assert error.message == f"no universe `{word}`"
    assert "universe:7" in error.helps[0]


def test_bad_seeds_are_refused() -> None:
    for seed in (-1, MAX_SEED + 1):
        with pytest.raises(ValueError, match="from 0 to 4,294,967,295"):
            universe_text(seed)


def test_universes_are_named_like_packs() -> None:
    assert powderdsl.load("wind+universe:7").packs == ("core", "wind", "universe_7")
    assert powderdsl.load("universe:07").packs == ("core", "universe_7")
    (error,) = refusal(powderdsl.load, "universe:7-acid")
    assert error.message == "`acid` is left out, but no pack loads it"


def test_files_name_universes(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "ruleset: mine\npacks: [core, universe:7]\nparams: {universe_7.wind: 0}\n", encoding="utf-8"
    )
    rules = powderdsl.load(path)
    assert rules.packs == ("core", "universe_7")
    assert [param.default for param in rules.params if param.name == "universe_7.wind"] == [0]
    path.write_text("ruleset: mine\npacks: [core, universe:x]\n", encoding="utf-8")
    (error,) = refusal(powderdsl.load, path)
    assert (error.code, error.primary.span and error.primary.span.text) == ("PD304", "universe:x")


def test_tasks_name_universes_and_roles(tmp_path: Path) -> None:
    path = tmp_path / "melt.yaml"
    path.write_text(TASK, encoding="utf-8")
    task = load_task(str(path))
    assert task.agent.choices[:3] == REAGENTS
    path.write_text(TASK.replace("universe:7", "universe:-7"), encoding="utf-8")
    assert "universe:7" in refusal(load_task, str(path))[0].helps[0]
    path.write_text(TASK + "rulesets: [universe:0..1, universe:-7]\n", encoding="utf-8")
    (error,) = refusal(load_task, str(path))
    assert error.primary.span
    assert error.primary.span.text == "universe:-7"


TASK = """
task: melt
rules: universe:7
size: [16, 16]
fill: empty
generate:
  - box crust rows 8:12 columns 4:12
  - frame wall
agent: {may: [reagent_a, reagent_b, reagent_c, nothing], brush: 2, actions: 4}
reward: {each: -change(count(crust))}
end: {success: count(crust) == 0}
"""


def test_needs_of_a_universe_are_shipped_packs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "core.yaml").write_text("pack: core\n")
    monkeypatch.chdir(tmp_path)
    assert powderdsl.load("universe:7").element("wall") is not None


def test_names_are_no_words_of_the_language_or_of_shipped_packs() -> None:
    starts, *rest = pieces()["names"]
    names = {"".join(parts) for parts in product(starts, *rest)}
    assert len(names) > 10_000
    assert not names & shipped_words().keys()
    assert all(len(set(start)) == 1 for start in starts)


def test_colors_are_told_apart() -> None:
    colors = [*pieces()["colors"], "#ECF0F1", "#6C7A89"]
    parts = [[int(color[at : at + 2], 16) for at in (1, 3, 5)] for color in colors]
    for place, one in enumerate(parts):
        for other in parts[:place]:
            assert sum((a - b) ** 2 for a, b in zip(one, other, strict=True)) > 45**2, (one, other)


def test_draws_depend_on_seed_and_count() -> None:
    drawn = [Draws(seed).below(1 << 32) for seed in range(1000)]
    assert len(set(drawn)) > 990
    draws = Draws(3)
    assert sorted({draws.below(6) for _ in range(200)}) == [*range(6)]
    assert draws.within("2..pool-1", {"pool": 3}) == 2
    assert re.fullmatch("[abc]{3}", "".join(draws.shuffled("abc")))
