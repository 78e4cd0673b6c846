"""The ground, the scandots that read it, their noise, and the curriculum."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from conftest import QUIET, env_of, rest
from env import EnvConfig
from noise import NoisyScan, ScanNoise, parse_noise, scan
from robots import A1, build_model
from terrain import KINDS, TRAINING_MAP, Terrain, rise

STAIRS = Terrain(("stairs",), (3,))  # steps of 0.104 m and 0.31 m that begin at x = 0.5
RAMP = SimpleNamespace(height=lambda x, y: x)  # ground as high as x, everywhere
STILL = replace(QUIET, forward_speed=(0.0, 0.0), start_rows=1, climb=False)


def test_height_is_where_rays_end(rng):
    terrain = Terrain((*KINDS, "stairs"), (0, 4, 10))
    model = build_model(A1, terrain)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    x, y = rng.uniform(-2, 27, 4000), rng.uniform(-6, 8 * len(terrain.columns), 4000)
    geom, trunk = np.zeros(1, dtype=np.int32), model.body("trunk").id
    how = [0, 0, -1.0], None, 1, trunk, geom, None  # straight down, past the robot's trunk
    down = np.array([mujoco.mj_ray(model, data, [a, b, 9.0], *how) for a, b in zip(x, y)])
    away = np.hypot(x, y) > 1  # from the robot's legs
    height = terrain.height(x, y)
    assert np.allclose(9.0 - down[away], height[away], atol=1e-6)
    for column, kind in enumerate(terrain.columns):
        assert (height[np.abs(y - 8 * column) < 3.5] > 0).any() == (kind != "flat")
    assert height.max() == pytest.approx(6 * rise(10))


def test_stairs_by_hand():
    x = np.array([-3.0, 0.49, 0.51, 0.80, 0.82, 4.0, 7.49, 7.51, 9.0])
    assert np.allclose(STAIRS.height(x, np.zeros(9)) / rise(3), [0, 0, 1, 1, 2, 6, 1, 0, 0])
    assert np.allclose(STAIRS.height(x, np.full(9, 3.6)), 0)  # the strip beside them


def test_the_scan_turns_with_the_robot_and_a_shift_reads_the_ground_elsewhere():
    """On a ramp a point read 0.2 m further ahead is 0.2 m higher; a vertical shift is anywhere."""
    position, yaw = np.array([[0, 0, 0.3]] * 2), np.array([0, np.pi / 2])
    ahead, turned = scan(RAMP, position, yaw) / 20
    assert np.allclose(ahead[:, 0], np.linspace(0.75, -0.75, 16))  # it rises to the front
    assert np.allclose(ahead, ahead[:, :1])
    assert np.allclose(turned[0], np.linspace(-0.55, 0.55, 12))  # and, facing left, to the right
    assert np.allclose(turned, turned[:1])
    to_the_left = SimpleNamespace(height=lambda x, y: y)
    assert np.allclose(scan(to_the_left, position, yaw)[1] / 20, ahead)

    further, up = np.eye(3)[[0, 2]] * 0.2
    assert np.allclose(scan(RAMP, position, yaw, further)[0] / 20, np.clip(ahead - 0.2, -1, 1))
    assert np.allclose(scan(None, position, yaw, further), 0)
    assert np.allclose(scan(None, position, yaw, up), -4)


def test_the_env_reads_the_ground_around_its_robots():
    env = env_of(2, terrain=STAIRS, config=STILL, extras=("heights",))
    x, y, z = env.position.T
    assert np.allclose(x, 0) and np.all(np.abs(y) <= 1)
    heights = env.observe().heights / 20
    assert np.allclose(heights[:, :13], (z - 0.3)[:, None, None])  # up to 0.45 m ahead: flat
    assert np.allclose(heights[:, 13:], (z - 0.3 - rise(3))[:, None, None])  # ahead: the first step


def test_noise_is_read_from_words_and_unknown_ground_and_noise_are_refused():
    assert parse_noise("clean") == ScanNoise()
    noise = ScanNoise(offset=0.3, missing=4, sigma=0.1)
    assert parse_noise("offset:0.3+missing:4+sigma:0.1") == noise
    for text in ("fog", "sigma", "sigma:-1", "sigma:nan", "missing:13", "missing:1.5", ""):
        with pytest.raises(ValueError, match="write clean, offset:0.3"):
            parse_noise(text)
    with pytest.raises(ValueError, match="unknown kind of terrain lava; there is flat, slope"):
        Terrain(("lava",), (0,))


def drawn(n: int, noise: str) -> NoisyScan:
    scan = NoisyScan(n, None, noise, 0)
    scan.draw(np.arange(n))
    return scan


def test_low_frequency_noise_moves_whole_patches_by_its_scale_and_missing_ones_are_whole():
    shifts, missing = drawn(2000, "offset:0.3").shift, drawn(50, "missing:4").missing
    assert np.array_equal(shifts, drawn(2000, "offset:0.3").shift)
    shift, gone = (points[:, ::4, ::4] for points in (shifts, missing))  # of each patch
    assert np.array_equal(shifts, shift.repeat(4, axis=1).repeat(4, axis=2))
    assert np.array_equal(missing, gone.repeat(4, axis=1).repeat(4, axis=2))
    assert np.all(gone.sum(axis=(1, 2)) == 4)
    moved = np.linalg.norm(shift, axis=3)
    assert np.all((moved > 0).sum(axis=(1, 2)) == 4) and np.allclose(moved[moved > 0], 0.3)
    directions = shift[moved > 0] / 0.3  # 8000, uniform on the sphere
    assert np.allclose(directions.mean(0), 0, atol=0.03)
    assert np.allclose(directions.var(0), 1 / 3, atol=0.02)


def test_high_frequency_noise_has_its_scale_and_no_order():
    """On flat ground only its z shows; on a ramp of 45 degrees x as well: times sqrt(2)."""
    noisy, ids = drawn(100, "sigma:0.1"), np.arange(100)
    position, yaw = np.tile([0, 0, 0.3], (100, 1)), np.zeros(100)
    flat = noisy.read(ids, position, yaw) / 20
    assert np.abs(flat.mean(axis=0)).mean() < 0.01 and flat.std() == pytest.approx(0.1, rel=0.02)
    assert abs(np.corrcoef(flat[:, 0, 0], flat[:, 0, 1])[0, 1]) < 0.3
    noisy.terrain = RAMP
    ramp = noisy.read(ids, position, yaw)[:, 6:10] / 20  # amid the scan, where nothing is clipped
    expected = scan(RAMP, position, yaw)[:, 6:10] / 20
    assert (ramp - expected).std() == pytest.approx(0.1 * 2**0.5, rel=0.03)


def test_noise_changes_the_scan_and_nothing_else():
    traces = []
    for noise in ("clean", "offset:0.2+missing:2+sigma:0.1"):
        env = env_of(4, extras=("heights",), terrain=STAIRS, noise=noise)
        traces += [env.observe(), rest(env)[0]]
    clean, clean_next, noisy, noisy_next = traces
    assert np.array_equal(clean.legs, noisy.legs)
    assert np.array_equal(clean_next.legs, noisy_next.legs)
    assert not np.array_equal(clean.heights, noisy.heights)
    assert all((scan == 0).sum() >= 2 * 16 for scan in noisy.heights)


def test_curriculum_by_hand(rng):
    """Episodes of 20 s at 0.5 m/s: 10 m commanded, half of it 5 m; half a tile is 4 m."""
    row, distance = np.array([1, 1, 0, 1, 6]), np.array([4.1, 3.9, 1.0, 0.5, 9.0])
    speed = np.array([0.5, 0.5, 0.5, 0.0, 0.5])  # the fourth is told to stand
    after = TRAINING_MAP.next_row(row, distance, 20.0 * speed, rng)
    assert list(after[:4]) == [2, 0, 0, 1]
    assert 0 <= after[4] < 7  # after the last level, any


def test_robots_climb_when_their_episode_ends():
    config = EnvConfig(forward_speed=(0.5, 0.5), start_rows=1)
    env = env_of(2, terrain=TRAINING_MAP, config=config)
    assert list(env.row) == [0, 0] and list(env.column) == [0, 1]
    env.age[:] = env.episode_steps - 1
    env.world.bind("qpos")[0, 0] = 4.5
    rest(env)
    assert list(env.row) == [1, 0]
    assert env.position[0, 0] == pytest.approx(8.0)
    assert env.position[1, 1] == pytest.approx(8.0, abs=1.0)
    env.world.bind("qvel")[0] = np.nan  # diverged, it is put at (0, 0), far from where it began
    rest(env)
    assert list(env.row) == [1, 0]


def test_a_robot_stands_on_every_tile():
    rows, columns = len(TRAINING_MAP.levels), len(TRAINING_MAP.columns)
    env = env_of(rows * columns, extras=("heights",), terrain=TRAINING_MAP, config=STILL)
    env.row[:] = np.repeat(np.arange(rows), columns)
    env._reset(np.arange(env.num_envs))
    heights = env.observe().heights
    assert np.all(heights[:, 4:12, 3:9] == heights[:, 4:5, 3:4])  # level ground underneath
    for _ in range(100):
        assert not rest(env)[2].any()
    assert np.all(env.position[:, 2] > 0.2) and np.all(env.gravity[:, 2] < -0.98)
