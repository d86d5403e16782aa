"""Files that GitHub, pre-commit and citation tools read: they parse, and agree with the project."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
# What the Citation File Format 1.2.0 requires, and which other keys this project uses.
CITATION_REQUIRED = {"cff-version", "message", "title", "authors"}
CITATION_KEYS = CITATION_REQUIRED | {"type", "version", "license", "abstract", "keywords", "references"}


def _read(path: str) -> Any:
    """A YAML file with all scalars as written: YAML 1.1 would read the key ``on`` of a workflow as true."""
    return yaml.load((ROOT / path).read_text(encoding="utf-8"), Loader=yaml.BaseLoader)


def _text(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def _names(people: list[dict[str, str]]) -> list[str]:
    return [one.get("name") or f"{one['given-names']} {one['family-names']}" for one in people]


def test_the_workflow_runs_all_checks_on_main_and_on_pull_requests() -> None:
    path = ROOT / ".github/workflows/checks.yml"
    workflow = _read(str(path.relative_to(ROOT)))
    assert set(workflow["on"]) == {"push", "pull_request"}
    assert workflow["on"]["push"] == {"branches": ["main"]}
    (job,) = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands[-1] == ".ci/run"
    assert os.access(ROOT / ".ci/run", os.X_OK)
    assert job["steps"][-1].keys() == {"name", "run"}, "no condition and no `continue-on-error`"


def test_pre_commit_runs_the_ruff_of_make_lint_and_checks_messages() -> None:
    config = _read(".pre-commit-config.yaml")
    (repo,) = config["repos"]
    assert repo["repo"] == "local", "a remote hook would have a version of its own"
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", _text("Makefile"), re.MULTILINE)
    assert lint
    of_make = re.findall(r"\$\(BIN\)/(ruff .+) \.$", lint[1], re.MULTILINE)
    hooks = [hook["entry"].replace(" --force-exclude", "") for hook in repo["hooks"] if "types_or" in hook]
    assert hooks == [f".venv/bin/{command}" for command in of_make]
    assert config["default_install_hook_types"] == ["pre-commit", "commit-msg"]
    assert config["default_stages"] == ["pre-commit"], "ruff does not read messages"
    (hook,) = (hook for hook in repo["hooks"] if "stages" in hook)
    assert hook["stages"] == ["commit-msg"]
    assert os.access(ROOT / hook["entry"], os.X_OK)


GOOD = ""
"""What `.ci/commit-msg` prints about a message that it accepts."""


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("ir: fold shifts of constants\n\nThe printers did this twice.\n", GOOD),
        ("analysis, system: process `PD301` once\n\nIt took two passes.\n", GOOD),
        ("docs/worlds: bring the table up to date\n\nA column was missing.\n", GOOD),
        ("web: " + "a" * 55 + "\n\nThe longest subject.\n", GOOD),
        (
            "ir: fold shifts\n# a comment of git's\n\nWhy.\n# ------------------------ >8 ------------------------\ndiff\n",
            GOOD,
        ),
        ("Merge branch 'main' into topic\n", GOOD),
        ('Revert "ir: fold shifts"\n\nThis reverts commit 0123456.\n', GOOD),
        ("fixup! ir: fold shifts\n", GOOD),
        ("", "The subject is not `area"),
        ("Fold shifts\n\nWhy.\n", "The subject is not `area"),
        ("ir: Fold shifts\n\nWhy.\n", "The subject is not `area"),
        ("IR: fold shifts\n\nWhy.\n", "The subject is not `area"),
        ("ir:fold shifts\n\nWhy.\n", "The subject is not `area"),
        ("ir: folded shifts\n\nWhy.\n", "`folded` is not an imperative"),
        ("ir: folding shifts\n\nWhy.\n", "`folding` is not an imperative"),
        ("ir: folds shifts\n\nWhy.\n", "`folds` is not an imperative"),
        ("ir: fold shifts.\n\nWhy.\n", "The subject ends with a period"),
        ("web: " + "a" * 56 + "\n\nWhy.\n", "The subject has 61 characters"),
        ("ir: fold shifts\n", "The subject is not followed by"),
        ("ir: fold shifts\nWhy.\n", "The subject is not followed by"),
        ("ir: fold shifts\n\n# Only a comment.\n", "The subject is not followed by"),
    ],
)
def test_commit_messages_are_checked(message: str, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "COMMIT_EDITMSG"
    path.write_text(message, encoding="utf-8")
    script = subprocess.run([sys.executable, ROOT / ".ci/commit-msg", path], capture_output=True, text=True)
    assert script.returncode == bool(script.stderr) == (fault != GOOD)
    assert fault in script.stderr


def test_the_citation_agrees_with_the_project() -> None:
    project = tomllib.loads(_text("pyproject.toml"))["project"]
    citation = _read("CITATION.cff")
    assert citation.keys() >= CITATION_REQUIRED
    assert citation.keys() <= CITATION_KEYS
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation["title"].partition(":")[0] == project["name"]
    for key in ("version", "license", "keywords"):
        assert citation[key] == project[key]
    assert _names(citation["authors"]) == [author["name"] for author in project["authors"]]
