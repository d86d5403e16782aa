"""`powderdsl run`: run a world, and show or write the result."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import user_values
from powderdsl.cli.output import counted, progress

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

ANIMATIONS = (".gif", ".mp4")
SUFFIXES = (".png", *ANIMATIONS, ".npz")
MOST_PICTURES = 64
"""The maximum number of worlds in a picture."""


@dataclass(frozen=True)
class Playback:
    """The outputs of a run and their intervals."""

    steps: int
    every: int
    fps: int
    scale: int | None
    out: Path | None
    watch: bool

    @property
    def suffix(self) -> str:
        return self.out.suffix.lower() if self.out else ""


@click.command("run", cls=opt.Command)
@opt.rules
@opt.world
@opt.size
@opt.option("--batch", (1, 1 << 20), "Number of worlds.  [default: 1]")
@opt.option("--steps", (0, 10**9), "Number of steps.", 240)
@opt.option("--seed", (0, 2**63 - 1), "Seed of all random numbers.  [default: 0]")
@opt.machine
@opt.parameters
@opt.output("--out", "FILE", "Write a .png, .gif or .mp4, or save the world as .npz.", *SUFFIXES)
@opt.option("--scale", (1, 64), "Pixels per cell.  [default: about 400 pixels per side]")
@opt.option("--every", (1, 10**6), "Show every n-th step.", 1)
@opt.option("--fps", (1, 240), "Frames per second.", 30)
@opt.option("--watch", bool, "Show the first world in the terminal while it runs.")
@click.option("-v", "--verbose", is_flag=True, help="Report the speed and the backend.")
def command(
    rules: str,
    world: str | None,
    size: tuple[int, int] | None,
    batch: int | None,
    seed: int | None,
    backend: str,
    device: str,
    settings: dict[str, str],
    threads: int,
    verbose: bool,
    **playback: Any,
) -> None:
    """Run a world: watch it, or write a picture or an animation.

    Without --out and --watch, the last step is drawn in the terminal. Without --world, shapes of all elements are
    placed at random, depending only on --seed and --size.
    """
    ruleset = opt.load_rules(rules, settings)
    plan = Playback(**playback)
    from powderdsl.cli.start_worlds import start

    how: dict[str, Any] = {"backend": backend, "device": device, "threads": threads}
    first = start(ruleset, world, size, batch, seed, steps=plan.steps, **how)
    if plan.out is not None and plan.suffix == ".npz":
        from powderdsl.worlds.store import check_saved

        check_saved(plan.out, first.shape)
    if first.sim.kind.xp.__name__ == "torch":
        import torch

        torch.set_num_threads(threads)
    began = time.perf_counter()
    last = play(first, plan)
    seconds = time.perf_counter() - began
    count, height, width = last.shape
    head = f"{ruleset.name}: {counted(count, 'world')} of {height}×{width}, {plan.steps} steps in {seconds:.2f} s"
    if verbose:
        rate, where = count * height * width * plan.steps / max(seconds, 1e-9), last.sim.device
        head += f" ({rate:,.0f} cells/s; {last.sim.running} on {where}, {counted(threads, 'thread')})"
    click.echo(head + (f" -> {plan.out}" if plan.out else ""), err=True)
    if verbose:
        for note in last.sim.notes:
            click.echo(f"  {note}", err=True)


def play(start: World, plan: Playback) -> World:
    """Run a world to the end, show or write it, and return it. An interrupted run leaves no incomplete file."""
    from powderdsl.cli.pictures import LiveView, first_world, pictures

    ruleset, world = start.sim.ruleset, start
    # Even if nothing is shown in between, short calls allow progress and Ctrl-C.
    looking = plan.watch or plan.suffix in ANIMATIONS
    stride = plan.every if looking else max(1, min(64, plan.steps // 50))

    def stream() -> Iterator[World]:
        """The world each time it is shown."""
        nonlocal world
        for number, world in enumerate(start.sim.frames(start, plan.steps, stride)):
            show(min(number * stride, plan.steps))
            yield world

    def picture(world: World) -> Any:
        return pictures(world, most=MOST_PICTURES, factor=plan.scale)

    with ExitStack() as stack:
        if plan.watch:
            view = stack.enter_context(LiveView(ruleset.elements, fields=ruleset.fields, fps=plan.fps))

            def show(step: float) -> None:
                view.show(**first_world(world), caption=f"{ruleset.name}  step {step} of {plan.steps}")

        else:
            bar = stack.enter_context(progress(ruleset.name, plan.steps))

            def show(step: float) -> None:
                bar(step)

        if plan.out is not None and plan.suffix in ANIMATIONS:
            from powderdsl.worlds import media  # brings Pillow

            write = media.write_gif if plan.suffix == ".gif" else media.write_mp4
            with user_values():
                write(plan.out, map(picture, stream()), fps=plan.fps)
        else:
            for _ in stream():
                pass
    if plan.out is None:
        if not plan.watch:
            with LiveView(ruleset.elements, fields=ruleset.fields) as view:
                view.show(**first_world(world))
    elif plan.suffix == ".png":
        from powderdsl.worlds.media import write_png

        write_png(plan.out, picture(world))
    elif plan.suffix == ".npz":
        from powderdsl.worlds.store import save

        save(world, plan.out)
    return world
