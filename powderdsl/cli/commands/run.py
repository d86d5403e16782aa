"""`powderdsl run`: a world, some steps, and what is to be seen of them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.exits import counted, user_values
from powderdsl.cli.options import (
    Integer,
    SizeType,
    backend_option,
    check_writable,
    load_rules,
    rules_argument,
    set_option,
)
from powderdsl.cli.progress import progress

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

SUFFIXES = (".png", ".gif", ".mp4", ".npz")
MOST_PICTURES = 64
"""How many worlds of a batch a picture shows."""

SMALL_BATCH = 1 << 20
"""Cells of a batch up to which one thread is as fast as several: handing out work has a price."""


@dataclass(frozen=True)
class Playback:
    """How a run goes: what is shown and written, and how often."""

    steps: int
    every: int
    fps: int
    scale: int | None
    out: Path | None
    watch: bool

    @property
    def suffix(self) -> str:
        return self.out.suffix.lower() if self.out else ""


def _out(ctx: click.Context, param: click.Parameter, value: str | None) -> Path | None:
    if value is None:
        return None
    path = Path(value)
    if path.suffix.lower() not in SUFFIXES:
        raise click.BadParameter(f"`{value}` must end in one of {' '.join(SUFFIXES)}", ctx, param)
    return path


@click.command("run")
@rules_argument
@click.option("--world", metavar="FILE|NAME", help="A .npz, .png, .txt or .yaml, or a scene's name.")
@click.option("--size", type=SizeType(), help="Rows and columns, such as 48x64.")
@click.option("--batch", type=Integer(1, 1 << 20), help="How many worlds.  [default: 1]")
@click.option("--steps", type=Integer(0, 10**9), default=240, help="How many steps.")
@click.option("--seed", type=Integer(0, 2**63 - 1), help="Of all random numbers.  [default: 0]")
@backend_option("auto")
@click.option("--device", default="cpu", help="A torch device: cpu, cuda, cuda:1.")
@set_option
@click.option("--out", metavar="FILE", callback=_out, help="x.png, x.gif, x.mp4, or x.npz to save.")
@click.option("--scale", type=Integer(1, 64), help="Pixels a cell.  [default: about 400 a side]")
@click.option("--every", type=Integer(1, 10**6), default=1, help="Show every n-th step.")
@click.option("--fps", type=Integer(1, 240), default=30, help="Frames a second.")
@click.option("--watch", is_flag=True, help="Show the first world in the terminal while it runs.")
@click.option("--threads", type=Integer(1, 1024), help="CPU threads.  [default: 1 for small batches]")
@click.option("-v", "--verbose", is_flag=True, help="Say how fast, and what became of it.")
def command(
    rules: str,
    world: str | None,
    size: tuple[int, int] | None,
    batch: int | None,
    steps: int,
    seed: int | None,
    backend: str,
    device: str,
    settings: dict[str, str],
    out: Path | None,
    scale: int | None,
    every: int,
    fps: int,
    watch: bool,
    threads: int | None,
    verbose: bool,
) -> None:
    """Run rules on a world: watch it, or write what became of it.

    Without --out and --watch the last step is drawn in the terminal. Without --world, shapes of all elements
    are scattered at random: the same ones for the same --seed and --size.
    """
    ruleset = load_rules(rules, settings)
    if out is not None:
        check_writable(out)
    from powderdsl.cli.start_worlds import start_drawn, start_world
    from powderdsl.simulation.simulator import compile

    # The world first: compiling imports torch, and whoever mistyped a name should not wait for that.
    drawn = start_drawn(ruleset, world, size, batch, seed)
    sim = compile(ruleset, backend=backend, device=device, threads=threads or 1)
    start = start_world(sim, drawn, world, seed)
    if out is not None and out.suffix.lower() == ".npz":
        from powderdsl.worlds.store import check_saved

        check_saved(out, start.shape)
    used = _set_threads(threads, start)
    plan = Playback(steps, every, fps, scale, out, watch)
    began = time.perf_counter()
    end = _Run(sim, start, plan).go()
    took = time.perf_counter() - began
    count, height, width = end.shape
    many = "1 world" if count == 1 else f"{count} worlds"
    head = f"{ruleset.name}: {many} of {height}×{width}, {steps} steps in {took:.2f} s"
    if verbose:
        rate = count * height * width * steps / max(took, 1e-9)
        head += f" ({rate:,.0f} cells/s; {sim.running} on {sim.device}, {counted(used, 'thread')})"
    click.echo(head + (f" -> {out}" if out else ""), err=True)
    if verbose:
        for note in sim.notes:
            click.echo(f"  {note}", err=True)
        click.echo(_populations(start, end), err=True)


def _set_threads(threads: int | None, world: World) -> int:
    """Set and return how many threads torch uses: `threads`, or one for small batches."""
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
    elif world.ids.numel() <= SMALL_BATCH:
        torch.set_num_threads(1)
    return torch.get_num_threads()


def _populations(start: World, end: World) -> str:
    """How many cells each element has, before and after."""
    import torch

    before, after = (torch.bincount(w.ids.flatten().long(), minlength=256).tolist() for w in (start, end))
    elements = start.sim.ruleset.elements
    width = max(len(element.name) for element in elements)
    rows = [(e.name, before[e.id], after[e.id]) for e in elements if before[e.id] or after[e.id]]
    return "\n".join(f"  {name:<{width}}  {old:>9,} -> {new:>9,}" for name, old, new in rows)


class _Run:
    """One run: a stream of worlds, shown and written as the plan says."""

    def __init__(self, sim: Simulator, start: World, plan: Playback):
        self.sim, self.plan = sim, plan
        self.start = self.world = start

    def go(self) -> World:
        """Run to the end; the last world. Nothing half-written stays behind when it is interrupted."""
        from powderdsl.cli.pictures import first_world
        from powderdsl.cli.terminal import LiveView

        if self.plan.watch:
            with LiveView(self.sim.ruleset.elements) as self.view:
                self._consume(self._watched(self._worlds()))
        else:
            self._consume(self._with_progress(self._worlds()))
        if self.plan.out is None and not self.plan.watch:
            with LiveView(self.sim.ruleset.elements) as view:
                view.show(**first_world(self.world))
        return self.world

    def _worlds(self) -> Iterator[int]:
        """Advances the world; yields how many steps it has made each time it is to be seen."""
        done, steps = 0, self.plan.steps
        # Where nobody looks in between, short calls still let progress be shown and Ctrl-C be heard.
        looking = self.plan.watch or self.plan.suffix in (".gif", ".mp4")
        stride = self.plan.every if looking else max(1, min(64, steps // 50))
        yield done
        while done < steps:
            count = min(stride, steps - done)
            self.world = self.sim.step(self.world, steps=count)
            done += count
            yield done

    def _consume(self, moments: Iterator[int]) -> None:
        """Run the stream dry while writing the file."""
        out, plan = self.plan.out, self.plan
        if plan.suffix in (".gif", ".mp4"):
            from powderdsl.simulation import media

            write = media.write_gif if plan.suffix == ".gif" else media.write_mp4
            assert out is not None
            with user_values():
                write(out, (self._picture() for _ in moments), fps=plan.fps)
            return
        for _ in moments:
            pass
        if out is None:
            return
        if plan.suffix == ".png":
            from powderdsl.simulation.media import write_png

            write_png(out, self._picture())
            return
        from powderdsl.worlds.store import save

        save(self.world, out)

    def _picture(self) -> Any:
        from powderdsl.cli.pictures import pictures

        return pictures(self.world, most=MOST_PICTURES, factor=self.plan.scale)

    def _watched(self, moments: Iterator[int]) -> Iterator[int]:
        """Shows each substep, no faster than the frame rate on a terminal."""
        from powderdsl.cli.pictures import first_world

        due = time.perf_counter()
        for step in moments:
            caption = f"{self.sim.ruleset.name}  step {step} of {self.plan.steps}"
            self.view.show(**first_world(self.world), caption=caption)
            if self.view.in_place:
                due = max(due + 1 / self.plan.fps, time.perf_counter())
                time.sleep(max(due - time.perf_counter(), 0))
            yield step

    def _with_progress(self, moments: Iterator[int]) -> Iterator[int]:
        """A progress bar on stderr, which goes when the run ends."""
        with progress(self.sim.ruleset.name, self.plan.steps) as show:
            for step in moments:
                show(step)
                yield step
