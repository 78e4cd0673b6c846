"""Terrain: a map of tiles, as solids that MuJoCo collides and as the exact height of the ground.

A map has rows of levels, one behind the other along x, and columns of kinds, side by side along y.
A tile is 8 m square with a flat strip around it; robots start on the strip before it and walk along
x. It is flat, a slope (a frustum: up to 2 m inwards, then level), stairs (a pyramid of 6 steps) or
platforms (5 x 5 blocks of random height). All coordinates in metres.

Levels 0 to 9 are legged_gym's; 10 is ours, as -2 and -1, for a policy from flat ground that hardly
lifts its feet. legged_gym's height field is four times as slow, its steps never quite vertical.
"""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

KINDS = ("flat", "slope", "stairs", "platforms")
TILE = 8.0  # m, side of a tile, legged_gym
BORDER = 0.5  # m, ours: a flat strip on every side, where tiles meet at height 0 and robots start
HALF = TILE / 2 - BORDER  # m, half the width of what stands on a tile
TREAD = 0.31  # m, depth of a step, legged_gym
STEPS = 6  # leaves a platform 3.9 m wide on top (legged_gym: at least 3 m)
SLOPE_RUN = 2.0  # m, from the edge of a slope to its platform, which is then 3 m wide (legged_gym)
BLOCKS = 5  # a side
BLOCK = 2 * HALF / BLOCKS  # m; legged_gym's are 1 to 2 m


def rise(level: int) -> float:
    """m, height of one step of the stairs, legged_gym."""
    return 0.05 + 0.018 * level


@dataclass(frozen=True)
class Terrain:
    """Tile (row, column): x from 8 row to 8 row + 8, y from 8 column - 4 to 8 column + 4."""

    columns: tuple[str, ...]  # of KINDS
    levels: tuple[int, ...]  # of each row, -2 (easy) to 10

    def __post_init__(self):
        if unknown := ", ".join(sorted(set(self.columns) - set(KINDS))):
            raise ValueError(f"unknown kind of terrain {unknown}; there is {', '.join(KINDS)}")

    @cached_property
    def sizes(self) -> dict[str, np.ndarray]:
        """{kind: (rows, columns)}, legged_gym's; 0 where a tile is of another kind."""
        level, columns = np.array(self.levels), np.array(self.columns)
        sizes = {"stairs": rise(level)}  # m, of a step
        sizes["slope"] = 0.04 * np.maximum(0, level)  # height over run
        sizes["platforms"] = 0.05 + 0.02 * level  # m, the highest
        return {kind: np.outer(size, columns == kind) for kind, size in sizes.items()}

    @cached_property
    def blocks(self) -> np.ndarray:
        """(rows, columns, 5, 5), platforms: each low, half or full (legged_gym also digs holes)."""
        shape = (len(self.levels), len(self.columns), BLOCKS, BLOCKS)
        draws = np.random.default_rng(0).integers(3, size=shape)
        return self.sizes["platforms"][:, :, None, None] * draws / 2

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of the ground at (x, y), any shape."""
        row, column = np.floor(x / TILE), np.floor(y / TILE + 0.5)
        u, v = x - TILE * (row + 0.5), y - TILE * column  # from the tile's centre
        inside = HALF - np.maximum(np.abs(u), np.abs(v))  # from the edge of what stands on the tile
        rows, columns = len(self.levels), len(self.columns)
        on = (inside >= 0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        row, column = np.where(on, row, 0).astype(int), np.where(on, column, 0).astype(int)

        steps = np.minimum(np.floor(inside / TREAD) + 1, STEPS)
        height = self.sizes["stairs"][row, column] * steps
        height += self.sizes["slope"][row, column] * np.minimum(inside, SLOPE_RUN)
        i, j = (np.clip((w + HALF) / BLOCK, 0, BLOCKS - 1).astype(int) for w in (u, v))
        return np.where(on, height + self.blocks[row, column, i, j], 0.0)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Adds the solids to the world of `spec`."""
        for row, level in enumerate(self.levels):
            for column, kind in enumerate(self.columns):
                x, y = TILE * (row + 0.5), TILE * column
                if kind == "stairs":
                    for i in range(STEPS):
                        _add_box(spec, x, y, HALF - TREAD * i, rise(level) * (i + 1), shade=i % 2)
                elif kind == "slope" and level > 0:
                    _add_frustum(spec, x, y, self.sizes[kind][row, column], f"slope_{row}_{column}")
                elif kind == "platforms":
                    centres = BLOCK * (np.arange(BLOCKS) + 0.5) - HALF
                    for (i, j), top in np.ndenumerate(self.blocks[row, column]):
                        if top > 0:
                            _add_box(spec, x + centres[i], y + centres[j], BLOCK / 2, top)

    def next_row(self, row: np.ndarray, distance: np.ndarray, commanded: np.ndarray, rng):
        """legged_gym's curriculum, at the end of an episode: up a level after half a tile, down
        after less than half of the commanded distance; after the last level, any. All (n,), m."""
        up = distance > TILE / 2
        down = ~up & (distance < 0.5 * commanded)
        row = np.maximum(row + up.astype(int) - down, 0)
        return np.where(row < len(self.levels), row, rng.integers(len(self.levels), size=len(row)))


# Two fifths of the robots learn on stairs, where the tests are: steps of 1.4 to 12.2 cm (NOTES 17).
TRAINING_MAP = Terrain(("stairs", "slope", "stairs", "platforms", "flat"), tuple(range(-2, 5)))
_SHADES = [0.80, 0.77, 0.72, 1], [0.55, 0.53, 0.50, 1]  # one step from the next


def _add_box(spec: mujoco.MjSpec, x: float, y: float, half: float, top: float, shade=0) -> None:
    """A square box on the ground."""
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [half, half, top / 2], "pos": [x, y, top / 2]}
    spec.worldbody.add_geom(**box, conaffinity=0, rgba=_SHADES[shade])  # 0: as the ground's


def _add_frustum(spec: mujoco.MjSpec, x: float, y: float, slope: float, name: str) -> None:
    """A square pyramid without its tip, on the ground."""
    square = np.array([(-1, -1, 0), (-1, 1, 0), (1, -1, 0), (1, 1, 0)])
    base, platform = HALF * square, (HALF - SLOPE_RUN) * square + [0, 0, SLOPE_RUN * slope]
    spec.add_mesh(name=name, uservert=np.ravel([base, platform]))
    mesh = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name, "pos": [x, y, 0]}
    spec.worldbody.add_geom(**mesh, conaffinity=0, rgba=_SHADES[0])
