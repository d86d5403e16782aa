"""Results of one study that lie in several folders -> one list of outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from powderdsl.diagnostics import Reporter, Source
from powderdsl.experiments.runs.folder import check_folder, no_run
from powderdsl.experiments.studies.run import ABOUT_STUDY, Outcome, StudyRun
from powderdsl.experiments.studies.study import SIZES, Commands, Point, read_study
from powderdsl.system.reading import read_json
from powderdsl.system.writing import failure


def read_folders(folders: Sequence[Path], commands: Commands) -> list[StudyRun]:
    """The studies whose results lie in some folders. No other file is read, and none is written.

    Raises:
        CompileError: PD620 if a folder has no results, PD621 if they are not results of one study, PD112 if it has links
            that lead out of it, and all that is wrong with the study's text.
    """
    runs = [_read(folder, commands) for folder in folders]
    first = runs[0]
    for run in runs[1:]:
        if run.size != first.size or run.study.source.text != first.study.source.text:
            raise failure(
                "PD621",
                f"{run.folder} and {first.folder} hold results of different studies",
                notes=(f"`{run.study.name}` ({run.size}), `{first.study.name}` ({first.size})",),
                helps=("if the file has changed in between, run the study in both folders again",),
            )
    return runs


def collected(runs: Sequence[StudyRun], point: Point) -> Outcome:
    """The outcome of a point, from the folders that have it; the problem where none has it.

    Raises:
        CompileError: PD627 if folders have different results.
    """
    outcomes = {run.folder: outcome for run in runs if (outcome := run.finished(point)) is not None}
    good = {folder: outcome for folder, outcome in outcomes.items() if outcome.problem is None}
    if not good:
        return next(iter(outcomes.values()), Outcome(point, {}, "not done in any of these folders"))
    (folder, first), *others = good.items()
    for other, outcome in others:
        if outcome != first:
            raise failure(
                "PD627",
                f"{folder} and {other} have different results of {point.name}",
                notes=(f"{folder}: {dict(first.values)}", f"{other}: {dict(outcome.values)}"),
                helps=(f"remove done/{point.name}.json from one of them, or leave that folder out",),
            )
    return first


def _read(folder: Path, commands: Commands) -> StudyRun:
    path = folder / ABOUT_STUDY
    if not path.exists():
        why = f"it has no {ABOUT_STUDY}" if folder.is_dir() else "there is no such folder"
        raise no_run(folder, why, ("give folders of results, those that `powderdsl study --out` named",))
    check_folder(folder)
    about = read_json(path)
    text, size = (about.get("text"), about.get("size")) if isinstance(about, dict) else (None, None)
    if isinstance(text, str) and size in SIZES:
        run = StudyRun(read_study(Source(str(path), text), Reporter(), commands), folder, str(size))
        if run.is_prepared():
            return run
    raise no_run(folder, f"its {ABOUT_STUDY} is damaged")
