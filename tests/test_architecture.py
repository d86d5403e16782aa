"""The architecture, as tests: who may import whom, which words may stand in the code, how long a file may be.

Each rule is a table and a function from source text to faults. Every function is also shown a source that
breaks its rule, so none of these tests passes because it looks at nothing.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import yaml

from tests.layers import LAYERS, THIRD_PARTIES

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "powderdsl"
MAP = ROOT / "docs" / "architecture.md"
MADE_FOLDERS = ("web/made", "web/parts")
"""Folders that `make web` and `make wheel` write, and git ignores."""
MAX_LINES = 800
LINE_BUDGET = 58_873
"""Lines of Python that powderdsl/ may have."""

EMPTY_NAMES = ("utils", "util", "common", "helpers", "helper", "base", "misc")
"""Names that say nothing: such a module has no reason to refuse anything."""

NAME_SECTIONS = ("elements", "passes", "fields", "properties")
"""Sections of a rule file whose keys Python must not know."""

PYTHON_WORDS = {
    "empty": "np.empty, torch.empty; a world or a set that is empty",
    "clone": "Tensor.clone",
    "freeze": "gc.freeze",
}
"""Names in the shipped rules that are also words of Python or its libraries: allowed everywhere."""

ENGLISH_WORDS = {
    "fire": "rules fire, or can never fire",
    "flow": "data flow, control flow",
    "board": "TensorBoard",
}
"""Names in the shipped rules that are also plain English: allowed in sentences, never in code."""

LIBRARY_WORDS = {"syntax.pure_yaml": {"flow"}}  # YAML's collections in brackets: names of PyYAML's methods
"""Names in the shipped rules that a library's names have in them, by the module that uses that library."""


# --- imports


@dataclass(frozen=True)
class Import:
    """An import statement: dotted name (``a.b.*`` for a star), line, and whether it runs with the module."""

    name: str
    line: int
    at_import: bool
    relative: bool = False


def imports_of(source: str) -> list[Import]:
    """Every import of a source, also in functions and under TYPE_CHECKING; import_module of a constant."""
    found: list[Import] = []

    def visit(node: ast.AST, now: bool) -> None:
        match node:
            case ast.Import():
                found.extend(Import(alias.name, node.lineno, now) for alias in node.names)
            case ast.ImportFrom():
                stem = f"{node.module}." if node.module else ""
                found.extend(
                    Import(stem + alias.name, node.lineno, now, node.level > 0) for alias in node.names
                )
            case ast.Call(args=[ast.Constant(value=str(name)), *_]):
                if ast.unparse(node.func).rpartition(".")[2] in ("import_module", "__import__"):
                    found.append(Import(name, node.lineno, now))
            case ast.If() if ast.unparse(node.test).rpartition(".")[2] == "TYPE_CHECKING":
                for statement in node.body:
                    visit(statement, False)
                for statement in node.orelse:
                    visit(statement, now)
                return
        inside_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            visit(child, now and not inside_function)

    visit(ast.parse(source), True)
    return found


def matches(module: str, patterns: Iterable[str]) -> bool:
    """Whether a dotted module is, or lies in, one of the patterns."""
    return any(fnmatchcase(module, pattern) or fnmatchcase(module, f"{pattern}.*") for pattern in patterns)


def row_of(module: str) -> str | None:
    """The row of LAYERS that says what a module, or a name in it, may import: the longest that fits."""
    return max((row for row in LAYERS if matches(module, [row])), key=len, default=None)


def layer_faults(module: str, source: str) -> Iterator[str]:
    """Imports inside powderdsl that LAYERS does not allow. `module` is dotted, without ``powderdsl.``."""
    own = row_of(module)
    if own is None:
        yield f"{module} has no row in LAYERS"
        return
    for found in imports_of(source):
        package, _, target = found.name.partition(".")
        if package != "powderdsl" or found.relative:
            continue
        row = row_of(target)
        if row is None:
            yield f"{module}:{found.line} imports from powderdsl itself: {found.name}"
        elif row != own and row not in LAYERS[own]:
            yield f"{module}:{found.line} may not import {found.name}"


