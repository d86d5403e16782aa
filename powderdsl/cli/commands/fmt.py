"""`powderdsl fmt`: format rule files, tasks, scenes and studies."""

from __future__ import annotations

from difflib import unified_diff
from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK
from powderdsl.system.writing import write_text


@click.command("fmt")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
@opt.option("--check", bool, "Write nothing; exit with 1 if a file would change.")
@opt.option("--diff", bool, "Write nothing; print what would change.")
def command(files: tuple[Path, ...], check: bool, diff: bool) -> int:
    """Format powderdsl's YAML files: indentation, spaces and blank lines.

    Comments and the meaning of a file are unchanged. Prints the names of changed files.

    Exit code: 0; 1 with --check or --diff if a file would change; 2 if a file cannot be read.
    """
    from powderdsl.diagnostics import Reporter
    from powderdsl.editing.layout import formatted
    from powderdsl.syntax.sources import read_source

    reporter, changed = Reporter(), False
    for path in files:
        source = read_source(path, reporter)
        text = formatted(source, reporter) if source is not None else None
        if source is None or text is None or text == source.text:
            continue
        changed = True
        if diff:
            old, new = source.text.splitlines(keepends=True), text.splitlines(keepends=True)
            click.echo("".join(unified_diff(old, new, str(path), str(path))), nl=False)
        else:
            click.echo(path)
        if not check and not diff:
            write_text(path, text)
    reporter.raise_if_errors()
    return FAILED if changed and (check or diff) else OK
