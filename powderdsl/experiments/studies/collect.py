"""Results of one study that lie in several folders -> one list of outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from powderdsl.diagnostics import Reporter, Source
from powderdsl.experiments.runs.folder import check_folder, no_run
from powderdsl.experiments.studies.file import Commands, read_study
from powderdsl.experiments.studies.run import ABOUT_STUDY, Outcome, StudyRun
from powderdsl.experiments.studies.study import SIZES, Point, Study
from powderdsl.system.reading import read_json
from powderdsl.system.writing import failure


def read_folders(folders: Sequence[Path], commands: Commands) -> list[StudyRun]:
    """The studies whose results lie in some folders. No file but theirs is read, and none is written.

    Raises:
        CompileError: PD620 if a folder has no results, PD621 if they are not results of one study, PD112 if it has links
            that lead out of it, and all that is wrong with the study's text.
    """
    runs = [_read(folder, commands) for folder in folders]
    first = runs[0]
    for one in runs[1:]:
        if one.size != first.size or _bare(one.study) != _bare(first.study):
            raise failure(
                "PD621",
                f"{one.folder} and {first.folder} hold results of different studies",
                notes=(
                    f"`{one.study.name}` of the size `{one.size}`, `{first.study.name}` of `{first.size}`",
                ),
                helps=("if the file has changed in between, run the study in both folders again",),
            )
    return runs


def collected(runs: Sequence[StudyRun], points: Sequence[Point]) -> list[Outcome]:
    """The outcome of each point, from the folders that have it; the problem where none has it.

    Raises:
        CompileError: PD627 if folders have different results of a point.
    """
    return [_outcome(runs, point) for point in points]


def _outcome(runs: Sequence[StudyRun], point: Point) -> Outcome:
    found = [(run.folder, outcome) for run in runs if (outcome := run.finished(point)) is not None]
    good = [(folder, outcome) for folder, outcome in found if outcome.problem is None]
    if not good:
        return found[0][1] if found else Outcome(point, {}, "not done in any of these folders")
    folder, outcome = good[0]
    for other, another in good[1:]:
        if another != outcome:
            raise failure(
                "PD627",
                f"{folder} and {other} have different results of {point.name}",
                notes=(f"{folder}: {_told(outcome)}", f"{other}: {_told(another)}"),
                helps=(f"remove done/{point.name}.json from one of them, or leave that folder out",),
            )
    return outcome


def _told(outcome: Outcome) -> str:
    return ", ".join(f"{name} {value!r}" for name, value in outcome.values.items())


def _read(folder: Path, commands: Commands) -> StudyRun:
    kept = folder / ABOUT_STUDY
    if not kept.exists():
        why = f"it has no {ABOUT_STUDY}" if folder.is_dir() else "there is no such folder"
        raise no_run(folder, why, ("give folders of results, those that `powderdsl study --out` named",))
    damaged = no_run(folder, f"its {ABOUT_STUDY} is damaged")
    found = read_json(kept)
    if not isinstance(found, dict) or not _is_text(found.get("text")) or found.get("size") not in SIZES:
        raise damaged
    check_folder(folder)
    source = Source(str(folder / ABOUT_STUDY), found["text"])
    run = StudyRun(read_study(source, Reporter(), commands), folder, found["size"])
    if not run.is_prepared():
        raise damaged
    return run


def _is_text(value: object) -> bool:
    """Whether a value of a JSON file can be the text of a file: JSON also has halves of characters."""
    try:
        return isinstance(value, str) and bool(value.encode())
    except UnicodeEncodeError:
        return False


def _bare(study: Study) -> Study:
    """A study without where it was written, and how."""
    return replace(study, text="", folder=Path())
