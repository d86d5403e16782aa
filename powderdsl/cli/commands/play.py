"""`powderdsl play`: the playground, a page to paint worlds and edit rules."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput

if TYPE_CHECKING:
    from powderdsl.web.site import Site


@click.command("play")
@click.argument("rules", metavar="[RULES]", required=False)
@opt.world
@opt.option("--port", (0, 65535), "Port of the server; 0 for any.  [default: 8372 if it is free]")
@opt.option("--no-open", bool, "Do not open a browser.")
@opt.path("--export", "DIR", "Write the page as a folder for any web server, and exit.")
@opt.parameters
def command(
    rules: str | None,
    world: str | None,
    port: int | None,
    no_open: bool,
    export: Path | None,
    settings: dict[str, str],
) -> None:
    """Open a page to paint worlds and change their rules while they run.

    The page is served only on this machine and runs in the browser: it sends no data anywhere.
    """
    from powderdsl.web.site import PARTS, OfferedRules, Site

    if not (PARTS / "editor.js").is_file():
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
        start = None
        if world is not None:
            from powderdsl.cli.start_worlds import start as begin
            from powderdsl.worlds.store import first_world_data

            drawn = first_world_data(begin(ruleset, world, None, None, None))
            start = {"name": Path(world).name, "about": "", **drawn}
        first = OfferedRules(key, (rules,), settings, start)
    site = Site(first, offline=export is not None)
    if export is not None:
        click.echo(f"{export}: {site.write(export)} files")
    else:
        _serve(site, port, not no_open)


PORT = 8372
"""The preferred port: browsers store work by address, port included."""


def _serve(site: Site, port: int | None, opens: bool) -> None:
    import webbrowser

    from powderdsl.web.site import SiteServer

    try:
        server = SiteServer(site, PORT if port is None else port)
    except OSError as error:
        if port is not None:
            raise BadInput(f"port {port} cannot be used: {error.strerror}; choose another --port") from None
        server = SiteServer(site)
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
