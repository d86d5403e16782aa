"""Random start worlds: scattered shapes of all elements."""

from __future__ import annotations

from random import Random

from powderdsl.arrays import NDArray, np
from powderdsl.model.types import Ruleset
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import MAX_CELLS, Shape, Size, mask

MAX_TOTAL = 16 * MAX_CELLS
"""Maximum number of cells of all worlds together."""


def check_cells(batch: int, size: tuple[int, ...]) -> None:
    """Raise CompileError (PD607) for more than MAX_TOTAL cells."""
    if batch * size[0] * size[1] > MAX_TOTAL:
        many = f"{batch} worlds of {size[0]}×{size[1]} cells"
        raise failure("PD607", many, helps=(f"all worlds together have at most {MAX_TOTAL:,} cells",))


def strew(ruleset: Ruleset, size: Size, batch: int, seed: int) -> NDArray[np.uint8]:
    """Worlds of randomly placed shapes, uint8 [batch, H, W]. World i depends only on `seed` and i.

    The background is the element with the lowest id. On it are 24 disks, boxes and lines of the other elements, each
    solid or with a random half of its cells. If any element moves and another never changes, the first unchanging
    element frames the world, so that nothing leaves it. Raises CompileError as `check_cells`.
    """
    height, width = size
    check_cells(batch, size)
    everything = [element.id for element in ruleset.elements]
    ground, others = everything[0], everything[1:]
    worlds = np.full((batch, height, width), ground, dtype=np.uint8)
    if not others:
        return worlds
    frame = frame_element(ruleset, ground) if min(size) >= 3 else None
    edge = mask(Shape("frame"), size)
    for index in range(batch):
        world = np.full(size, ground, dtype=np.uint8)
        random = Random(f"{seed} {index}")
        for _ in range(24):
            cells = mask(random_shape(random, size, max(min(size) // 8, 1)), size)
            element = random.choice(others)
            if random.random() < 0.5:
                half = np.frombuffer(random.randbytes(height * width), np.uint8).reshape(size) < 128
                cells = cells & half
            world[cells] = element
        if frame is not None:
            world[edge] = frame
        worlds[index] = world
    return worlds


def random_shape(random: Random, size: Size, reach: int) -> Shape:
    """A disk, box or line up to about `2 * reach` cells across, anywhere in a world of `size`."""
    row, column = (random.randrange(side) for side in size)
    match random.randrange(3):
        case 0:
            return Shape("disk", (row, column, random.randint(1, reach + 1)))
        case 1:
            rows, columns = random.randint(1, 2 * reach), random.randint(1, 2 * reach)
            return Shape("box", (row, row + rows, column, column + columns))
    down, right = random.randint(-2 * reach, 2 * reach), random.randint(-2 * reach, 2 * reach)
    return Shape("line", (row, column, row + down, column + right, 1))


def frame_element(ruleset: Ruleset, ground: int) -> int | None:
    """The id of the element that frames random worlds; None if nothing moves or all elements change."""
    from powderdsl.analysis.changes import moved_ids, unchanging_ids  # only for scattered worlds

    if not moved_ids(ruleset):
        return None
    return min(unchanging_ids(ruleset) - {ground}, default=None)
