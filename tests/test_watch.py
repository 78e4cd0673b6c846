"""The show behind the viewers, without a viewer; and films."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import watch
from conftest import ROOT, fresh_policy, save_policy
from faults import HEALTHY
from terrain import Terrain


@pytest.fixture
def show():
    policy = fresh_policy("rolt", "terrain", True)
    return watch.Show(policy, "a1", HEALTHY, 0.75, 0, Terrain(("stairs",), (0,)), "clean")


def test_the_robot_walks_on_with_what_it_was_told(show):
    for _ in range(3):
        show.step()
    assert show.data.time == pytest.approx(0.06) and show.data.qpos[2] > 0.2
    assert np.array_equal(show.data.qpos, show.env.world.bind("qpos")[0])

    env = show.env
    show.words.put("0.3")
    show.words.put("lock:RL_calf")
    show.step()
    assert show.env is env and show.fault == "lock:RL_calf"  # without a reset
    assert env.world.bind("eq_active")[0].nonzero()[0].tolist() == [11] and env.command[0, 0] == 0.3

    show.hear("offset:0.2+missing:3")  # noise is drawn with an episode: a new one
    assert show.noise == "offset:0.2+missing:3" and show.fault == "lock:RL_calf"
    assert show.env is not env and show.env.scan.missing[0].sum() == 3 * 16
    assert show.said == "lock:RL_calf, 0.3 m/s, offset:0.2+missing:3"


def test_skates_begin_a_new_episode_and_again_does(show):
    flat = watch.Show(show.policy, "a1", HEALTHY, 0.75, 0, None, "clean")
    for word in ("skate:FR", "again"):
        env = flat.env
        flat.hear(word)
        assert flat.env is not env and flat.fault == "skate:FR" and flat.data.qpos.size == 20


def test_a_word_that_cannot_be_read_changes_nothing(show):
    env, observation = show.env, show.observation
    unread = {"melt:FR": "lock:FR_calf", "lock:MR_calf": "no joint or leg", "sigma:-1": "from 0 on"}
    for word, why in unread.items():
        show.hear(word)
        assert why in show.said and show.fault == HEALTHY
        assert show.env is env and show.observation is observation


def test_films_are_written_without_a_display(tmp_path, monkeypatch):
    """Or with one that is gone. Where nothing can be drawn, the script must say so in one line."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("DISPLAY", ":99")
    save_policy(tmp_path / "policy.pt")
    words = "watch --fault lock:FL_calf --checkpoints policy.pt --film one.gif --seconds 0.4"
    command = [sys.executable, ROOT / "evaluate.py", *words.split()]
    one = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    if one.returncode:
        assert "MUJOCO_GL" in one.stderr and one.stderr.count("\n") == 1
        pytest.skip(f"nothing can be drawn here: {one.stderr}")
    film = Image.open(tmp_path / "one.gif")
    assert (film.n_frames, film.size) == (10, (480, 300))  # every second step of 20
    assert len(film.convert("RGB").getcolors(1 << 16)) > 10  # something is to be seen


def test_it_tells_what_is_earned_and_where_legs_look_and_paints_nothing_but_what_is_broken(show):
    show.hear("lock:RL_calf@0.04:0.08")
    red = []
    for _ in range(6):
        show.step()
        bodies = show.model.geom_bodyid[show.model.geom_rgba[:, 0] == np.float32(0.85)]
        red.append({show.model.body(body).name for body in bodies})
    assert red == [set(), set(), {"RL_calf"}, {"RL_calf"}, set(), set()]
    assert len(show.terms) == 9 and [*show.attention] == ["legs", "action", "patches"]
    assert np.sum([*show.attention.values()], axis=0) == pytest.approx([1] * 4, abs=1e-5)
