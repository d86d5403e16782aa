"""A run's folder: `run.json` describes the run; checkpoints and metrics have its progress."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from powderdsl.diagnostics import CompileError, suggest
from powderdsl.experiments.runs.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from powderdsl.experiments.runs.metrics import Metrics
from powderdsl.system.reading import check_links, read_json
from powderdsl.system.writing import failure, not_writable, write_text

ABOUT = "run.json"
PACKAGES = ("torch", "numpy", "gymnasium", "stable-baselines3")
MAX_SLOTS = 256


@dataclass(frozen=True)
class RunFolder:
    """A folder of one training run.

    `kind` is what was trained; `config` all that decides how, as JSON has it; `about` the whole of ``run.json``: also
    versions, the command line and the time when it began.
    """

    path: Path
    kind: str
    config: Mapping[str, Any]
    about: Mapping[str, Any]

    def locked(self) -> AbstractContextManager[None]:
        """Keep other processes from training here, which get a CompileError (PD622)."""
        return held(self.path)

    def latest_checkpoint(self) -> Checkpoint | None:
        """The newest intact checkpoint, with its tensors on the CPU, or None."""
        return latest_checkpoint(self.path / "checkpoints")

    def checkpoint(self) -> Checkpoint:
        """The newest intact checkpoint. Raises CompileError (PD620) if there is none."""
        found = self.latest_checkpoint()
        if found is None:
            raise no_run(self.path, "it has no checkpoint that can be read")
        return found

    def save_checkpoint(self, step: int, state: Any) -> Path:
        """Save nested dicts, lists and tuples of tensors, numbers, text and None. Raises CompileError (PD613)."""
        return save_checkpoint(self.path / "checkpoints", step, state)

    def metrics(self, step: int = 0) -> Metrics:
        """Where to write numbers from `step` on; those of later steps are dropped."""
        return Metrics(self.path, step)

    def write_json(self, name: str, value: Any) -> Path:
        """Write a file of the folder whole or not at all."""
        return write_json(self.path / name, value)

    def read_json(self, name: str) -> Any:
        """A file of the folder; None if there is none or it is damaged."""
        return read_json(self.path / name)


def open_run(
    path: str | Path, kind: str, config: Mapping[str, Any], *, note: Mapping[str, Any] | None = None
) -> RunFolder:
    """Begin a run, or resume it with the same configuration.

    Args:
        config: what JSON can hold. note: more to keep in ``run.json``, which takes no part in the comparison.

    Raises:
        CompileError: PD621 where the folder holds another run, or other files; PD620 where its ``run.json`` is damaged;
            PD613 where nothing can be written.
    """
    folder, plain = Path(path), json.loads(json.dumps(config))
    if (folder / ABOUT).exists():
        found = read_run(folder)
        differences = _differences(found, kind, plain)
        if differences:
            raise failure(
                "PD621",
                f"{folder} holds another run",
                notes=differences,
                helps=("choose another folder with `--run`, or continue with that run's own settings",),
            )
        return found
    new_folder(folder)
    about = {
        "kind": kind,
        "config": plain,
        **(note or {}),
        "versions": versions(),
        "command": sys.argv,
        "began": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_json(folder / ABOUT, about)
    return read_run(folder, kind)


@contextmanager
def held(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Keep other processes from writing to a folder. The lock of a process that dies is gone with it.

    Args:
        patience: seconds to wait for another process.

    Raises:
        CompileError: PD622 if another one does; PD613 if the folder cannot be written to.
    """
    check_folder(folder)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=patience)
    except Timeout:
        raise failure(
            "PD622",
            f"another process works on {folder}",
            helps=("wait for it, or choose another folder",),
        ) from None
    except OSError as error:
        raise not_writable(folder, error) from None
    try:
        yield
    finally:
        lock.release()