def third_party_faults(module: str, source: str) -> Iterator[str]:
    """Imports of third parties outside the places that THIRD_PARTIES gives them."""
    for found in imports_of(source):
        home = THIRD_PARTIES.get(found.name.partition(".")[0])
        if home is None or found.relative:
            continue
        if not matches(module, home.anywhere):
            yield f"{module}:{found.line} may not import {found.name}"
        elif found.at_import and not matches(module, home.at_import):
            yield f"{module}:{found.line} may import {found.name} only inside a function"


def import_style_faults(module: str, source: str) -> Iterator[str]:
    """Relative imports and star imports."""
    for found in imports_of(source):
        if found.relative:
            yield f"{module}:{found.line} has a relative import"
        if found.name.endswith("*"):
            yield f"{module}:{found.line} has a star import"


# --- sizes and names of modules


def size_faults(module: str, source: str) -> Iterator[str]:
    """A source of more than MAX_LINES lines."""
    lines = source.count("\n")
    if lines > MAX_LINES:
        yield f"{module} has {lines} lines, more than {MAX_LINES}: split it by responsibility"


def budget_faults(sources: Mapping[str, str], budget: int = LINE_BUDGET) -> Iterator[str]:
    """A package of more lines than its budget."""
    lines = sum(source.count("\n") for source in sources.values())
    if lines > budget:
        yield (
            f"powderdsl/ has {lines:,} lines of Python, more than LINE_BUDGET = {budget:,}: simplify or delete code; "
            "raising the budget takes a decision record in docs/decisions/"
        )


def module_name_faults(modules: Iterable[str]) -> Iterator[str]:
    """Modules and packages (dotted) with an empty name, or with a prefix that their folder has already."""
    for module in modules:
        home, _, base = module.rpartition(".")
        folder = home.rpartition(".")[2]
        if base in EMPTY_NAMES:
            yield f"{module}: a name that says nothing"
        if folder and base.startswith((f"{folder}_", f"{folder.removesuffix('s')}_")):
            yield f"{module}: the folder says `{folder}` already"


# --- paths in the documentation


def path_faults(markdown: str, exists: Callable[[str], bool]) -> Iterator[str]:
    """Paths in inline code and in links that do not exist. Fenced blocks are left out: they show commands."""
    text = re.sub(r"^```.*?^```", "", markdown, flags=re.MULTILINE | re.DOTALL)
    named = re.findall(r"`([^`\n]+)`", text) + re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    for name in dict.fromkeys(named):
        like_path = re.fullmatch(r"[\w.*/-]+", name) and (
            "/" in name or re.search(r"\.(py|md|yaml|lark|toml|txt)$", name)
        )
        if like_path and not exists(name):
            yield f"no such path: {name}"


def path_exists(name: str) -> bool:
    """Whether a path or a glob exists, seen from the repository, the package or docs/."""
    return any(any(start.glob(name.strip("/"))) for start in (ROOT, PACKAGE, ROOT / "docs"))


# --- the map


def folders_on_map(markdown: str) -> dict[str, str]:
    """The rows of the table of folders: the folder in the first column, and what the second says."""
    return dict(re.findall(r"^\| `(\w+)/` \| (.*) \|$", markdown, re.MULTILINE))


def on_map(folder: str, rows: Mapping[str, str]) -> bool:
    """True if a folder has a row, or is named in the row of the folder that it is in."""
    return folder in rows or f"`{folder}/`" in rows.get(folder.partition("/")[0], "")


def later_imports(folders: Sequence[str]) -> Iterator[str]:
    """Rows of LAYERS that may import from a folder further down the table than their own."""
    for row, allowed in LAYERS.items():
        own = row.partition(".")[0]
        for other in dict.fromkeys(name.partition(".")[0] for name in allowed):
            if own in folders and other in folders and folders.index(other) > folders.index(own):
                yield f"{row} imports {other}"


