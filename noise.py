"""Scandots: the 16 x 12 points around the robot at which it is told the height of the ground; and
what can be wrong with them in tests (section IV-B of the paper; for training: baselines.py).

The grid lies level, turns with the robot's yaw and has its trunk in the middle; row 0 is rearmost,
column 0 rightmost. Transformers read it as 4 x 3 patches of 4 x 4 points, row by row: the paper has
12 patches; their size is ours, the spacing and the scale of the heights are legged_gym's. Noise
shifts points, vertically and in where the ground is read (it matters beside edges). n robots.
"""

from dataclasses import dataclass

import numpy as np

from terrain import Terrain

SCAN_SHAPE = (16, 12)  # points forward, left
SPACING = 0.1  # m, legged_gym
PATCH = 4  # points a side
GRID = (SCAN_SHAPE[0] // PATCH, SCAN_SHAPE[1] // PATCH)  # 4 x 3 patches
NUM_PATCHES = GRID[0] * GRID[1]
HEIGHT_SCALE = 5.0  # legged_gym
AXES = [(np.arange(n) - (n - 1) / 2) * SPACING for n in SCAN_SHAPE]
FORWARD, LEFT = np.meshgrid(*AXES, indexing="ij")  # (16, 12) m, of each point from the trunk


@dataclass(frozen=True)
class ScanNoise:
    """What is wrong with the scan; the default is nothing."""

    offset: float = 0.0  # m, how far each chosen patch is moved, in a direction of its own
    offset_patches: int = 4  # k, ours: the paper says "a certain number"
    missing_patches: int = 0  # k that read zero
    sigma: float = 0.0  # m, standard deviation of every point's shift in x, y and z
    redraw: bool = False  # patches and directions are drawn at each step, not once an episode

    def __post_init__(self):
        if not all(0 <= k <= NUM_PATCHES for k in (self.offset_patches, self.missing_patches)):
            raise ValueError(f"0 to {NUM_PATCHES} patches can be offset or missing")
        if not (0 <= self.offset < np.inf and 0 <= self.sigma < np.inf):
            raise ValueError("the scale of noise is a number from 0 on")

    def __str__(self) -> str:
        """What `parse` reads back (but for `offset_patches` and `redraw`)."""
        words = {"offset": self.offset, "missing": self.missing_patches, "sigma": self.sigma}
        return "+".join(f"{name}:{value}" for name, value in words.items() if value) or "clean"


def parse(text: str) -> ScanNoise:
    """Reads 'clean', 'offset:METRES', 'sigma:METRES', 'missing:PATCHES', or several with '+'."""
    values = {}
    try:
        for word in text.split("+"):
            name, _, number = word.partition(":")
            if name in ("offset", "sigma"):
                values[name] = float(number)
            elif name == "missing":
                values["missing_patches"] = int(number)
            elif word != "clean":
                raise ValueError("no such kind of noise")
        return ScanNoise(**values)
    except ValueError as error:
        right = "write clean, offset:0.3, sigma:0.1 or missing:4"
        raise ValueError(f"cannot read the noise {text!r} ({error}); {right}") from None


def scan(terrain: Terrain | None, position: np.ndarray, yaw: np.ndarray, shift=None) -> np.ndarray:
    """(n, 16, 12) float32: 5 clip(trunk z - 0.5 m - ground z, -1, 1), for trunks at position (n, 3)
    m and yaw (n,) rad. terrain None is flat ground. shift (n, 16, 12, 3) m, in the grid's axes: how
    far off each point is from where the robot believes it."""
    forward, left, up = FORWARD, LEFT, 0.0
    if shift is not None:
        forward, left, up = FORWARD + shift[..., 0], LEFT + shift[..., 1], shift[..., 2]
    x, y, z = position.T[:, :, None, None]
    ground = np.zeros((len(yaw), *SCAN_SHAPE))
    if terrain is not None:
        cos, sin = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
        ground = terrain.height(x + cos * forward - sin * left, y + sin * forward + cos * left)
    return (HEIGHT_SCALE * np.clip(z - 0.5 - (ground + up), -1, 1)).astype(np.float32)


def as_patches(points: np.ndarray) -> np.ndarray:
    """(16, 12) -> (12, 16): the points of each patch."""
    return points.reshape(GRID[0], PATCH, GRID[1], PATCH).swapaxes(1, 2).reshape(-1, PATCH**2)


def spread(patches: np.ndarray) -> np.ndarray:
    """(n, 12, ...) a value a patch -> (n, 16, 12, ...) a value a point."""
    grid = patches.reshape(len(patches), *GRID, *patches.shape[2:])
    return grid.repeat(PATCH, axis=1).repeat(PATCH, axis=2)


def choose_patches(n: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 12) bool, `count` random patches of every scan."""
    return rng.random((n, NUM_PATCHES)).argsort(axis=1) < count


def patch_shifts(noise: ScanNoise, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 16, 12, 3) m, low frequency: k patches "offset as a whole", uniform on the sphere."""
    direction = rng.normal(size=(n, NUM_PATCHES, 3))
    direction *= noise.offset / np.linalg.norm(direction, axis=2, keepdims=True)
    return spread(direction * choose_patches(n, noise.offset_patches, rng)[:, :, None])


def point_shifts(noise: ScanNoise, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 16, 12, 3) m, high frequency: "Gaussian noise independently" for every point and axis."""
    return noise.sigma * rng.normal(size=(n, *SCAN_SHAPE, 3))


def missing_points(noise: ScanNoise, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 16, 12) bool, the points of k patches that read zero (the paper's attention figure)."""
    return spread(choose_patches(n, noise.missing_patches, rng))


class NoisyScan:
    """The scandots of N robots as they see them."""

    def __init__(self, num_envs: int, terrain: Terrain | None, noise: ScanNoise, seed):
        self.terrain, self.noise = terrain, noise
        self.rng = np.random.default_rng((*np.atleast_1d(seed), 1))  # not the env's draws
        self.shift = np.zeros((num_envs, *SCAN_SHAPE, 3))  # m, of the patches
        self.missing = np.zeros((num_envs, *SCAN_SHAPE), dtype=bool)

    def set_noise(self, noise: ScanNoise) -> None:
        """From the next reading on."""
        self.noise = noise
        self.shift[:], self.missing[:] = 0.0, False
        self.draw(np.arange(len(self.shift)))

    def draw(self, ids: np.ndarray) -> None:
        """New patches and directions for the robots `ids`: at a reset, or at every reading."""
        if self.noise.offset:
            self.shift[ids] = patch_shifts(self.noise, len(ids), self.rng)
        if self.noise.missing_patches:
            self.missing[ids] = missing_points(self.noise, len(ids), self.rng)

    def read(self, ids: np.ndarray, position: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """(n, 16, 12), as `scan`, for the n robots `ids` at position (n, 3) m and yaw (n,) rad."""
        if self.noise == ScanNoise():
            return scan(self.terrain, position, yaw)
        if self.noise.redraw:
            self.draw(ids)
        shift = self.shift[ids] + point_shifts(self.noise, len(ids), self.rng)
        heights = scan(self.terrain, position, yaw, shift)
        heights[self.missing[ids]] = 0.0
        return heights
