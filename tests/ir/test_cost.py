"""What passes cost: counted by hand for small rules, golden for a shipped ruleset, with the reason where planes give up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from powderdsl.analysis.costs import PassCost, costs
from powderdsl.compiler import lower
from powderdsl.ir import bits
from tests.cli.commands import powderdsl
from tests.semantics.texts import load_text

PACK = """\
pack: small
elements:
  air: {id: 0, color: "#102030"}
  dust: {id: 1, color: "#FEDCBA"}
fields:
  heat: {type: real(0..9), at: place}
passes:
  fade:
    do: dust -> air if above is dust with chance 25%
  fall:
    after: fade
    do: dust swaps below if below is air
  warm:
    after: fall
    do: heat := heat * heat where dust
"""


def by_name(text: str) -> dict[str, PassCost]:
    return {one.name: one for one in costs(lower(load_text(text, "small.yaml")))}


def test_counted_by_hand() -> None:
    """An element of two is one plane. 25 % of 2^32 draws are decided by two bits; settled floats are compared once more."""
    found = by_name(PACK)
    fade, fall, warm = (found[name] for name in ("fade", "fall", "warm"))
    # dust and above and below a quarter: they change, which leaves dust and not that
    assert (fade.substeps, fade.shifts, fade.moves, fade.random_bits, fade.float_operations) == (
        1,
        1,
        0,
        2,
        0,
    )
    assert 3 <= fade.gates <= 5
    # dust, and below is none
    assert (fall.gates, fall.shifts, fall.moves, fall.neighbors) == (2, 1, 1, 1)
    # the product, the choice, the bounds
    assert (warm.gates, warm.shifts, warm.float_operations, warm.neighbors) == (0, 0, 3, 0)
    assert sum(one.share for one in found.values()) == pytest.approx(1)
    assert {one.form for one in found.values()} == {"planes"}


@pytest.mark.golden
def test_golden_cost(golden) -> None:  # type: ignore[no-untyped-def]
    result = powderdsl("check", "powderworld", "--cost", "--quick", exits=0)
    golden(Path(__file__).parent / "golden" / "powderworld.cost.txt", result.stdout)


def test_json_has_the_same_numbers(folder: Path) -> None:
    (folder / "small.yaml").write_text(PACK)
    (folder / "bad.yaml").write_text(PACK.replace("above is", "above i"))
    data = json.loads(powderdsl("check", "small.yaml", "bad.yaml", "--cost", "--json", exits=2).stdout)
    assert [one["code"] for one in data["diagnostics"]]
    assert list(data["cost"]) == ["small.yaml"]
    assert {one["name"]: PassCost(**one) for one in data["cost"]["small.yaml"]} == by_name(PACK)


def test_passes_on_cells_say_why(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bits, "MAX_GATES", 15)
    (folder / "small.yaml").write_text(
        PACK.replace("dust swaps", "dust swaps left if left is air and count(dust) > 3\n    then: dust swaps")
    )
    result = powderdsl("check", "small.yaml", "--cost", exits=0)
    (line,) = (one for one in result.stdout.splitlines() if "not on planes" in one)
    assert line.startswith("fall: ")
    assert line.endswith("operations on cells, not on planes: more than 15 gates (small.yaml:12)")
