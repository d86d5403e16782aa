"""Settings: what a field says of itself is what checks, and options of commands, go by."""

from __future__ import annotations

from dataclasses import dataclass

import click
import pytest
from click.testing import CliRunner

from powderdsl.cli.options import settings_of
from powderdsl.system.settings import check_settings, setting


@dataclass(frozen=True)
class Config:
    rounds: int = setting(3, "How often.", 1, 9)
    decay: float = setting(0.5, "Of weights.", 0.0, 1.0)
    most_cells: int = setting(4, low=2)
    kind: str = setting("plain", "Which.", choices=("plain", "other"))


@pytest.mark.parametrize("wrong", [0, 10, 2.0, True, "3", None, float("nan"), 10**400])
def test_numbers_out_of_bounds(wrong: object) -> None:
    with pytest.raises(ValueError, match="must be") as caught:
        check_settings(Config(rounds=wrong))  # type: ignore[arg-type]
    assert str(caught.value) == f"`rounds` must be an integer from 1 to 9, found {wrong!r:.80}"


@pytest.mark.parametrize("wrong", [-0.1, float("nan"), float("inf"), False, "1", 10**400])
def test_reals_out_of_bounds(wrong: object) -> None:
    with pytest.raises(ValueError, match="must be") as caught:
        check_settings(Config(decay=wrong))  # type: ignore[arg-type]
    assert str(caught.value) == f"`decay` must be a number from 0 to 1, found {wrong!r:.80}"


def test_all_mistakes_are_said_at_once() -> None:
    check_settings(Config(9, 1, 10**30))
    with pytest.raises(
        ValueError, match=r"`rounds` must be .*; `most_cells` must be an integer from 2, found 1$"
    ):
        check_settings(Config(0, 1.0, 1))


def test_options_follow_from_settings() -> None:
    @click.command()
    @settings_of(Config)
    def command(**given: object) -> None:
        click.echo(sorted(given.items()))

    assert "--most-cells" not in CliRunner().invoke(command, ["--help"]).output
    told = CliRunner().invoke(command, ["--rounds", "2e1", "--kind", "other"]).output
    assert told == "[('decay', None), ('kind', 'other'), ('rounds', 20)]\n"
    assert CliRunner().invoke(command, ["--kind", "third"]).exit_code == 2