def new_folder(folder: Path) -> None:
    """Make a folder for something that will be written there, unless it is there and empty.

    Raises:
        CompileError: PD621 where it holds files; PD613 where it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        others = sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except OSError as error:
        raise not_writable(folder, error) from None
    if others:
        raise failure(
            "PD621",
            f"{folder} holds other files",
            notes=(f"such as {others[0]}",),
            helps=("choose a folder that is empty or not there yet",),
        )


def read_run(path: str | Path, kind: str | None = None) -> RunFolder:
    """An existing run.

    Raises:
        CompileError: PD620 if there is none, it is damaged, or of another kind than `kind`.
    """
    folder = Path(path)
    if not (folder / ABOUT).exists():
        raise no_run(folder, f"it has no {ABOUT}" if folder.is_dir() else "there is no such folder")
    check_folder(folder)
    about = read_json(folder / ABOUT)
    whole = isinstance(about, dict) and isinstance(about.get("kind"), str)
    if not whole or not isinstance(about.get("config"), dict):
        raise no_run(folder, f"its {ABOUT} is damaged")
    if kind is not None and about["kind"] != kind:
        raise no_run(folder, f"it is a run of the kind `{about['kind']}`; `{kind}` is needed here")
    return RunFolder(folder, about["kind"], about["config"], about)


def find_run(text: str | Path, kind: str | None = None) -> RunFolder:
    """A run by the path of its folder, or by its name in ``runs/``. Raises CompileError (PD620)."""
    folder, kept = Path(text), Path("runs")
    if not folder.exists() and folder.name == str(text) and kept.is_dir():
        if (kept / text / ABOUT).exists():
            return read_run(kept / text, kind)
        names = sorted(one.parent.name for one in kept.glob(f"*/{ABOUT}"))
        raise no_run(folder, "there is no such folder", suggest(str(text), names, "runs"))
    return read_run(folder, kind)


def check_folder(folder: Path) -> None:
    """Refuse a folder that may come from a stranger and has links that lead out of it. Raises CompileError (PD112)."""
    try:
        check_links(folder)
    except OSError as error:
        helps = ("move what it leads to into the folder; the folder itself may be a link",)
        raise failure("PD112", f"{error.filename}: {error.strerror}", helps=helps) from None


def does_not_fit(folder: Path, *why: str, helps: tuple[str, ...] = ()) -> CompileError:
    """The error for a run whose model or data was made for something else (PD623)."""
    return failure("PD623", f"{folder} does not fit", notes=why, helps=helps)


@contextmanager
def fitting(path: Path, what: str) -> Iterator[None]:
    """Report what raises where a checkpoint, which may hold anything, is given to a model (PD623)."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError, AttributeError, LookupError) as error:
        raise does_not_fit(path, f"{what}: {' '.join(str(error).split())[:300]}") from None


def no_run(folder: Path, why: str, helps: tuple[str, ...] = ()) -> CompileError:
    """The error for a folder that is not a run, or one that cannot be used (PD620)."""
    return failure("PD620", f"{folder} is not a run that can be used here", notes=(why,), helps=helps)


def versions() -> dict[str, str]:
    """Versions that a run's numbers may depend on: Python, the system, and installed packages."""
    known = {
        "powderdsl": str(sys.modules["powderdsl"].__version__),  # our own package, so it has been imported
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            known[name] = metadata.version(name)
    return known


def write_json(path: Path, value: Any, *, follow: bool = False) -> Path:
    """Write a file whole or not at all. `follow`: write to where a link leads. Raises CompileError (PD613)."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n", follow=follow)
    return path


def _differences(found: RunFolder, kind: str, config: Mapping[str, Any]) -> tuple[str, ...]:
    if found.kind != kind:
        return (f"it is of the kind `{found.kind}`, not `{kind}`",)
    there, here = _flat(found.config), _flat(config)
    return tuple(
        f"`{name}` is {there.get(name, 'not set')} there, {here.get(name, 'not set')} here"
        for name in sorted({*there, *here})
        if there.get(name) != here.get(name)
    )


def _flat(config: Mapping[str, Any], within: str = "") -> dict[str, str]:
    """Each setting by its dotted name, as JSON."""
    settings: dict[str, str] = {}
    for name, value in config.items():
        is_group = isinstance(value, Mapping) and value
        settings |= _flat(value, f"{within}{name}.") if is_group else {within + name: json.dumps(value)}
    return settings


# Palettes: the qualified name of the element of each slot of a run's network, or None for a free slot


def recorded_palette(run: RunFolder) -> tuple[str | None, ...]:
    """The palette of a run. Raises CompileError (PD620) if it is damaged."""
    palette = run.config.get("palette")
    if not isinstance(palette, list) or not 1 <= len(palette) <= MAX_SLOTS:
        raise no_run(run.path, "it has no palette that a network can have")
    return tuple(None if name is None else str(name) for name in palette)


def check_palette(
    folder: Path, palette: Sequence[str | None], elements: Mapping[int, str], *helps: str
) -> None:
    """Compare the slots of a run's network with the elements of some rules, qualified names by id.

    Raises:
        CompileError: PD623, with every element that has no slot, or whose slot is another's. `helps` are for the first.
    """
    why, lacking = [], 0
    for number, name in elements.items():
        if number >= len(palette):
            lacking += 1
            why.append(f"there is no free slot for `{name}`: the network has {len(palette)}")
        elif palette[number] not in (None, name):
            why.append(f"id {number} is `{palette[number]}` there, `{name}` here")
    if why:
        more = f"train with `--slots {len(palette) + lacking}` to leave room for packs that come later"
        raise does_not_fit(folder, *why, helps=(more, *helps) if lacking else ())
