"""The VS Code extension: its colors, and how it starts the server."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from powderdsl.model.operations import FUNCTIONS
from powderdsl.syntax.parse import reserved_words
from tests.cli.commands import PACK

EXTENSION = Path(__file__).resolve().parents[2] / "editors" / "vscode"


def test_the_grammar_has_all_words_of_the_language() -> None:
    grammar = (EXTENSION / "syntaxes" / "powderdsl.tmLanguage.json").read_text()
    assert {*reserved_words(), *FUNCTIONS} <= set(re.findall(r"\w+", grammar.replace("\\b", " ")))


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Any:
    if shutil.which("node") is None or not (EXTENSION / "node_modules").is_dir():
        pytest.skip("needs Node.js, and `make vscode`")
    pack = tmp_path_factory.mktemp("vscode") / "grit.yaml"
    text = PACK + "tests:\n  - it stays:\n      given: |\n        if g .\n      after: 2 steps  # if\n"
    pack.write_text(text)
    words = ["node", EXTENSION / "test.mjs", pack, "/bin/powderdsl"]
    return json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


def test_words_have_colors(seen: Any) -> None:
    scopes = seen["scopes"]
    for text, scope in {
        "pack": "entity.name.tag",
        "if": "keyword.control",
        "->": "keyword.operator",
        "count": "support.function",
        "20%": "constant.numeric",
        '"#123456"': "string.quoted.double",
        "vanish": "variable.other",
        "if g .": "string.unquoted.block",
        "# if": "comment.line.number-sign",
    }.items():
        assert scope in scopes[text], (text, scopes[text])


def test_the_client_starts_the_server_for_our_files_alone(seen: Any) -> None:
    assert seen["started"] == [
        [{"command": "/bin/powderdsl", "args": ["lsp", "--with", "powderworld"]}, {"documentSelector": [{"language": "powderdsl"}]}],
        ["pack: x\n", "powderdsl"],
        "started",
        "stopped",
    ]  # fmt: skip
    assert seen["bundle"] in (0, None) or not (EXTENSION / "dist").is_dir()
