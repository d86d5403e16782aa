"""`powderdsl schema`: the JSON Schema of all files, for editors."""

from __future__ import annotations

import json
from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.system.writing import write_text


@click.command("schema")
@opt.output("--out", "FILE", "The .json file to write instead of printing it.", ".json")
def command(out: Path | None) -> None:
    """Print the JSON Schema of rule files, tasks, scenes and studies.

    With it, editors that use yaml-language-server complete, explain and check keys in files with the line `#
    yaml-language-server: $schema=powderdsl.schema.json`.
    """
    from powderdsl.editing.json_schema import schema

    text = json.dumps(schema(), indent=1) + "\n"
    if out is not None:
        write_text(out, text)
    else:
        click.echo(text, nl=False)
