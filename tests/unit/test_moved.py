"""Old names of modules: they import what stands elsewhere now, say so, and there is one module of each."""

from __future__ import annotations

import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from powderdsl.moved import MOVED, new_name

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    for old in MOVED:
        home, _, base = f"powderdsl.{old}".rpartition(".")
        if home in sys.modules:
            monkeypatch.delattr(sys.modules[home], base, raising=False)
        for name in [name for name in sys.modules if f"{name}.".startswith(f"powderdsl.{old}.")]:
            monkeypatch.delitem(sys.modules, name)


def imported(name: str) -> tuple[ModuleType, list[str]]:
    """A module, and the deprecations that its import warned of."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always", DeprecationWarning)
        module = import_module(name)
    return module, [str(one.message) for one in found]


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_is_the_same_module(old: str) -> None:
    found, said = imported(f"powderdsl.{old}")
    assert f"powderdsl.{old} has moved to powderdsl.{MOVED[old]}" in said
    assert found is import_module(f"powderdsl.{MOVED[old]}")
    assert found.__name__ == f"powderdsl.{MOVED[old]}"
    assert found.__spec__ is not None
    assert found.__spec__.name == found.__name__


@pytest.mark.parametrize("old", MOVED)
def test_no_module_has_an_old_name(old: str) -> None:
    home = ROOT / "powderdsl" / old.replace(".", "/")
    assert not [*home.rglob("*.py"), *home.parent.glob(f"{home.name}.py")]  # stale bytecode may lie there


def test_modules_in_a_package_that_moved() -> None:
    found, said = imported("powderdsl.tracing.trace")
    assert found is import_module("powderdsl.simulation.tracing.trace")
    assert said == [
        "powderdsl.tracing has moved to powderdsl.simulation.tracing",
        "powderdsl.tracing.trace has moved to powderdsl.simulation.tracing.trace",
    ]


def test_the_warning_names_the_line_that_imports() -> None:
    with pytest.warns(DeprecationWarning, match="has moved") as found:
        import powderdsl.provenance  # noqa: F401
    assert [Path(one.filename) for one in found] == [Path(__file__)]


def test_from_the_package_itself() -> None:
    with pytest.warns(DeprecationWarning, match="has moved"):
        from powderdsl import provenance
    assert provenance.__name__ == "powderdsl.simulation.provenance"


def test_other_names_are_not_found() -> None:
    assert new_name("powderdsl.compiler") is None
    assert new_name("elsewhere.bench") is None
    with pytest.raises(ModuleNotFoundError, match=r"powderdsl\.benches"):
        import_module("powderdsl.benches")
    missing = pytest.raises(ModuleNotFoundError, match=r"powderdsl\.experiments\.bench\.nothing")
    with pytest.warns(DeprecationWarning, match="has moved"), missing:
        import_module("powderdsl.bench.nothing")


def test_an_old_name_loads_nothing_else() -> None:
    """Checking names must not cost an import: `import powderdsl` leaves moved modules alone."""
    code = "import sys, powderdsl; print(*[n for n in sys.modules if n.startswith('powderdsl.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["powderdsl.moved"]
