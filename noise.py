"""Scandots: the 16 x 12 points around the robot at which it is told the height of the ground; and
what can be wrong with them in tests (section IV-B of the paper; for training: baselines.py).

The grid lies level, 0.1 m a step, turns with the robot's yaw and has its trunk in the middle; row 0
is rearmost, column 0 rightmost. Transformers read it as 4 x 3 patches (12: paper) of 4 x 4 points
(ours), row by row. Noise shifts points, vertically and in where the ground is read (beside edges).
"""

from dataclasses import astuple, dataclass

import numpy as np

from rolt import GRID, NUM_PATCHES, PATCH, SCAN_SHAPE
from terrain import Terrain

SPACING = 0.1  # m, legged_gym
OFFSET_PATCHES = 4  # ours: the paper says "a certain number"
HEIGHT_SCALE, TRUNK_HEIGHT = 20.0, 0.3  # 1/m, m, ours: a walk's are about 0 +- 1 (NOTES 16)
AXES = [(np.arange(n) - (n - 1) / 2) * SPACING for n in SCAN_SHAPE]
FORWARD, LEFT = np.meshgrid(*AXES, indexing="ij")  # (16, 12) m, of each point from the trunk


@dataclass(frozen=True)
class ScanNoise:
    """What is wrong with the scan; the default is nothing."""

    offset: float = 0.0  # m, how far each chosen patch is moved, in a direction of its own
    missing: int = 0  # patches that read zero
    sigma: float = 0.0  # m, standard deviation of every point's shift in x, y and z


def parse_noise(text: str) -> ScanNoise:
    """Reads 'clean', 'offset:METRES', 'sigma:METRES', 'missing:PATCHES', or several with '+'."""
    words = [word.split(":") for word in text.split("+") if word != "clean"]
    try:
        noise = ScanNoise(**{name: float(number) for name, number in words})
        patches = noise.missing in range(NUM_PATCHES + 1)
        if not patches or not all(0 <= size < np.inf for size in astuple(noise)):
            raise ValueError(f"a size is from 0 on, and there are {NUM_PATCHES} patches")
        return noise
    except (TypeError, ValueError) as error:  # no such name, too few or too many, no number
        right = "write clean, offset:0.3, sigma:0.1 or missing:4"
        raise ValueError(f"cannot read the noise {text!r} ({error}); {right}") from None


def scan(terrain: Terrain | None, position, yaw, shift=np.zeros(3)) -> np.ndarray:
    """(n, 16, 12) float32: 20 clip(trunk z - 0.3 m - ground z, -1, 1), trunks at position (n, 3)
    m and yaw (n,) rad. terrain None is flat ground. shift (n, 16, 12, 3) m, in the grid's axes: how
    far off each point is from where the robot believes it."""
    forward, left, up = FORWARD + shift[..., 0], LEFT + shift[..., 1], shift[..., 2]
    x, y, z = position.T[:, :, None, None]
    ground = np.zeros((len(yaw), *SCAN_SHAPE))
    if terrain is not None:
        cos, sin = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
        ground = terrain.height(x + cos * forward - sin * left, y + sin * forward + cos * left)
    return (HEIGHT_SCALE * np.clip(z - TRUNK_HEIGHT - (ground + up), -1, 1)).astype(np.float32)


class NoisyScan:
    """The scandots of N robots as they see them."""

    def __init__(self, num_envs: int, terrain: Terrain | None, noise: str, seed):
        self.terrain, self.noise = terrain, parse_noise(noise)
        self.rng = np.random.default_rng((*np.atleast_1d(seed), 1))  # not the env's draws
        self.shift = np.zeros((num_envs, *SCAN_SHAPE, 3))  # m, of the patches
        self.missing = np.zeros((num_envs, *SCAN_SHAPE), dtype=bool)

    def draw(self, ids: np.ndarray) -> None:
        """New patches and directions for the robots `ids`, at a reset. Low frequency: k patches
        "offset as a whole", uniform on the sphere. Missing: as in the paper's attention figure."""
        noise, shape = self.noise, (len(ids), NUM_PATCHES)
        if noise.offset:
            direction = self.rng.normal(size=(*shape, 3))
            direction *= noise.offset / np.linalg.norm(direction, axis=2, keepdims=True)
            chosen = self.rng.random(shape).argsort(axis=1) < OFFSET_PATCHES  # so many a scan
            self.shift[ids] = as_points(direction * chosen[:, :, None])
        if noise.missing:
            chosen = self.rng.random(shape).argsort(axis=1) < noise.missing
            self.missing[ids] = as_points(chosen)

    def read(self, ids: np.ndarray | slice, position: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """(n, 16, 12), as `scan`, of the robots `ids` at position (n, 3) m and yaw (n,) rad. High
        frequency: "Gaussian noise independently" for every point and axis, at every reading."""
        if self.noise == ScanNoise():
            return scan(self.terrain, position, yaw)
        gaussian = self.noise.sigma * self.rng.normal(size=(len(yaw), *SCAN_SHAPE, 3))
        heights = scan(self.terrain, position, yaw, self.shift[ids] + gaussian)
        heights[self.missing[ids]] = 0.0
        return heights


def as_points(patches: np.ndarray) -> np.ndarray:
    """(n, 12, ...) values of patches -> (n, 16, 12, ...) of their points."""
    grid = patches.reshape(len(patches), *GRID, *patches.shape[2:])
    return grid.repeat(PATCH, axis=1).repeat(PATCH, axis=2)
