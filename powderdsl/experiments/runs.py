"""Folders of training runs, with `run.json`, which describes the run, checkpoints and metrics.

A killed process leaves a readable folder: checkpoints are written atomically, with their digest in the name.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from powderdsl.diagnostics import CompileError, suggest
from powderdsl.system.reading import check_links, open_regular, parse_json, read_bytes, read_json
from powderdsl.system.writing import failure, not_writable, replacing, write_text, writing

if TYPE_CHECKING:
    from torch import Tensor

ABOUT = "run.json"
PACKAGES = ("powderdsl", "torch", "numpy", "gymnasium", "stable-baselines3")
MAX_SLOTS = 256


# Checkpoints

NAME = re.compile(r"([0-9]{12})-([0-9a-f]{16})\.safetensors")
STATE = "state"
"""The tensor whose bytes are the state as JSON, in which names replace the other tensors."""

MAX_BYTES = 1 << 33


@dataclass(frozen=True)
class Checkpoint:
    """The state saved after `step` steps: nested dicts, lists and tuples of tensors, numbers, text and None."""

    step: int
    state: Any
    path: Path


def _packed(value: Any, tensors: dict[str, Tensor]) -> Any:
    """A state for JSON: values other than lists and plain values become pairs of kind and contents."""
    import torch

    match value:
        case torch.Tensor():
            name = str(len(tensors))
            # safetensors rejects tensors that share memory, as those of a network may.
            tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
            return {"tensor": name}
        case dict():
            return {"dict": [[key, _packed(item, tensors)] for key, item in value.items()]}
        case tuple():
            return {"tuple": [_packed(item, tensors) for item in value]}
        case list():
            return [_packed(item, tensors) for item in value]
    return value


def _unpacked(value: dict[str, Any], tensors: Mapping[str, Tensor]) -> Any:
    """Rebuild a value from its kind and unpacked contents."""
    match value:
        case {"tensor": name}:
            return tensors[name]
        case {"dict": pairs}:
            return dict(pairs)
        case {"tuple": items}:
            return tuple(items)
    raise ValueError(f"a value of an unknown kind: {value!r:.80}")


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


# Metrics

LINES = "metrics.jsonl"
MAX_LINE = 1 << 16
"""Maximum number of bytes of a line."""
T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""97.5 % quantiles of Student's t for 1 to 10 degrees of freedom, for which no short formula is exact enough."""


class Metrics:
    """Writes numbers by step. A context manager.

    The run continues at `step`; entries of later steps are dropped, so that a run killed after its last checkpoint does
    not write anything twice.
    """

    def __init__(self, folder: Path, step: int = 0):
        self._lines = folder / LINES
        lines = [json.dumps(line) for line in read_metrics(folder) if line["step"] <= step]
        with replacing(self._lines) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        self._file = self._lines.open("a", encoding="utf-8")
        self._events = None
        with suppress(ImportError):  # without TensorBoard, the lines have the same numbers
            from torch.utils.tensorboard import SummaryWriter

            self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers by name, such as ``loss/train``, after `step` steps. Lines omit those that are not finite."""
        numbers = {name: float(value) for name, value in values.items()}
        finite = {name: value for name, value in numbers.items() if math.isfinite(value)}
        with writing(self._lines):
            self._file.write(json.dumps({"step": step, **finite}) + "\n")
            self._file.flush()
            if self._events is not None:
                for name, value in numbers.items():
                    self._events.add_scalar(name, value, step)

    def __enter__(self) -> Metrics:
        return self

    def __exit__(self, *error: object) -> None:
        with writing(self._lines):
            self._file.close()
            if self._events is not None:
                self._events.close()


def read_metrics(folder: Path) -> Iterator[dict[str, Any]]:
    """The lines of a run, each with ``step``, without an incomplete last line."""
    with suppress(FileNotFoundError), open_regular(folder / LINES) as file:
        for text in iter(lambda: file.readline(MAX_LINE), b""):
            with suppress(ValueError):
                line = parse_json(text)
                if isinstance(line, dict) and isinstance(line.get("step"), int):
                    yield line


@dataclass(frozen=True)
class Estimate:
    """A mean, and half of its 95 % interval; None for a single value."""

    mean: float
    interval: float | None

    def __iter__(self) -> Iterator[Any]:
        return iter((self.mean, self.interval))

    def __str__(self) -> str:
        return f"{self.mean:.3f}" + ("" if self.interval is None else f" ± {self.interval:.3f}")


def mean_and_interval(values: Sequence[float]) -> Estimate:
    """The mean, and half of its 95 % interval by Student's t."""
    mean, freedom = statistics.fmean(values), len(values) - 1
    if freedom < 1:
        return Estimate(mean, None)
    # Beyond the table, use the Cornish-Fisher expansion, exact to four digits.
    expansion = 1.95996 + 2.37227 / freedom + 2.8225 / freedom**2 + 2.5557 / freedom**3
    quantile = T_975[freedom - 1] if freedom <= len(T_975) else expansion
    return Estimate(mean, quantile * statistics.stdev(values) / math.sqrt(len(values)))


