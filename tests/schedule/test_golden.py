"""What the planner makes of all shipped rules, as golden text: a change of plan is read before it is merged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from powderdsl.cli.dispatch import main

GOLDEN = Path(__file__).parent / "golden"
LONG = {"powderworld2"}
"""Plans as long as all others together, which nobody would read."""
RULES = (
    *(
        "powderworld",
        "life",
        "brians_brain",
        "cyclic",
        "margolus",
        "wireworld",
        "langtons_ant",
        "forest_fire",
    ),
    *("core+docs/examples/beetle.yaml", "core+water+fire+lava+docs/examples/steam.yaml"),
)
EMITTED = {
    "planes": ("--emit", "planes"),
    "native": ("--emit", "schedule", "--backend", "native"),
    "cuda": ("--emit", "schedule", "--backend", "cuda"),
}


@pytest.mark.golden
@pytest.mark.parametrize("kind", EMITTED)
@pytest.mark.parametrize("rules", RULES)
def test_golden(rules: str, kind: str, golden: Callable[[Path, str], None]) -> None:
    result = CliRunner().invoke(main, ["compile", rules, *EMITTED[kind]])
    assert result.exit_code == 0, result.output
    name = rules.rpartition("/")[2].removesuffix(".yaml")
    golden(GOLDEN / f"{name}.{kind}.txt", result.stdout)


def test_every_shipped_ruleset_is_there() -> None:
    texts = {path.stem: f"\n{path.read_text()}" for path in Path("rules").glob("*.yaml")}
    shipped = {name for name, text in texts.items() if "\nruleset:" in text and "\nextends:" not in text}
    assert shipped - LONG <= set(RULES)
