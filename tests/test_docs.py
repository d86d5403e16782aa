"""The documentation, run: packs load and pass their tests, code and commands run, links lead somewhere.

Fenced blocks are run page by page, in order, in one temporary directory:

* ``yaml``: a whole pack or ruleset, so that readers can paste it. It is saved under its name for later blocks to load,
  and its `tests:` are run. One with ``task:`` is a task, which must have no mistakes; one with ``scene:`` is drawn.
* ``statements`` of a generator and ``rewards``, one a line, with the names of `TASK`.
* ``rules``: one rule a line, each loaded in a pass of its own. ``expressions``: one value a line.
* ``python``: one namespace a page. A line ``VALUE  # uint8 [8, 64, 64]`` is compared.
* ``console``: what follows ``$ powderdsl`` is run; other lines must occur in what it prints. The exit code
  is 0, or 2 where the block shows an error.

Readers do not see the notes of a block, which stand in an HTML comment on the line above it:

* ``<!-- with: core+sand -->``: the rules that it is loaded with; otherwise the pack's `needs`.
* ``<!-- error: PD301; warning: PD507; note: PD506 -->``: the diagnostics that it must have.
* ``<!-- file: docs/examples/x.yaml -->`` above a pack: it is all of that file but its invariants and tests. Above Python:
  it is saved under that name for later blocks.
* ``<!-- needs: MODULE -->`` above Python: it is left out where that module is not installed, and the page is then
  reported as skipped.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from powderdsl.compiler import load, load_with_diagnostics
from powderdsl.diagnostics import CompileError, Diagnostic, Severity
from powderdsl.model.types import Ruleset
from powderdsl.tasks.shipped import load_task_with_diagnostics
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.worlds.scene import draw_start, find_scene

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ROOT_PAGES = ("README.md", "AGENTS.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/README.md")
PAGES = [*(ROOT / name for name in ROOT_PAGES), *sorted(DOCS.rglob("*.md"))]
SLOW = {
    "docs/creatures.md",
    "docs/libraries.md",
    "docs/migrating.md",
    "docs/ogbench.md",
    "docs/worldmodels.md",
}
MANY_STEPS = 4
"""Commands that run longer are cut to this many steps: what they print does not depend on it."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text, the line it starts at, and the comment above it."""

    language: str
    text: str
    line: int
    comment: str = ""

    def expected(self, word: str) -> str:
        """The value of `word: value` in the comment above the block."""
        notes = dict(note.split(": ", 1) for note in self.comment.split("; ") if note)
        return notes.get(word, "")


