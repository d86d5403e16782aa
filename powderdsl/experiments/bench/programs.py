"""Other programs for the same rules, in Python files of the user, measured beside the backends."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
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
    """Import a Python file that defines `load(state)`, which returns `run(steps)`. Its name is the file's.

    The file is run as `python` would run it, so it has to be trusted.

    Raises:
        ValueError: the file cannot be imported, or does not define `load`.
    """
    with _errors_of(path):
        spec = spec_from_file_location(f"beside_{path.stem}", path)
        if path.suffix != ".py" or spec is None or spec.loader is None:
            raise ValueError(f"{path}: not a Python file")
        module = module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look their own module up
        spec.loader.exec_module(module)
    load = getattr(module, "load", None)
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
        found: list[tuple[str | None, int | None]] = [
            (frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)
        ]
        if isinstance(error, SyntaxError):
            found = [(error.filename, error.lineno)]
            error = SyntaxError(error.msg)  # the full one repeats file and line
        lines = [line for file, line in found if file and Path(file).resolve() == path.resolve()]
        if not lines and isinstance(error, ValueError):
            raise
        place = f"{path}:{lines[-1]}" if lines else str(path)
        raise ValueError(f"{place}: {type(error).__name__}: {error}") from error
