"""What all tests share: tiers, golden files, one thread for torch, and processes that Ctrl-C reaches."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import wheels

# Before torch is imported anywhere: tests run in several processes; small tensors gain nothing from threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell starts `make test &` with SIGINT ignored, and processes hand that on to those that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write golden files again instead of comparing with them"
    )
    parser.addoption("--slow", action="store_true", help="also run the tests that are marked `slow`")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave slow tests out, unless ``--slow``, ``-m slow`` or the id of a test selects them.

    Wheels come first: each takes a minute, for which another process would have nothing to do at the end.
    """
    items.sort(key=lambda item: item.get_closest_marker("wheel") is None)
    if config.getoption("--slow") or "slow" in config.getoption("-m"):
        return
    ids = tuple(argument for argument in config.args if "::" in argument)
    slow = {item for item in items if item.get_closest_marker("slow") and not item.nodeid.startswith(ids)}
    if slow:
        config.hook.pytest_deselected(items=[item for item in items if item in slow])
        items[:] = [item for item in items if item not in slow]


@pytest.fixture(scope="session", autouse=True)
def _compiled_once() -> Iterator[None]:
    """Rules that tests load again are neither checked nor lowered again."""
    from tests.models import compiled_once  # late: the wheel tests begin without the compiler

    with compiled_once():
        yield


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the repository as it is now, built once for all processes of a run."""
    (built,) = wheels.once(tmp_path_factory, "wheel", wheels.build_wheel).glob("*.whl")
    return built


@pytest.fixture(scope="session")
def scripts(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scripts of a fresh environment with the wheel in it. Nothing is installed there later."""
    home = wheels.once(tmp_path_factory, "environment", lambda folder: wheels.install_wheel(wheel, folder))
    return wheels.scripts_of(home)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: an empty one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Callable[[Path, str], None]:
    """Compares a text with a checked-in file, or writes that file under ``--update-golden``."""
    update = request.config.getoption("--update-golden")

    def compare(path: Path, text: str) -> None:
        if update:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{os.getpid()}")
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(path)
            return
        assert path.is_file(), f"{path} is missing: run `make golden` and read what it wrote"
        assert text == path.read_text(encoding="utf-8")

    return compare


@pytest.fixture(scope="session")
def torch():  # type: ignore[no-untyped-def]  # torch is only imported by tests that ask for it
    """The torch module, held to one thread."""
    module = pytest.importorskip("torch")
    module.set_num_threads(1)
    return module