# Folders


@dataclass(frozen=True)
class RunFolder:
    """A folder of one training run.

    `kind` is what was trained; `config` has all its settings, as JSON; `about` is the whole of ``run.json``, including
    versions.
    """

    path: Path
    kind: str
    config: Mapping[str, Any]
    about: Mapping[str, Any]

    def latest_checkpoint(self) -> Checkpoint | None:
        """The newest checkpoint with a correct digest, with its tensors on the CPU, or None. Damaged ones are skipped.

        Loading executes nothing: only tensors and plain values are read, and they take no more memory than the file.
        Raises CompileError (PD620) for an intact file that is not a checkpoint.
        """
        for step, digest, path in self._checkpoints():
            try:
                data = read_bytes(path, MAX_BYTES)
            except OSError:
                continue
            if _digest(data) == digest:
                try:
                    from safetensors.torch import load

                    tensors = load(data)
                    state = parse_json(
                        bytes(tensors[STATE].numpy()), hook=partial(_unpacked, tensors=tensors)
                    )
                    return Checkpoint(step, state, path)
                except ModuleNotFoundError:  # no safetensors
                    raise
                except Exception as error:  # a crafted file can raise any exception
                    why = (str(error).strip().partition("\n")[0] or type(error).__name__)[:300]
                    raise failure("PD620", f"{path} is not a checkpoint of a run", notes=(why,)) from None
        return None

    def checkpoint(self) -> Checkpoint:
        """The newest intact checkpoint. Raises CompileError (PD620) if there is none."""
        checkpoint = self.latest_checkpoint()
        if checkpoint is None:
            raise not_a_run(self.path, "it has no readable checkpoint")
        return checkpoint

    def save_checkpoint(self, step: int, state: Any) -> Path:
        """Save nested dicts, lists and tuples of tensors, numbers, text and None, and remove older checkpoints but one.

        Raises CompileError (PD613) if the folder cannot be written to.
        """
        import torch
        from safetensors.torch import save

        tensors: dict[str, Tensor] = {}
        text = json.dumps(_packed(state, tensors)).encode()
        data = save({**tensors, STATE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})
        path = self.path / "checkpoints" / f"{step:012d}-{_digest(data)}.safetensors"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(data)
        others = [(number, other) for number, _, other in self._checkpoints() if other != path]
        before = next((other for number, other in others if number < step), None)
        for _, other in others:
            # Later ones are from a run that had to go back, and must not be considered newer.
            if other != before:
                other.unlink(missing_ok=True)
        return path

    def _checkpoints(self) -> list[tuple[int, str, Path]]:
        """Step, digest and path of all checkpoints, the newest first."""
        paths = sorted((self.path / "checkpoints").glob("*"), reverse=True)
        matches = [(NAME.fullmatch(path.name), path) for path in paths]
        return [(int(match[1]), match[2], path) for match, path in matches if match]


def open_run(
    path: str | Path, kind: str, config: Mapping[str, Any], *, note: Mapping[str, Any] | None = None
) -> RunFolder:
    """Begin a run, or resume it with the same configuration.

    `config`: values for JSON. `note`: further entries of ``run.json``, which are not compared. Raises CompileError:
    PD621 if the folder contains another run or other files, PD620 if its ``run.json`` is damaged, PD613 if it cannot be
    written.
    """
    folder, plain = Path(path), json.loads(json.dumps(config))
    if (folder / ABOUT).exists():
        run = read_run(folder)
        notes = differences({"kind": run.kind}, {"kind": kind}) or differences(run.config, plain)
        if notes:
            helps = ("choose another folder with `--run`, or continue with that run's own settings",)
            raise failure("PD621", f"{folder} holds another run", notes=notes, helps=helps)
        return run
    new_folder(folder)
    versions = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    about = {"kind": kind, "config": plain, **(note or {}), "versions": versions}
    write_json(folder / ABOUT, about)
    return read_run(folder, kind)


