"""The scripts as a user runs them: train, resume, evaluate, render; and what they say to wrong input."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import checkpoint
import evaluate
import train
from baselines import make_policy
from robots import A1

ROOT = Path(__file__).resolve().parent.parent
SMALL = ["--envs", "8", "--minibatches", "2", "--epochs", "1"]


def run(*words, cwd):
    """A script in a process of its own."""
    return subprocess.run([sys.executable, str(ROOT / words[0]), *map(str, words[1:])], cwd=cwd, capture_output=True, text=True)


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def weights(run):
    return checkpoint.load(run / "policy.pt")["weights"]


def test_train_resume_evaluate(tmp_path, capsys):
    """Two iterations of 192 steps, a third one after a break; the same three in one go end in the same bits."""
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    common = ["--robot", "a1", "--threads", "1", *SMALL]
    train.main([*common, "--steps", "384", "--out", str(broken)])
    train.main([*common, "--steps", "576", "--out", str(broken), "--resume"])
    train.main([*common, "--steps", "576", "--out", str(whole)])
    assert "test it: python evaluate.py stiffness" in capsys.readouterr().out

    progress = rows(broken / "progress.csv")
    assert [int(row["steps"]) for row in progress] == [192, 384, 576]
    timed = ("collect_seconds", "update_seconds", "falls", "episode_return", "episode_seconds")  # the last three: recent episodes
    for a, b in zip(progress, rows(whole / "progress.csv")):
        assert {k: v for k, v in a.items() if k not in timed} == {k: v for k, v in b.items() if k not in timed}
    assert all(torch.equal(a, b) for a, b in zip(weights(broken).values(), weights(whole).values()))
    fresh = make_policy("rolt", A1).state_dict()
    assert not all(torch.equal(a, b) for a, b in zip(weights(whole).values(), fresh.values()))
    assert (broken / "progress.png").stat().st_size > 1000

    for out in (tmp_path / "once", tmp_path / "again"):
        evaluate.main(
            ["stiffness", "--checkpoints", str(broken / "policy.pt"), "--episodes", "2", "--seconds", "0.4", "--out", str(out)]
        )
    result = rows(tmp_path / "once" / "stiffness.csv")
    assert [row["case"] for row in result[::2]] == ["healthy", "FR", "FL", "RR", "RL"]
    assert tuple(result[0]) == evaluate.COLUMNS
    assert {float(row["fall_time_s"]) for row in result} == {0.4}  # nobody falls that fast
    assert result == rows(tmp_path / "again" / "stiffness.csv")
    assert (tmp_path / "once" / "stiffness.png").stat().st_size > 1000


def test_two_processes_train_one_policy(tmp_path):
    """Started as a user does; and again, which must not touch what is there."""
    command = ["train.py", "--threads", "2", *SMALL, "--steps", "400", "--out", tmp_path / "run"]
    first = run(*command, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert len(rows(tmp_path / "run" / "progress.csv")) == 3
    before = (tmp_path / "run" / "policy.pt").read_bytes()
    second = run(*command, cwd=tmp_path)
    assert second.returncode == 2 and "holds a run already" in second.stderr
    other = run(*command, "--resume", "--seed", "1", cwd=tmp_path)
    assert other.returncode == 2 and "seed was 0, is 1" in other.stderr
    assert (tmp_path / "run" / "policy.pt").read_bytes() == before


@pytest.mark.parametrize(
    "words, says",
    [
        (["train.py", "--robot", "a2"], "a1"),
        (["train.py", "--task", "swimming"], "stiffness"),
        (["train.py", "--policy", "lstm"], "rolt"),
        (["train.py", "--envs", "-3"], "at least 1"),
        (["train.py", "--envs", "many"], "not a number"),
        (["train.py", "--steps", "nan"], "not a number"),
        (["train.py", "--steps", "1.5"], "whole number"),
        (["train.py", "--seed", "-1"], "whole number"),
        (["train.py", "--envs", "7", "--threads", "2"], "do not divide"),
        (["train.py", "--resume", "--out", "nowhere"], "nothing to resume"),
        (["train.py", "--out", "/proc/here"], "cannot write"),
        (["evaluate.py", "swimming"], "stiffness"),
        (["evaluate.py", "stiffness", "--robot", "a2"], "a1"),
        (["evaluate.py", "stiffness", "--methods", "magic"], "rolt"),
        (["evaluate.py", "stiffness", "--episodes", "0"], "at least 1"),
        (["evaluate.py", "stiffness", "--seconds", "-1"], "above 0"),
        (["evaluate.py", "stiffness", "--checkpoints", "missing.pt"], "no checkpoint missing.pt"),
        (["evaluate.py", "stiffness", "--checkpoints", "truncated.pt"], "not a whole checkpoint"),
        (["evaluate.py", "stiffness", "--checkpoints", "text.pt"], "not a whole checkpoint"),
        (["evaluate.py", "stiffness", "--checkpoints", "other.pt"], "not on the a1|unknown here"),
        (["evaluate.py", "stiffness", "--checkpoints", "misfit.pt"], "do not fit"),
        (["render.py", "good.pt", "--fault", "melt:FR"], "lock:FR_calf"),
        (["render.py", "good.pt", "--fault", "lock:MR_calf"], "no joint or leg"),
        (["render.py", "good.pt", "--out", "walk.mp4"], ".gif or a .png"),
    ],
)
def test_wrong_input_ends_in_one_line(words, says, tmp_path, capsys, monkeypatch):
    import re

    import render

    monkeypatch.chdir(tmp_path)
    card = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0, "seed": 0}
    good = card | {"weights": make_policy("rolt", A1).state_dict()}
    checkpoint.save(good, tmp_path / "good.pt")
    checkpoint.save(good | {"robot": "hexapod"}, tmp_path / "other.pt")
    checkpoint.save(good | {"policy": "module-pe"}, tmp_path / "misfit.pt")
    Path("truncated.pt").write_bytes(Path("good.pt").read_bytes()[:100_000])
    Path("text.pt").write_text("not a checkpoint")
    before = sorted(tmp_path.rglob("*"))

    script = {"train.py": train, "evaluate.py": evaluate, "render.py": render}[words[0]]
    with pytest.raises(SystemExit) as ended:
        script.main(words[1:])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: ") and re.search(says, error)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_failed_save_keeps_the_former_file(tmp_path, monkeypatch):
    path = tmp_path / "policy.pt"
    checkpoint.save({"value": 1}, path)

    def full_disk(content, file):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match="No space left on device.*untouched"):
        checkpoint.save({"value": 2}, path)
    monkeypatch.undo()
    assert checkpoint.load(path)["value"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["policy.pt"]


def test_a_checkpoint_is_never_executed(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    torch.save({"format": checkpoint.FORMAT, "weights": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(checkpoint.CheckpointError):
        checkpoint.load(tmp_path / "evil.pt")
    assert not (tmp_path / "executed").exists()


def test_pictures_are_written(tmp_path):
    """Where no off-screen rendering works, the script must say so in one line."""
    card = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("rolt", A1).state_dict()}, tmp_path / "policy.pt")
    done = run("render.py", "policy.pt", "--fault", "lock:FL_calf", "--seconds", "0.4", "--out", "walk.gif", cwd=tmp_path)
    if done.returncode == 0:
        from PIL import Image

        assert Image.open(tmp_path / "walk.gif").n_frames == 10
    else:
        assert done.returncode == 2 and "MUJOCO_GL" in done.stderr and done.stderr.count("\n") == 1
