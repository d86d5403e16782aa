"""The built documentation in Chromium: links, search, colors, small screens. It is built without films."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml

from tests.wasm.standalone_world import CHROMIUM
from tests.wheels import ROOT, succeed

pytestmark = pytest.mark.slow
HERE = Path(__file__).resolve().parent
QUESTIONS = yaml.safe_load((ROOT / "tests/data/questions.yaml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `.ci/run` builds it."""
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "PICTURES": "no", "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def report(site: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What docs.mjs reports of the site, which it opens as files: nothing is served."""
    if shutil.which("node") is None or not (HERE / "node_modules" / "axe-core").is_dir() or not CHROMIUM:
        pytest.skip("needs Chromium and what `make web` fetches")
    folder = tmp_path_factory.mktemp("pictures")
    words = (HERE / "docs.mjs", site.as_uri() + "/", folder, json.dumps(QUESTIONS))
    return json.loads(succeed(str(shutil.which("node")), *words, cwd=folder))


def test_no_link_is_dead(site: Path) -> None:
    check = [sys.executable, str(ROOT / "docs/check_site.py"), str(site)]
    done = subprocess.run(check, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (site / "index.html").write_text('<a href="gone.html">', encoding="utf-8")
    assert subprocess.run(check, capture_output=True, check=False).returncode == 1


def test_the_search_answers_questions(report: dict[str, Any]) -> None:
    unanswered = [
        f"{question['ask']}: {report['answers'][question['ask']]}"
        for question in QUESTIONS
        if not any(answers(address, question["page"]) for address in report["answers"][question["ask"]])
    ]
    assert len(QUESTIONS) >= 20
    assert unanswered == []


def answers(address: str, page: str) -> bool:
    """Whether a result is the page that a question names, at any of its headings."""
    return urlsplit(address).path.endswith(f"/{page.partition('#')[0].removesuffix('.md')}.html")


def test_pages_suit_eyes_and_screens(report: dict[str, Any]) -> None:
    assert report["violations"] == []
    assert report["wide"] == []
    assert report["problems"] == []
