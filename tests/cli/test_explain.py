"""`powderdsl explain`."""

from __future__ import annotations

import pytest

from powderdsl.diagnostics import CODES
from tests.cli.commands import powderdsl


def test_without_a_code_all_are_listed():
    result = powderdsl("explain", exits=0)
    assert [line.split()[0] for line in result.stdout.splitlines()] == list(CODES)


@pytest.mark.parametrize("word", ["PD301", "pd301", "301", "unknown-name", "Unknown_Name", "[PD301]"])
def test_codes_and_slugs_are_accepted(word):
    result = powderdsl("explain", word, exits=0)
    assert "PD301" in result.stdout
    assert "\x1b" not in result.stdout


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        *(
            ("unknown-nam", "unknown-name"),
            ("PD399", "PD301"),
            ("pass-cicle", "pass-cycle"),
            ("PD3", "PD301"),
        ),
        *((word, "error: no code") for word in ("", "zzzzzzzz", "PD", "\N{SNOWMAN}")),
    ],
)
def test_unknown_codes_get_a_suggestion(word, meant):
    result = powderdsl("explain", word, exits=2)
    assert meant in result.stderr
    assert result.stdout == ""