# --- words of the rules


def names_in_rules(text: str) -> set[str]:
    """The names that a rule file declares in NAME_SECTIONS. Scalars stay text, so `no` is a name."""
    # The C loader: the pure one refuses a name that ends in `?` within a list in brackets.
    tree = yaml.load(text, Loader=yaml.CBaseLoader)
    sections = [tree.get(section) for section in NAME_SECTIONS] if isinstance(tree, dict) else []
    return {key.strip("?").lower() for section in sections if isinstance(section, dict) for key in section}


def words_of(source: str) -> Iterator[tuple[str, int, bool]]:
    """Words of a source with their lines, and whether they are code: identifiers, strings, comments.

    Identifiers are split at underscores and capitals. A string without white space counts as code: it is a
    key or a name, not a sentence.
    """
    prose = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME or token.type in prose:
            code = token.type != tokenize.COMMENT and not re.search(r"\s", token.string)
            for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", token.string):
                yield word.lower(), token.start[0], code


def word_faults(module: str, source: str, names: set[str]) -> Iterator[str]:
    """Names of the shipped rules that stand in a Python source."""
    names = names - PYTHON_WORDS.keys() - LIBRARY_WORDS.get(module, set())
    single = {name for name in names if name.isalpha()}
    for word, line, code in words_of(source):
        if word in single and (code or word not in ENGLISH_WORDS):
            yield f"{module}:{line} knows `{word}`"
    for number, text in enumerate(source.splitlines(), 1):
        for name in names - single:
            if re.search(rf"\b{re.escape(name)}\b", text):
                yield f"{module}:{number} knows `{name}`"


# --- the sources as they are


