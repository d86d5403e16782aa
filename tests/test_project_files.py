"""Files that GitHub, pre-commit and citation tools read: they parse, and agree with the project."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
FORMS = ("bug", "feature", "question")
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
    (path,) = (ROOT / ".github/workflows").iterdir()
    workflow = _read(str(path.relative_to(ROOT)))
    assert set(workflow["on"]) == {"push", "pull_request"}
    assert workflow["on"]["push"] == {"branches": ["main"]}
    (job,) = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands[-1] == ".ci/run"
    assert os.access(ROOT / ".ci/run", os.X_OK)
    assert job["steps"][-1].keys() == {"name", "run"}, "no condition and no `continue-on-error`"


def test_the_workflow_sets_up_the_machine_as_contributing_describes() -> None:
    (job,) = _read(".github/workflows/checks.yml")["jobs"].values()
    assert job["container"] == "debian:bookworm", "the Debian whose Python is 3.11"
    named = re.search(r"apt install ([\w\d -]+)`", _text("CONTRIBUTING.md"))
    assert named
    assert set(named[1].split()) <= set(job["steps"][0]["run"].split())
    assert f'TORCH_FLAGS="{job["env"]["TORCH_FLAGS"]}"' in _text("CONTRIBUTING.md")
    (cache,) = (step["with"] for step in job["steps"] if step.get("uses", "").startswith("actions/cache@"))
    assert cache["path"] == job["env"]["PIP_CACHE_DIR"]
    for name in re.findall(r"'([^']+)'", cache["key"]):
        assert (ROOT / name).is_file()


def test_the_issue_forms_are_the_known_ones() -> None:
    found = {path.name for path in (ROOT / ".github/ISSUE_TEMPLATE").iterdir()}
    assert found == {f"{name}.yml" for name in FORMS} | {"config.yml"}
    assert _read(".github/ISSUE_TEMPLATE/config.yml") == {"blank_issues_enabled": "true"}


@pytest.mark.parametrize("name", FORMS)
def test_an_issue_form_has_what_github_requires(name: str) -> None:
    form = _read(f".github/ISSUE_TEMPLATE/{name}.yml")
    assert form.keys() == {"name", "description", "labels", "body"}
    ids = [entry["id"] for entry in form["body"]]
    assert len(set(ids)) == len(ids)
    for entry in form["body"]:
        assert entry["type"] in {"textarea", "input"}
        assert entry.keys() <= {"type", "id", "attributes", "validations"}
        assert {"label", "description"} <= entry["attributes"].keys() <= {"label", "description", "render"}
        assert entry.get("validations", {"required": "true"}) == {"required": "true"}
    assert any("validations" in entry for entry in form["body"]), "an empty report is of no use"


def test_a_bug_report_needs_everything_that_repeats_the_bug() -> None:
    body = _read(".github/ISSUE_TEMPLATE/bug.yml")["body"]
    required = {entry["id"] for entry in body if "validations" in entry}
    assert {"rules", "command", "output", "version"} <= required
    (version,) = (entry for entry in body if entry["id"] == "version")
    assert "`powderdsl --version`" in version["attributes"]["description"]


def test_the_pull_request_template_asks_what_why_and_what_was_measured() -> None:
    headings = re.findall(r"^## (.+)$", _text(".github/pull_request_template.md"), re.MULTILINE)
    assert headings == ["What", "Why", "Measured"]


def test_pre_commit_runs_the_ruff_of_make_lint() -> None:
    (repo,) = _read(".pre-commit-config.yaml")["repos"]
    assert repo["repo"] == "local", "a remote hook would have a version of its own"
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", _text("Makefile"), re.MULTILINE)
    assert lint
    of_make = re.findall(r"\$\(BIN\)/(ruff .+) \.$", lint[1], re.MULTILINE)
    hooks = [hook["entry"].replace(" --force-exclude", "") for hook in repo["hooks"]]
    assert hooks == [f".venv/bin/{command}" for command in of_make]


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


def test_the_citation_names_the_paper() -> None:
    (paper,) = _read("CITATION.cff")["references"]
    assert paper["type"] == "conference-paper"
    assert paper["title"] == (
        "Powderworld: A Platform for Understanding Generalization via Rich Task Distributions"
    )
    assert _names(paper["authors"]) == ["Kevin Frans", "Phillip Isola"]
    assert paper["year"] == "2023"
    assert paper["url"] == "https://arxiv.org/abs/2211.13051"
    assert paper["url"] in _text("README.md")
