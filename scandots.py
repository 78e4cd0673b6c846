"""Scandots: the 16 x 12 points around the robot at which it is told the height of the ground.

The grid lies level, turns with the robot's yaw and has its trunk in the middle. Transformers read it as 4 x 3 patches of
4 x 4 points: the paper has 12 patches; their size is ours, the spacing and the scale of the heights are legged_gym's.

Legend: n robots, 16 points forward (row 0 is the rearmost), 12 points to the left (column 0 is the rightmost).
"""

import numpy as np

from terrain import Terrain

SCAN_SHAPE = (16, 12)  # points forward, left
SPACING = 0.1  # m, legged_gym
PATCH = 4  # points a side
NUM_PATCHES = SCAN_SHAPE[0] // PATCH * (SCAN_SHAPE[1] // PATCH)
HEIGHT_SCALE = 5.0  # legged_gym

FORWARD, LEFT = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * SPACING for n in SCAN_SHAPE), indexing="ij")  # (16, 12) m


def scan(terrain: Terrain | None, position: np.ndarray, yaw: np.ndarray, shift: np.ndarray | None = None) -> np.ndarray:
    """(n, 16, 12) float32: 5 clip(trunk z - 0.5 m - ground z, -1, 1) at every point.

    position (n, 3) m and yaw (n,) rad of the trunk; terrain None is flat ground. shift (n, 16, 12, 3) m, in the grid's
    axes: how far off each point is from where the robot believes it (noise.py).
    """
    forward, left, up = (FORWARD, LEFT, 0.0) if shift is None else (FORWARD + shift[..., 0], LEFT + shift[..., 1], shift[..., 2])
    if terrain is None:
        ground = np.zeros((len(yaw), *SCAN_SHAPE))
    else:
        cos, sin = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
        x, y = position[:, 0, None, None], position[:, 1, None, None]
        ground = terrain.height(x + cos * forward - sin * left, y + sin * forward + cos * left)
    height = position[:, 2, None, None] - 0.5 - (ground + up)
    return (HEIGHT_SCALE * np.clip(height, -1, 1)).astype(np.float32)


def as_patches(points: np.ndarray) -> np.ndarray:
    """(16, 12) -> (12, 16): the points of each patch, in ROLT's order, row by row."""
    rows, columns = (size // PATCH for size in SCAN_SHAPE)
    return points.reshape(rows, PATCH, columns, PATCH).swapaxes(1, 2).reshape(NUM_PATCHES, PATCH**2)
