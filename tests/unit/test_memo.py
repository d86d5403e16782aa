"""Compiling again with a memo: the same results, and only what has changed is made anew."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from powderdsl import compiler
from powderdsl.compiler import load_with_diagnostics, lower, parts
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.standalone import standalone_module
from powderdsl.syntax.sources import shipped
from powderdsl.system.cache import Memo
from powderdsl.targets.wasm import source
from powderdsl.targets.wasm.source import wasm_module


def test_the_least_recently_used_is_forgotten() -> None:
    memo, made = Memo(versions=2, things=2), []

    def use(thing: str, version: str) -> str:
        return memo.of(thing, version, lambda: made.append(thing + version) or (thing + version).upper())

    assert [use("x", version) for version in "abacab"] == [f"X{version}".upper() for version in "abacab"]
    assert made == ["xa", "xb", "xc", "xb"]
    for thing in "yxzx":
        use(thing, "b")
    assert made[4:] == ["yb", "zb"]
    use("y", "b")
    assert made[6:] == ["yb"]


def test_threads_may_share_a_memo() -> None:
    memo = Memo(versions=2, things=3)

    def use(thread: int) -> bool:
        numbers = [(thread * step) % 7 for step in range(5000)]
        return all(memo.of(n % 4, n, partial(str, n)) == str(n) for n in numbers)

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(use, range(1, 9)))


def test_exceptions_are_not_kept() -> None:
    memo = Memo()

    def fail() -> None:
        raise KeyError

    for _ in range(2):
        with pytest.raises(KeyError):
            memo.of("thing", "version", fail)
    assert memo.of("thing", "version", lambda: 1) == 1


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """What parses a file, and counts."""
    monkeypatch.setattr(compiler, "persistent", lambda name, inputs, make: make())
    monkeypatch.setattr(compiler, "read_file", Mock(wraps=compiler.read_file))
    return compiler.read_file


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """What optimizes and plans a pass, and counts."""
    monkeypatch.setattr(source, "plan", Mock(wraps=source.plan))
    return source.plan


def test_a_file_is_parsed_once_in_a_process(tmp_path: Path, parse: Mock) -> None:
    pack = tmp_path / "chalk.yaml"
    for color in ("#EEEEEE", "#EEEEEE", "#DDDDDD"):
        pack.write_text(
            f"pack: chalk\nneeds: core\nelements:\n  chalk: {{id: 90, density: 4, color: '{color}'}}\n"
        )
        ruleset = compiler.load(f"core+{pack}")
        assert next(one for one in ruleset.elements if one.name == "chalk").color == color
    for _ in range(2):
        pack.write_text("pack: chalk\nnothing: known\n")
        with pytest.raises(CompileError, match="PD108"):
            compiler.load(pack)
    read = [call.args[0].text for call in parse.call_args_list]
    assert sum("color: '#" in text for text in read) == 2
    assert sum("nothing: known" in text for text in read) == 1


def code(path: Path, memo: Memo | None) -> bytes:
    model, _ = load_with_diagnostics(path)
    return b"".join(
        wasm_module(part.planes, width, memo=memo).code
        for part in parts(lower(model, memo), memo)
        if part.planes is not None
        for width in (64, 70)
    )


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    """A ruleset of shipped packs, in a folder where they can be edited."""
    for path in shipped("rules").glob("*.yaml"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "small.yaml").write_text("ruleset: small\npacks: [core, sand, water, wind]\n")
    return tmp_path


def test_only_what_has_changed_is_made_again(rules: Path, parse: Mock, plan: Mock) -> None:
    memo, path = Memo(), rules / "small.yaml"
    last = code(path, memo)
    assert parse.call_count == 5
    assert plan.call_count >= 5
    for name, old, new, planned in (
        ("water.yaml", "", "# lines that move change no code\n", 0),
        ("wind.yaml", "0.95 *", "0.9 *", 1),
        ("water.yaml", "count(ice) >= 3", "count(ice) >= 4", 1),
    ):
        text = (rules / name).read_text(encoding="utf-8")
        (rules / name).write_text(text.replace(old, new, 1), encoding="utf-8")
        parse.reset_mock()
        plan.reset_mock()
        found = code(path, memo)
        assert (found == last) == (planned == 0)
        last = found
        assert code(path, memo) == last
        assert (parse.call_count, plan.call_count) == (1, planned)
    assert last == code(path, None)


def test_modules_that_stand_alone_use_memos(rules: Path, plan: Mock) -> None:
    memo = Memo()
    model, _ = load_with_diagnostics(rules / "small.yaml")
    found = [standalone_module(model, (32, 64), one) for one in (None, memo, memo)]
    assert len(set(found)) == 1
    assert plan.call_count == 2 * len(lower(model).passes)
