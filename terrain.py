"""Terrain: a map of tiles, as solids that MuJoCo collides and as the exact height of the ground at
any (x, y).

A map has rows of levels, one behind the other along x, and columns of kinds, side by side along y.
Each tile is 8 m square with a flat strip around it; robots start on the strip in front of it and
walk on along x, up and down again:

    flat        nothing
    slope       a frustum, up to 2 m inwards, then level
    stairs      a pyramid of 6 steps
    platforms   5 x 5 blocks of random height

Heights grow with the level (legged_gym's formulas, whose curriculum goes from level 0 to 9; -1, -2
and 10 are ours, -1 and -2 for a policy that comes from flat ground and hardly lifts its feet).
Unlike legged_gym's, the ground is not
a height field but boxes and convex meshes: a height field costs four times as much to collide with,
and its steps are never quite vertical. All coordinates in metres. Walking robots climb the levels
as in legged_gym (`next_row`).
"""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

KINDS = ("flat", "slope", "stairs", "platforms")
TILE = 8.0  # m, side of a tile, legged_gym
BORDER = 0.5  # m, ours: a flat strip on every side, so that tiles meet at height 0 and a robot starts on level ground
HALF = TILE / 2 - BORDER  # m, half the width of what stands on a tile
TREAD = 0.31  # m, depth of a step, legged_gym
STEPS = 6  # leaves a platform 3.9 m wide on top (legged_gym: at least 3 m)
SLOPE_RUN = 2.0  # m, from the edge of a slope to its platform, which is then 3 m wide (legged_gym)
BLOCKS = 5  # a side
BLOCK = 2 * HALF / BLOCKS  # m; legged_gym's are 1 to 2 m


def rise(level: int) -> float:
    """m, height of one step of the stairs, legged_gym."""
    return 0.05 + 0.018 * level


def gradient(level: int) -> float:
    """Height over run of a slope, legged_gym."""
    return 0.04 * max(0, level)


def block_height(level: int) -> float:
    """m, the highest platform, legged_gym."""
    return 0.05 + 0.02 * level


