"""`powderdsl explain`: the page of a diagnostic code, or the list of all codes."""

from __future__ import annotations

import sys

import click

from powderdsl.cli.exits import BadInput
from powderdsl.cli.output import color_wanted
from powderdsl.diagnostics.codes import CODES, find_code, page, similar
from powderdsl.diagnostics.printable import raw_stream

PAGE_WIDTH = 100


@click.command("explain")
@click.argument("code", required=False)
def command(code: str | None) -> None:
    """Explain a diagnostic code and how to fix it.

    CODE is a code such as PD301 or a name such as unknown-name. Without CODE, list all codes.
    """
    if code is None:
        for row in CODES.values():
            click.echo(f"{row.code}  {row.severity.value:<7}  {row.slug}")
        return
    entry = find_code(code)
    if entry is None:
        close = similar(code)
        fix = f"did you mean {', '.join(close)}?" if close else "`powderdsl explain` lists all codes"
        raise BadInput(f"no code `{code}`; {fix}")
    text = page(entry)
    if not color_wanted(sys.stdout):
        click.echo(text.rstrip("\n"))
        return
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console(file=raw_stream(sys.stdout))  # our own pages
    console.print(Markdown(text), width=min(console.width, PAGE_WIDTH))