@contextmanager
def lock_folder(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Lock a folder against other processes, after waiting for them for up to `patience` seconds.

    The lock of a process ends with it. Raises CompileError: PD622 if another process has it, PD613 if the
    folder cannot be written to.
    """
    check_folder(folder)
    with ExitStack() as stack:
        try:
            stack.enter_context(FileLock(folder / ".lock", timeout=patience))
        except Timeout:
            helps = ("wait for it, or choose another folder",)
            raise failure("PD622", f"another process works on {folder}", helps=helps) from None
        except OSError as error:
            raise not_writable(folder, error) from None
        yield


def new_folder(folder: Path) -> None:
    """Create a folder for output, unless it exists and is empty.

    Raises CompileError: PD621 if it contains files, PD613 if it cannot be created.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        others = sorted(name for name in os.listdir(folder) if not name.startswith("."))
    if others:
        notes, helps = (f"such as {others[0]}",), ("choose a folder that is empty or does not exist",)
        raise failure("PD621", f"{folder} holds other files", notes=notes, helps=helps)


def read_run(path: str | Path, kind: str | None = None) -> RunFolder:
    """An existing run. Raises CompileError (PD620) if there is none, it is damaged, or its kind is not `kind`."""
    folder = Path(path)
    if not (folder / ABOUT).exists():
        raise not_a_run(folder, f"it has no {ABOUT}" if folder.is_dir() else "there is no such folder")
    check_folder(folder)
    match about := read_json(folder / ABOUT):
        case {"kind": str(found), "config": dict(config)}:
            if kind not in (None, found):
                raise not_a_run(folder, f"it is a run of the kind `{found}`; `{kind}` is needed here")
            return RunFolder(folder, found, config, about)
    raise not_a_run(folder, f"its {ABOUT} is damaged")


def find_run(text: str | Path | RunFolder, kind: str | None = None) -> RunFolder:
    """A run by the path of its folder, or by its name in ``runs/``. Raises CompileError (PD620)."""
    if isinstance(text, RunFolder):
        return text
    folder, usual = Path(text), Path("runs")
    if not folder.exists() and folder.name == str(text) and usual.is_dir():
        if (usual / text / ABOUT).exists():
            return read_run(usual / text, kind)
        names = sorted(about.parent.name for about in usual.glob(f"*/{ABOUT}"))
        raise not_a_run(folder, "there is no such folder", suggest(str(text), names, "runs"))
    return read_run(folder, kind)


def check_folder(folder: Path) -> None:
    """Reject an untrusted folder with links that lead out of it. Raises CompileError (PD112)."""
    try:
        check_links(folder)
    except OSError as error:
        helps = ("move what it leads to into the folder; the folder itself may be a link",)
        raise failure("PD112", f"{error.filename}: {error.strerror}", helps=helps) from None


def misfit(folder: Path, *why: str, helps: tuple[str, ...] = ()) -> CompileError:
    """The error for a run whose model or data does not fit (PD623)."""
    return failure("PD623", f"{folder} does not fit", notes=why, helps=helps)


@contextmanager
def reporting_misfits(path: Path, what: str) -> Iterator[None]:
    """Report errors of the block, which loads a checkpoint with any contents into a model, as PD623."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError, AttributeError, LookupError) as error:
        raise misfit(path, f"{what}: {' '.join(str(error).split())[:300]}") from None


def not_a_run(folder: Path, why: str, helps: tuple[str, ...] = ()) -> CompileError:
    """The error for a folder that is not a usable run (PD620)."""
    return failure("PD620", f"{folder} is not a run that can be used here", notes=(why,), helps=helps)


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, atomically. Raises CompileError (PD613)."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[str, ...]:
    """The differing settings, at most thirty, by dotted names, each with both values."""
    there, here = _flat(there), _flat(here)
    names = [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    return tuple(
        f"`{name}` is {there.get(name, 'not set'):.80} there, {here.get(name, 'not set'):.80} here"
        for name in names[:30]
    )


def _flat(config: Mapping[str, Any], within: str = "") -> dict[str, str]:
    """Each setting by its dotted name, as JSON."""
    settings: dict[str, str] = {}
    for name, value in config.items():
        if isinstance(value, Mapping) and value:
            settings |= _flat(value, f"{within}{name}.")
        else:
            settings[within + name] = json.dumps(value, ensure_ascii=False)
    return settings


# Palettes: the qualified name of the element of each slot of a run's network, or None for a free slot


def recorded_palette(run: RunFolder) -> tuple[str | None, ...]:
    """The palette of a run. Raises CompileError (PD620) if it is damaged."""
    palette = run.config.get("palette")
    if not isinstance(palette, list) or not 1 <= len(palette) <= MAX_SLOTS:
        raise not_a_run(run.path, "it has no palette that a network can have")
    return tuple(None if name is None else str(name) for name in palette)


def check_palette(
    folder: Path, palette: Sequence[str | None], elements: Mapping[int, str], *helps: str
) -> None:
    """Compare the slots of a run's network with the elements of some rules, qualified names by id.

    Raises CompileError (PD623) with every element without a slot, or whose slot belongs to another. `helps` are for the
    first.
    """
    why, lacking = [], 0
    for number, name in elements.items():
        if number >= len(palette):
            lacking += 1
            why.append(f"there is no free slot for `{name}`: the network has {len(palette)}")
        elif palette[number] not in (None, name):
            why.append(f"id {number} is `{palette[number]}` there, `{name}` here")
    if why:
        more = f"train with `--slots {len(palette) + lacking}` to leave room for packs added later"
        raise misfit(folder, *why, helps=(more, *helps) if lacking else ())