@dataclass(frozen=True)
class Terrain:
    """Tile (row, column) covers x from 8 row to 8 row + 8 and y from 8 column - 4 to 8 column + 4.
    All around is flat."""

    columns: tuple[str, ...]  # of KINDS
    levels: tuple[int, ...]  # of each row, -2 (easy) to 10

    def __post_init__(self):
        if unknown := set(self.columns) - set(KINDS):
            raise ValueError(f"unknown kind of terrain {', '.join(sorted(unknown))}; there is {', '.join(KINDS)}")
        if not self.columns or not self.levels or not all(-2 <= level <= 10 for level in self.levels):
            raise ValueError(f"a terrain has columns, and rows of level -2 to 10, not {self.columns} and {self.levels}")

    @cached_property
    def blocks(self) -> np.ndarray:
        """(rows, columns, 5, 5) height of every platform: each is low, half or full (legged_gym
        also digs holes)."""
        draws = np.random.default_rng(0).integers(3, size=(len(self.levels), len(self.columns), BLOCKS, BLOCKS))
        platforms = np.array([kind == "platforms" for kind in self.columns])[None, :, None, None]
        tallest = np.array([block_height(level) for level in self.levels])[:, None, None, None]
        return platforms * tallest * draws / 2

    @cached_property
    def _tables(self) -> tuple[np.ndarray, np.ndarray]:
        """(rows * columns,) each: the rise of the stairs and the gradient of the slope on every
        tile, 0 where there is none."""
        stairs = [rise(level) * (kind == "stairs") for level in self.levels for kind in self.columns]
        slopes = [gradient(level) * (kind == "slope") for level in self.levels for kind in self.columns]
        return np.array(stairs), np.array(slopes)

    def start(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """(..., 2), where a robot starts that is to walk over the tile: in the middle of the strip
        before it."""
        return TILE * np.stack([row, column], axis=-1)

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of the ground at (x, y), any shape."""
        stairs, slopes = self._tables
        row, column = np.floor(x / TILE), np.floor(y / TILE + 0.5)
        u, v = x - TILE * (row + 0.5), y - TILE * column  # from the tile's centre
        inside = HALF - np.maximum(np.abs(u), np.abs(v))  # from the edge of what stands on the tile, inwards
        on = (inside >= 0) & (row >= 0) & (row < len(self.levels)) & (column >= 0) & (column < len(self.columns))
        row, column = np.where(on, row, 0).astype(int), np.where(on, column, 0).astype(int)
        tile = row * len(self.columns) + column
        height = stairs[tile] * np.minimum(np.floor(inside / TREAD) + 1, STEPS)
        height += slopes[tile] * np.minimum(inside, SLOPE_RUN)
        if "platforms" in self.columns:
            i, j = (np.clip((w + HALF) / BLOCK, 0, BLOCKS - 1).astype(int) for w in (u, v))
            height += self.blocks[row, column, i, j]
        return np.where(on, height, 0.0)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Adds the solids to the world of `spec`."""
        for row, level in enumerate(self.levels):
            for column, kind in enumerate(self.columns):
                x, y = TILE * (row + 0.5), TILE * column
                if kind == "stairs":
                    for step in range(STEPS):
                        _add_box(spec, x, y, HALF - TREAD * step, rise(level) * (step + 1), shade=step % 2)
                elif kind == "slope" and level > 0:
                    _add_frustum(spec, x, y, SLOPE_RUN * gradient(level), f"slope_{row}_{column}")
                elif kind == "platforms":
                    centres = BLOCK * (np.arange(BLOCKS) + 0.5) - HALF
                    for (i, j), top in np.ndenumerate(self.blocks[row, column]):
                        if top > 0:
                            _add_box(spec, x + centres[i], y + centres[j], BLOCK / 2, top)

    def next_row(self, row: np.ndarray, distance: np.ndarray, commanded: np.ndarray, rng) -> np.ndarray:
        """legged_gym's curriculum, at the end of an episode: up a level after half a tile, down
        after less than half of the commanded distance; after the last level, any.

        row (n,), distance (n,) m from the start, commanded (n,) m in a whole episode.
        """
        up = distance > TILE / 2
        down = ~up & (distance < 0.5 * commanded)
        row = np.maximum(row + up.astype(int) - down, 0)
        finished = row >= len(self.levels)
        return np.where(finished, rng.integers(len(self.levels), size=len(row)), row)


# Two fifths of the robots learn on stairs, where the tests are. Steps of 1.4 to 12.2 cm for a robot
# that stands 30 cm high; a run that began at level 0 (5 cm) learned to stand in front of the
# stairs.
TRAINING_MAP = Terrain(columns=("stairs", "slope", "stairs", "platforms", "flat"), levels=(-2, -1, 0, 1, 2, 3, 4))

_SOLID = {"contype": 1, "conaffinity": 0}  # collides with robots, as the ground does
_SHADES = [0.80, 0.77, 0.72, 1], [0.55, 0.53, 0.50, 1]  # one step from the next


def _add_box(spec: mujoco.MjSpec, x: float, y: float, half: float, top: float, shade: int = 0) -> None:
    """A square box on the ground."""
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [half, half, top / 2], "pos": [x, y, top / 2]}
    spec.worldbody.add_geom(**box, **_SOLID, rgba=_SHADES[shade])


def _add_frustum(spec: mujoco.MjSpec, x: float, y: float, top: float, name: str) -> None:
    """A square pyramid without its tip, on the ground."""
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    base, platform = HALF * corners, (HALF - SLOPE_RUN) * corners
    vertices = np.concatenate([np.c_[base, np.zeros(4)], np.c_[platform, np.full(4, top)]])
    mesh = spec.add_mesh(name=name)
    mesh.uservert = vertices.ravel()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=[x, y, 0], rgba=_SHADES[0], **_SOLID)
