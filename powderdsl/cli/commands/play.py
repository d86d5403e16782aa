"""`powderdsl play`: the playground, a page where worlds are painted and rules rewritten."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.model.types import Ruleset

if TYPE_CHECKING:
    from powderdsl.web.site import Site


@click.command("play")
@click.argument("rules", metavar="[RULES]", required=False)
@opt.world
@opt.option("--port", (0, 65535), "Port of the server; 0 for any.", 0)
@opt.option("--no-open", bool, "Do not open a browser.")
@opt.path("--export", "DIR", "Write the page as a folder for any web server, and exit.")
@opt.parameters
def command(
    rules: str | None,
    world: str | None,
    port: int,
    no_open: bool,
    export: Path | None,
    settings: dict[str, str],
) -> None:
    """Open a page to paint and run worlds, and to change their rules while they run.

    The page is served on this machine only. It runs in the browser: nothing is sent anywhere.
    """
    from powderdsl.web.site import PARTS, Entry, Site

    if not PARTS.is_dir():
        raise BadInput(
            "this installation lacks Pyodide and the editor, which the page needs: run `make web` in a clone of the "
            "repository, then `powderdsl play` there, or `make wheel` for a wheel that has them"
        )
    if rules is None and (world or settings):
        raise BadInput("--world and --set need RULES")
    first = None
    if rules is not None:
        ruleset = opt.load_rules(rules, settings)
        key = re.sub(r"[^A-Za-z0-9]+", "-", ruleset.name).strip("-") or "rules"
        start = None if world is None else _start(ruleset, world)
        first = Entry(key, (rules,), settings, start)
    site = Site(first)
    if export is not None:
        click.echo(f"{export}: {site.write(export)} files")
    else:
        _serve(site, port, not no_open)


def _start(ruleset: Ruleset, world: str) -> dict[str, Any]:
    """The user's start world, as the page reads worlds."""
    from powderdsl.cli.start_worlds import start
    from powderdsl.web.worlds import world_data

    first = start(ruleset, world, None, None, None)
    state = {name: value[0].cpu().numpy() for name, value in first.state.items()}
    ids = state.pop("element")
    clock = int(first.seed[0]), int(first.index[0]), int(first.step[0])
    return {"name": Path(world).name, "about": ""} | world_data(ruleset, ids, state, clock)


def _serve(site: Site, port: int, opens: bool) -> None:
    import webbrowser

    from powderdsl.web.server import SiteServer

    try:
        server = SiteServer(site, port)
    except OSError as error:
        raise BadInput(f"port {port} cannot be used: {error.strerror}; choose another --port") from None
    click.echo("compiling the first world", err=True)
    for path in ("catalog.json", site.start):
        site.read(path)
    click.echo(f"{server.address}  (Ctrl+C ends it)")
    if opens:
        webbrowser.open(server.address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        click.echo("", err=True)
    finally:
        server.server_close()
