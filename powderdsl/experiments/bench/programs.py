"""Other programs for the same rules, in Python files of the user, measured beside the backends."""

from __future__ import annotations

import runpy
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

State = dict[str, NDArray[Any]]
"""The state of a batch: `element` as uint8 [N, H, W], fields as [N, H, W] or, vectors, [N, 2, H, W], by name."""
Run = Callable[[int], object]
"""Makes so many steps; the next call continues from there."""


@dataclass(frozen=True)
class Program:
    """A program that is measured beside the backends. `load` is not timed; what it returns is."""

    name: str
    load: Callable[[State], Run]


def read_program(path: Path) -> Program:
    """Run a Python file that defines `load(state)`, which returns `run(steps)`. Its name is the file's.

    The file is run as `python` would run it, so it has to be trusted.

    Raises:
        ValueError: the file cannot be run, or does not define `load`.
    """
    with _errors_of(path):
        load = runpy.run_path(str(path), run_name=f"beside_{path.stem}").get("load")
    if not callable(load):
        raise ValueError(f"{path}: does not define `load(state)`, which returns `run(steps)`")

    def start(state: State) -> Run:
        with _errors_of(path):
            run = load(state)
        if not callable(run):
            raise ValueError(f"{path}: `load(state)` does not return a function `run(steps)`")

        def guarded(steps: int) -> None:
            with _errors_of(path):
                run(steps)

        return guarded

    return Program(path.stem, start)


@contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """Name the line of the file that led to an exception."""
    try:
        yield
    except Exception as error:
        frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
        words = str(error)
        if isinstance(error, SyntaxError):
            frames, words = [(error.filename or "", error.lineno)], error.msg  # str() repeats file and line
        lines = [line for file, line in frames if Path(file).resolve() == path.resolve()]
        place = f"{path}:{lines[-1]}" if lines else str(path)
        raise ValueError(f"{place}: {type(error).__name__}: {words}") from error
