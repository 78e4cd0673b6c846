"""The show behind the viewers: what can be wished for while the robot walks. (The viewers themselves want eyes.)"""

import sys

import numpy as np
import pytest

import checkpoint
import evaluate
from baselines import make_policy
from faults import lock, tow
from robots import A1
from watch import Show


@pytest.fixture
def show():
    return Show(make_policy("mlp", A1).eval(), "a1")


def test_the_fault_changes_while_it_walks(show):
    for _ in range(10):
        show.step()
    before, env = show.env.position.copy(), show.env
    show.wishes.put("lock:FR_calf\n")
    show.step()
    assert show.env is env and np.allclose(env.position, before, atol=0.1) and env.age[0] == 11  # no reset
    assert show.fault == lock("FR_calf") and env.world.bind("eq_active")[0].tolist() == [0, 0, 1] + [0] * 9
    assert not np.array_equal(show.model.geom_rgba, env.model.geom_rgba)  # it is red
    for _ in range(25):
        show.step()
    assert abs(env.joint_error[0, 0, 2]) < 0.02
    show.wishes.put("healthy")
    show.step()
    assert not env.world.bind("eq_active").any() and np.array_equal(show.model.geom_rgba, env.model.geom_rgba)


def test_a_box_comes_and_goes(show):
    size = show.model.nq
    show.obey("tow:RR")
    show.step()
    assert show.fault == tow("RR") and show.model.nq == show.data.qpos.size == size + 7
    show.obey("healthy")
    show.step()
    assert show.model.nq == size


def test_speed_again_and_quit(show):
    show.obey("0.4")
    show.step()
    assert show.env.command[0, 0] == 0.4 and show.said == "healthy, 0.4 m/s, scandots clean"
    show.obey("again")
    assert show.env.age[0] == 0 and not show.over
    show.obey("quit")
    assert show.over


def test_noise_changes_while_it_walks(show):
    show.obey("missing:12")
    show.step()
    assert (show.observation.heights == 0).all() and show.said == "healthy, 0.75 m/s, scandots missing:12"
    show.obey("clean+sigma:0.1")
    assert show.said == "healthy, 0.75 m/s, scandots sigma:0.1"
    show.obey("clean")
    show.step()
    assert (show.observation.heights != 0).all()


@pytest.mark.parametrize(
    "wish, says",
    [
        ("melt:FR", "lock:FR_calf"), ("lock:MR_calf", "no joint"), ("tow:MR", "no leg MR"), ("-1", "-1"),
        ("sigma:-1", "write clean, offset"), ("half-lock:RR_calf:5", "no stop at 5"),
        ("tow:RR+lock:MR_calf", "no joint"), ("skate:FR+half-lock:RR_calf:5", "no stop at 5"), ("9" * 400, "at most 10"),
    ],  # fmt: skip
)
def test_a_wish_that_cannot_be_read_changes_nothing(show, wish, says):
    show.obey("lock:RL_calf")
    show.obey(wish)
    assert says in show.said and show.fault == lock("RL_calf") and show.speed == 0.75
    assert show.env.world.bind("eq_active")[0].tolist() == [0] * 11 + [1]
    show.step()


@pytest.mark.parametrize(
    "words, says",
    [
        (["--fault", "melt:FR", "--checkpoint", "good.pt"], "lock:FR_calf"),
        (["--fault", "tow:MR", "--checkpoint", "good.pt"], "no leg MR"),
        (["--checkpoint", "missing.pt"], "no checkpoint missing.pt"),
        (["--robot", "go1", "--checkpoint", "good.pt"], "not on the go1"),
        (["--video", "walk.mp4"], "a .gif file"),
        (["--robot", "a2"], "a1"),
        (["--port", "99999"], "0 to 65535"),
        (["--speed", "1e6"], "up to 10"),
        (["--video", "walk.gif", "--seconds", "1e6"], "up to 120"),
        (["--video", "walk.gif", "--seconds", "0.001", "--checkpoint", "good.pt"], "at least 0.02 s"),
        (["--video", "/proc/here/walk.gif", "--checkpoint", "good.pt"], "choose another with --video"),
        (["--viewer", "desktop", "--checkpoint", "good.pt"], "set DISPLAY"),
    ],
)
def test_wrong_input_ends_in_one_line(words, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", ":99")  # a screen that is not there
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    card = {"robot": "a1", "task": "stiffness", "policy": "mlp", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("mlp", A1).state_dict()}, tmp_path / "good.pt")
    with pytest.raises(SystemExit) as ended:
        evaluate.main(["watch", *words])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1 and error.startswith("error: ") and says in error