RUNNABLE = ("yaml", "rules", "expressions", "statements", "rewards", "python", "console")
TASK = """task: example
rules: powderworld
size: [64, 64]
fill: empty
knobs: {kinds: {default: 3, range: 1..4}}
let: {row: 8..53}
regions: {pit: box rows 50:63, slot: box columns 54:63}
targets: {house: [fill wood in pit]}
agent: {may: [any, blow], speed: 20, actions: 64}
"""
FENCED = re.compile(r"(?:^<!-- (\w+: [^\n]*) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks_of(page: str) -> list[Block]:
    return [
        Block(match[2], match[3], page[: match.start(3)].count("\n"), match[1] or "")
        for match in FENCED.finditer(page)
    ]


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.fixture
def folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory that sees the repository's folders."""
    for name in ("docs", "rules", "tasks"):
        (folder / name).symlink_to(ROOT / name)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    return folder


# --- what runs each language


def run_yaml(block: Block) -> None:
    text = block.text
    if text.startswith("task:"):
        run_task(text)
        return
    if scene := re.search(r"^scene: *(\S+)$", text, re.MULTILINE):
        Path(f"{scene[1]}.yaml").write_text(text, encoding="utf-8")
        draw_start(find_scene(f"{scene[1]}.yaml"), load(block.expected("with")))
        return
    name = re.search(r"^(?:pack|ruleset): *(\w+)", text, re.MULTILINE)
    assert name, "the block names no pack"
    if block.expected("file"):
        whole = (ROOT / block.expected("file")).read_text(encoding="utf-8")
        assert text == re.split(r"^(?:invariants|tests):", whole, flags=re.MULTILINE)[0]
    packs = block.expected("with")
    path = Path(f"{name[1]}.yaml")
    path.write_text(text, encoding="utf-8")
    ruleset, found = diagnosed(*filter(None, [packs]), path)
    # What others' files are told, such as tags that nothing has, depends on which packs the example needs.
    own = [one for one in found if one.primary.span is None or one.primary.span.source.name == str(path)]
    for severity in Severity:
        codes = sorted({one.code for one in own if one.severity is severity})
        wanted = sorted(block.expected(severity.value).split())
        if wanted or severity is not Severity.NOTE:
            assert codes == wanted, [f"{one.code} {one.message}" for one in own]
    if ruleset is not None:
        run_tests(ruleset, name[1])


def run_task(text: str) -> None:
    Path("task.yaml").write_text(text, encoding="utf-8")
    _, found = load_task_with_diagnostics("task.yaml")
    assert [f"{one.code} {one.message}" for one in found] == []


def run_task_lines(block: Block) -> None:
    """`statements` and `rewards`: each line in a task of its own."""
    for line in filter(None, block.text.splitlines()):
        rest = f"generate:\n  - {line}\n" if block.language == "statements" else f"reward:\n  each: {line}\n"
        run_task(TASK + rest)


def diagnosed(*names: str | Path) -> tuple[Ruleset | None, tuple[Diagnostic, ...]]:
    try:
        return load_with_diagnostics(*names)
    except CompileError as error:
        return None, tuple(error.diagnostics)


def run_tests(ruleset: Ruleset, pack: str) -> None:
    """The tests of one pack."""
    own = tuple(example for example in ruleset.tests if example.pack == pack)
    for result in run_examples(replace(ruleset, tests=own)):
        assert result.passed, f"{result.example.name}: {result.problem}, seed {result.seed}: {result.after}"


def run_lines(block: Block) -> None:
    """`rules` and `expressions`: each line alone, so that no line hides another's mistake."""
    is_value = block.language == "expressions"
    fields = block.expected("fields")
    for line in block.text.splitlines():
        line = re.sub(r"\s+# .*", "", line).strip()
        if not line or line.startswith("# "):
            continue
        body = f"let:\n      value: {line}\n    then: any -> here" if is_value else f"do:\n      - {line}"
        Path("line.yaml").write_text(
            "pack: line\n" + (f"fields: {{{fields}}}\n" if fields else "") + f"passes:\n  line:\n    {body}\n"
        )
        _, found = diagnosed(*filter(None, [block.expected("with")]), "line.yaml")
        errors = [f"{one.code} {one.message}" for one in found if one.severity is Severity.ERROR]
        assert not errors, f"{line}: {errors}"


def run_console(block: Block) -> None:
    printed = ""
    for line in block.text.splitlines():
        if not line.startswith("$ "):
            seen = line.strip() in ("", "…") or line.rstrip() in printed
            assert seen, f"not printed: {line}\n{printed}"
        elif line.startswith("$ powderdsl "):
            fails = re.search(r"^(differ:|BROKEN)", block.text, re.MULTILINE)
            status = 2 if "error[PD" in block.text else 1 if fails else 0
            printed = run_command(shlex.split(line.removeprefix("$ powderdsl "), comments=True), status)
            printed = printed.replace(f"{ROOT}/", "")  # as seen from the repository


def run_command(arguments: list[str], status: int = 0) -> str:
    for i, word in enumerate(arguments[:-1]):
        if word == "--steps":
            arguments[i + 1] = str(min(int(arguments[i + 1]), MANY_STEPS))
    if "--watch" in arguments:  # needs a terminal: that its options exist must do
        arguments = [arguments[0], "--help"]
    from powderdsl.cli import main

    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == status, f"powderdsl {shlex.join(arguments)}: {result.output}"
    return result.output


SHOWN = re.compile(r"^(\S.*?) +# (u?int\d+|float\d+) (\[[\d, ]+\])$", re.MULTILINE)


def run_python(block: Block, namespace: dict[str, Any]) -> None:
    if block.expected("file"):
        Path(block.expected("file")).write_text(block.text, encoding="utf-8")
    exec(compile(block.text, "<documentation>", "exec"), namespace)
    for value, dtype, shape in SHOWN.findall(block.text):
        tensor = eval(value, namespace)
        found = f"{str(tensor.dtype).rpartition('.')[2]} {list(tensor.shape)}"
        assert found == f"{dtype} {shape}", f"{value} is {found}"


def run_block(block: Block, namespace: dict[str, Any]) -> None:
    match block.language:
        case "yaml":
            run_yaml(block)
        case "rules" | "expressions":
            run_lines(block)
        case "statements" | "rewards":
            run_task_lines(block)
        case "console":
            run_console(block)
        case "python":
            run_python(block, namespace)


# --- the pages as they are


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def runnable(page: Path) -> bool:
    return any(block.language in RUNNABLE for block in blocks_of(read(page)))


def marked(page: Path) -> Any:
    return pytest.param(page, id=page_name(page), marks=[pytest.mark.slow] if page_name(page) in SLOW else [])


# Of workers of a DataLoader: torch warns on one core, Python from 3.12 on of a fork beside other threads.
@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("page", [marked(page) for page in PAGES if runnable(page)])
def test_blocks_run(page: Path, folder: Path) -> None:
    run_page(page)


def run_page(page: Path) -> None:
    namespace: dict[str, Any] = {"__name__": "documentation"}
    missing = []
    for block in blocks_of(read(page)):
        needed = block.expected("needs")
        if block.language == "python" and needed and importlib.util.find_spec(needed) is None:
            missing.append(needed)
            continue
        try:
            run_block(block, namespace)
        except BaseException as error:
            error.add_note(f"in the {block.language} block at {page}:{block.line}")
            raise
    if missing:
        pytest.skip(f"not installed: {', '.join(dict.fromkeys(missing))}")


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_lead_somewhere(page: Path) -> None:
    assert list(dead_links(read(page), page)) == []


def dead_links(text: str, page: Path) -> Iterator[str]:
    """Relative links to files that do not exist, or to headings that a page does not have."""
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCED.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        other = (page.parent / file).resolve() if file else page
        if not other.exists() or (anchor and anchor not in headings(read(other) if file else text)):
            yield target


def headings(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", FENCED.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.fixture(scope="module")
def generate() -> Any:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_are_fresh(generate: Any) -> None:
    stale = [page_name(page) for page in generate.stale_pages()]
    assert stale == [], "run `python docs/generate.py`"
    page = "a\n<!-- generated: kinds -->\nold\n<!-- end -->\nb\n"
    fresh = generate.generated(page)
    assert "`flag`" in fresh
    assert "old" not in fresh
    assert generate.generated(fresh) == fresh


PICTURES = sorted({path for page in PAGES for path in re.findall(r"--out (docs/images/\S+) -->", read(page))})
SHOWN_STEPS = 24
"""Steps of animations that are compared."""


@pytest.mark.slow
@pytest.mark.parametrize("path", PICTURES)
def test_pictures_are_what_their_commands_draw(path: str, generate: Any, tmp_path: Path) -> None:
    """Its first frames, pixel by pixel: `python docs/generate.py --pictures` draws pictures again."""
    from powderdsl.cli import main

    arguments = list(generate.pictures()[path])
    at = arguments.index("--steps") + 1
    shown = min(int(arguments[at]), SHOWN_STEPS)
    out = tmp_path / "drawn.gif"
    fewer = [*arguments[:at], str(shown), *arguments[at + 1 :]]
    result = CliRunner().invoke(main, [*fewer, "--backend", "wasm", "--out", str(out)])
    assert result.exit_code == 0, result.output
    drawn, kept = frames_of(out), frames_of(ROOT / path)
    assert len(drawn) > 2
    assert drawn == kept[: len(drawn)]


def frames_of(path: Path) -> list[bytes]:
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        return [frame.convert("RGB").tobytes() for frame in ImageSequence.Iterator(image)]


def test_every_table_of_keys_is_shown(generate: Any) -> None:
    """A new kind of mapping, or a function, cannot stay undocumented."""
    shown = {found for page in PAGES for found in re.findall(r"<!-- generated: ([\w ]+) -->", read(page))}
    described = {
        "axis",
        "end",
        "expert",
        "measure",
        "scratch",
        "set",
        "stamp",
        "stand",
        "study",
        "tag",
    }  # in words, or as a whole file
    bases = {"block", "laws", "variant"}  # their keys are those of a pass, of splits and stands, of tasks
    assert generate.TABLES.keys() - shown == {f"keys {name}" for name in described | bases}


# --- the checks can fail


@pytest.mark.parametrize(
    ("language", "text", "comment"),
    [
        ("yaml", "pack: a\nneeds: [core]\nelements: {salt: {id: 20, color: '#FFFFFF'}}\n", "error: PD301"),
        ("yaml", "pack: a\nneeds: [core]\nparams: {unused: 5%}\n", ""),
        ("yaml", "elements: {salt: {id: 20, color: '#FFFFFF'}}\n", ""),
        ("rules", "wall -> empty\nwall -> salt\n", "with: core"),
        ("expressions", "count(wall) > 1\ncount(wall) > wall\n", "with: core"),
        ("yaml", "scene: bad\nsize: [3, 3]\nfill: empty\ndraw: [fill wal]\n", "with: core"),
        ("statements", "fill wall\nfill wal\n", ""),
        ("rewards", "count(wall)\ncount(wal)\n", ""),
        ("console", "$ powderdsl explain PD999\n", ""),
        ("console", "$ powderdsl --version\npowderdsl 77.0\n", ""),
        ("python", "assert False\n", ""),
        ("python", "import numpy\nnumpy.zeros(3)  # float32 [3]\n", ""),
        ("yaml", "pack: salt\n", "file: docs/examples/salt.yaml"),
    ],
)
def test_blocks_can_fail(language: str, text: str, comment: str, folder: Path) -> None:
    with pytest.raises((AssertionError, CompileError)):
        run_block(Block(language, text, 1, comment), {})


def test_a_page_without_an_optional_dependency_is_skipped_visibly(folder: Path) -> None:
    page = folder / "page.md"
    page.write_text(
        "<!-- needs: no_such_module -->\n```python\nassert False\n```\n```python\n__import__('pathlib').Path('ran').touch()\n```\n"
    )
    with pytest.raises(pytest.skip.Exception, match="not installed: no_such_module"):
        run_page(page)
    assert Path("ran").exists()


def test_links_can_fail() -> None:
    text = "# Two words\n[a](gone.md) [b](#two-words) [c](#three) [d](https://x.org) [e](README.md#gone)\n"
    assert list(dead_links(text, ROOT / "README.md")) == ["gone.md", "#three", "README.md#gone"]