def dotted(path: Path) -> str:
    """`powderdsl/ir/ops.py` is `ir.ops`, `powderdsl/ir/__init__.py` is `ir`, the root's is `__init__`."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    found = {dotted(path): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    assert {"__init__", "diagnostics", "syntax"} <= found.keys(), "the package is not where these tests look"
    return found


@pytest.fixture(scope="module")
def shipped_names() -> set[str]:
    texts = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "rules").rglob("*.yaml"))]
    found = set().union(*map(names_in_rules, texts))
    assert {"sand", "water", "gravity", "velocity"} <= found, (
        "these tests no longer read rule files as they are"
    )
    return found


def expect_none(faults: Iterable[str]) -> None:
    found = list(faults)
    assert not found, "\n".join(["", *found])


@pytest.mark.parametrize("rule", [layer_faults, third_party_faults, import_style_faults, size_faults])
def test_every_module_keeps(rule: Callable[[str, str], Iterable[str]], sources: dict[str, str]) -> None:
    expect_none(fault for module, source in sources.items() for fault in rule(module, source))


@pytest.mark.parametrize(
    ("rule", "module", "source", "fault"),
    [
        (
            layer_faults,
            "model.reference",
            "from powderdsl import ir",
            "model.reference:1 may not import powder",
        ),
        (layer_faults, "model.check", "from powderdsl.model import reference", "may not import"),
        (layer_faults, "ir.stages.fuse", "from powderdsl.model import Rule", "may not import"),
        (layer_faults, "targets.torch.program", "from powderdsl.ir.stages import PIPELINE", "may not import"),
        (layer_faults, "targets.wasm.program", "from powderdsl.targets.cpp import build", "may not import"),
        (layer_faults, "targets.job", "from powderdsl.targets.cpp import build", "may not import"),
        (layer_faults, "ir.ops", "from powderdsl.model import Rule", "may not import"),
        (layer_faults, "ir.ops", "from powderdsl.ir.lower import lower_ruleset", "may not import"),
        (layer_faults, "worlds.scene", "from powderdsl.simulation.simulator import World", "may not import"),
        (layer_faults, "syntax.parse", "def late():\n    from powderdsl.model import x", "syntax.parse:2"),
        (layer_faults, "model.read", "if TYPE_CHECKING:\n    import powderdsl.ir", "model.read:2"),
        (layer_faults, "model.read", "import_module('powderdsl.ir')", "model.read:1"),
        (layer_faults, "envs.gym", "import powderdsl.rl.policies", "may not import"),
        (layer_faults, "simulation.leftover", "import powderdsl.model", "may not import"),
        (layer_faults, "model.read", "from powderdsl import load", "imports from powderdsl itself"),
        (layer_faults, "model.read", "import powderdsl", "imports from powderdsl itself"),
        (layer_faults, "leftover", "", "leftover has no row in LAYERS"),
        (third_party_faults, "model.read", "import yaml", "may not import yaml"),
        (third_party_faults, "worlds.ascii", "from lark import Lark", "may not import lark.Lark"),
        (third_party_faults, "targets.cpp.build", "import torch.nn as nn", "may not import torch.nn"),
        (third_party_faults, "compiler", "def f():\n    import torch", "compiler:2 may not import torch"),
        (third_party_faults, "cli.run", "import torch", "cli.run:1 may import torch only inside a function"),
        (
            third_party_faults,
            "simulation.draw",
            "try: import torch\nexcept E: pass",
            "only inside a function",
        ),
        (import_style_faults, "draw", "from .ir import ops", "draw:1 has a relative import"),
        (import_style_faults, "draw", "from . import ir", "draw:1 has a relative import"),
        (import_style_faults, "draw", "from numpy import *", "draw:1 has a star import"),
        (size_faults, "draw", "x = 1\n" * 801, "draw has 801 lines"),
    ],
)
def test_each_rule_can_fail(
    rule: Callable[[str, str], Iterable[str]], module: str, source: str, fault: str
) -> None:
    faults = list(rule(module, source))
    assert len(faults) == 1
    assert fault in faults[0]


@pytest.mark.parametrize(
    ("rule", "module", "source"),
    [
        (layer_faults, "ir.lower", "from powderdsl.model import types"),
        (layer_faults, "worlds.store", "from powderdsl.simulation.simulator import World"),
        (layer_faults, "__init__", "def f():\n    import powderdsl.simulation.simulator"),
        (layer_faults, "cli.run", "from powderdsl import worlds, compiler"),
        (layer_faults, "simulation.simulator", "from powderdsl.simulation.programs import make_program"),
        (third_party_faults, "targets.torch.program", "import torch"),
        (third_party_faults, "simulation.draw", "if TYPE_CHECKING:\n    import torch"),
        (third_party_faults, "cli.run", "def f():\n    import torch"),
        (size_faults, "draw", "x = 1\n" * 800),
    ],
)
def test_each_rule_can_pass(rule: Callable[[str, str], Iterable[str]], module: str, source: str) -> None:
    assert list(rule(module, source)) == []


def test_the_package_stays_within_its_line_budget(sources: dict[str, str]) -> None:
    expect_none(budget_faults(sources))
    three = {"draw": "x = 1\n" * 2, "worlds": "x = 1\n"}
    assert list(budget_faults(three, 3)) == []
    (fault,) = budget_faults(three, 2)
    assert "3 lines of Python" in fault
    assert "docs/decisions/" in fault


def test_layers_only_look_left() -> None:
    rows = list(LAYERS)
    for row, allowed in LAYERS.items():
        expect_none(f"{row} imports {other}" for other in allowed if rows.index(other) >= rows.index(row))


def test_modules_have_names_that_say_something(sources: dict[str, str]) -> None:
    expect_none(module_name_faults(sources))
    assert list(module_name_faults(["ir.utils"])) == ["ir.utils: a name that says nothing"]
    assert list(module_name_faults(["cuda.cuda_words"])) == [
        "cuda.cuda_words: the folder says `cuda` already"
    ]
    assert len(list(module_name_faults(["tasks.task_file"]))) == 1
    assert list(module_name_faults(["cli.draw", "draw", "tasks.task"])) == []


def test_modules_stand_in_folders() -> None:
    """The package's top is for what everything goes through."""
    loose = {path.stem for path in PACKAGE.glob("*.py")}
    assert loose == {"__init__", "__main__", "compiler"}


def test_tests_and_native_code_stay_short() -> None:
    native = [path for path in PACKAGE.rglob("*") if path.suffix in (".hpp", ".cuh")]
    assert native
    for path in (*native, *(ROOT / "tests").rglob("*.py")):
        expect_none(size_faults(path.name, path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", ["architecture.md", "compiler.md"])
def test_pages_about_the_code_name_paths_that_exist(name: str) -> None:
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    expect_none(path_faults(text, path_exists))
    # Seen from nowhere, every one of its paths is missing: so the page does name some.
    assert len(list(path_faults(text, lambda _: False))) >= 10


def test_the_map_is_short_and_has_every_folder_and_the_layers_in_order() -> None:
    text = MAP.read_text(encoding="utf-8")
    assert len(text.split()) <= 1_500, f"move details out of {MAP.name}"
    rows = folders_on_map(text)
    files = (path for kind in ("py", "md", "js") for path in PACKAGE.rglob(f"*.{kind}"))
    folders = {path.parent.relative_to(PACKAGE).as_posix() for path in files} - {"."}
    expect_none(
        f"{folder}/ is not on the map"
        for folder in sorted(folders)
        if not folder.startswith(MADE_FOLDERS) and not on_map(folder, rows)
    )
    later = list(later_imports(list(rows)))
    assert later == ["analysis.costs imports ir"], (
        "the map says which module imports from a folder below its own"
    )
    assert "exception is `analysis/costs.py`" in text


def test_the_map_can_fail() -> None:
    rows = folders_on_map("| `ir/` | stages |\n| `model/` | rules; `model/logic/` |\n")
    assert list(rows) == ["ir", "model"]
    assert [folder for folder in ("ir", "model/logic", "model/text", "web") if not on_map(folder, rows)] == [
        "model/text",
        "web",
    ]
    assert "ir.lower imports model" in later_imports(["ir", "model"])


def test_paths_can_fail() -> None:
    page = (
        "`gone/x.py`, `x.md`, [here](gone/y.md#part), `pyproject.toml`, `ir/`, `a -> b`\n```\nno/such\n```\n"
    )
    found = [fault.split()[-1] for fault in path_faults(page, path_exists)]
    assert found == ["gone/x.py", "x.md", "gone/y.md"]
    assert list(path_faults("`gone/*.py`, `powderdsl/*.py`", path_exists)) == ["no such path: gone/*.py"]


def test_python_knows_no_name_of_the_rules(sources: dict[str, str], shipped_names: set[str]) -> None:
    expect_none(
        fault for name, source in sources.items() for fault in word_faults(name, source, shipped_names)
    )
    assert (PYTHON_WORDS.keys() | ENGLISH_WORDS.keys()) - shipped_names == set()


@pytest.mark.parametrize(
    "source",
    [
        'if name == "sand": pass',
        "sand_mask = 1",
        "class SandPass: pass",
        "SAND = 2",
        'f"{sand}"',
        'f"the {x} sand"',
        '"falls like sand"',
        '"""A docstring about\n\nsand."""',
        "x = 1  # a sand castle",
        '"sand,water"',
        'x["fire"]',
        "fire = 1",
        "was_hot = 1",
    ],
)
def test_names_of_rules_are_found(source: str) -> None:
    assert list(word_faults("draw", source, {"sand", "fire", "was_hot", "empty"}))


@pytest.mark.parametrize(
    "source",
    ["thousand = sandbox = 1", '"a rule can never fire"', "torch.empty(3)", "x = 1  # rules fire in order"],
)
def test_other_words_are_not(source: str) -> None:
    assert list(word_faults("draw", source, {"sand", "fire", "empty"})) == []


def test_names_are_read_from_rules() -> None:
    text = "pack: x\nelements:\n  no: {id: 1}\npasses:\n  fall?: {do: a -> b}\nparams: {p: 1%}\n"
    assert names_in_rules(text) == {"no", "fall"}
