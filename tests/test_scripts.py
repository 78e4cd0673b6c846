"""The scripts as a user runs them: train, resume, evaluate, render; and what they say to wrong input."""

import csv
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import checkpoint
import cli
import evaluate
import train
import watch
from baselines import METHODS, make_policy
from faults import healthy
from noise import ScanNoise
from plots import learning_curve
from robots import A1, ROBOTS

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


def same_run(one, other):
    """The same checkpoint to the bit (weights, optimiser, simulation, random states), and the same rows but for the times."""
    a, b = (checkpoint.load(run / "checkpoint.pt") for run in (one, other))
    assert a["iteration"] == b["iteration"] and checkpoint.misfit(a, b, "") is None
    for (name, x), (_, y) in zip(checkpoint.numbers(a), checkpoint.numbers(b), strict=True):
        assert torch.equal(x, y), name
    tables = [[row | {"collect_seconds": 0, "update_seconds": 0} for row in rows(run / "progress.csv")] for run in (one, other)]
    assert tables[0] == tables[1] and len(tables[0]) == a["iteration"]


def test_train_resume_evaluate(tmp_path, capsys):
    """Two iterations of 192 steps, a third one after a break; the same three in one go end in the same bits."""
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    common = ["--robot", "a1", "--threads", "1", *SMALL]
    train.main([*common, "--steps", "384", "--out", str(broken)])
    train.main([*common, "--steps", "576", "--out", str(broken), "--resume"])
    train.main([*common, "--steps", "576", "--out", str(whole)])
    assert "test it: python evaluate.py stiffness --robot a1 --checkpoints" in capsys.readouterr().out

    progress = rows(broken / "progress.csv")
    assert [int(row["steps"]) for row in progress] == [192, 384, 576]
    same_run(broken, whole)
    fresh = make_policy("rolt", A1).state_dict()
    assert not all(torch.equal(a, b) for a, b in zip(weights(whole).values(), fresh.values()))
    assert (broken / "progress.png").stat().st_size > 1000

    for out in (tmp_path / "once", tmp_path / "again"):
        evaluate.main(
            ["stiffness", "--checkpoints", str(broken / "policy.pt"), "--episodes", "2", "--seconds", "0.4", "--out", str(out)]
        )
    result = rows(tmp_path / "once" / "stiffness.csv")
    assert [row["case"] for row in result[::2]] == ["healthy", "FR", "FL", "RR", "RL"]
    columns = ("method", "checkpoint", "seed", "case", "episode", "distance_m", "fall_time_s", "episode_return")
    assert tuple(result[0]) == columns
    assert {float(row["fall_time_s"]) for row in result} == {0.4}  # nobody falls that fast
    assert result == rows(tmp_path / "again" / "stiffness.csv")
    assert (tmp_path / "once" / "stiffness.png").stat().st_size > 1000


def test_two_processes_train_one_policy_and_go_on_to_the_bit(tmp_path, capsys):
    """Started as a user does; and again, which must not touch what is there."""
    command = ["train.py", "--threads", "2", *SMALL]
    for steps, *words in ((192, "--out", "broken"), (400, "--out", "broken", "--resume"), (400, "--out", "whole")):
        done = run(*command, "--steps", steps, *words, cwd=tmp_path)
        assert done.returncode == 0 and not done.stderr, done.stderr
    same_run(tmp_path / "broken", tmp_path / "whole")
    assert len(rows(tmp_path / "whole" / "progress.csv")) == 3
    before = (tmp_path / "whole" / "policy.pt").read_bytes()
    for words, says in (([], "holds a run already"), (["--resume", "--seed", "1"], "seed was 0, is 1")):
        with pytest.raises(SystemExit) as ended:
            train.main([*command[1:], "--out", str(tmp_path / "whole"), *words])
        assert ended.value.code == 2 and says in capsys.readouterr().err
    assert (tmp_path / "whole" / "policy.pt").read_bytes() == before


@pytest.mark.parametrize("policy", ["rma", "roam"])
def test_a_run_of_several_stages_goes_on_to_the_bit(policy, tmp_path, monkeypatch, capsys):
    """Ten iterations, nine tenths of them for the first stages; interrupted in a first and in the last stage."""
    common = ["--policy", policy, "--threads", "1", *SMALL, "--steps", "1920"]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    train.main([*common, "--out", str(whole)])
    summarise, calls = train.summarise, []

    def interrupt(*arguments):
        calls.append(1)
        if len(calls) in (3, 9):
            signal.raise_signal(signal.SIGINT)
        return summarise(*arguments)

    monkeypatch.setattr(train, "summarise", interrupt)
    for resume in ([], ["--resume"], ["--resume"]):
        train.main([*common, "--out", str(broken), *resume])
    stages = [row["stage"] for row in rows(whole / "progress.csv")]
    assert stages == (["0"] * 9 + ["1"] if policy == "rma" else ["0"] * 5 + ["1"] * 4 + ["2"])
    same_run(broken, whole)
    with pytest.raises(SystemExit):
        train.main([*common, "--out", str(whole), "--resume", "--steps", "3840"])
    assert "steps was 1920, is 3840" in capsys.readouterr().err
    train.main([*common, "--out", str(tmp_path / "after"), "--init", str(whole / "policy.pt")])
    assert [row["stage"] for row in rows(tmp_path / "after" / "progress.csv")] == stages


def test_all_methods_in_turn_and_evaluated_together(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["--policy", "all", "--threads", "1", *SMALL, "--steps", "192"]
    train.main(command)
    files = [f"runs/a1-stiffness-{name}-seed0/policy.pt" for name in METHODS]
    before = [Path(file).stat().st_mtime_ns for file in files]
    train.main(command)  # all is finished: nothing is touched
    assert [Path(file).stat().st_mtime_ns for file in files] == before
    quick = ["--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", "out"]
    evaluate.main(["stiffness", "--checkpoints", *files, *quick])
    assert list(dict.fromkeys(row["method"] for row in rows(Path("out/stiffness.csv")))) == list(METHODS)
    capsys.readouterr()
    evaluate.main(["dropout_ratio", "--checkpoints", "runs/a1-stiffness-rolt-seed0/policy.pt", "--out", "out"])
    table = {(row["masks"], float(row["rate"])): row for row in rows(Path("out/dropout_ratio.csv"))}
    assert all(float(table["stored", rate][k]) == pytest.approx(1, abs=1e-4) for rate in (1e-4, 0.2) for k in ("low", "high"))
    assert float(table["fresh", 0.2]["high"]) > 1.01 > float(table["none", 1e-4]["high"])
    with pytest.raises(SystemExit):
        evaluate.main(["dropout_ratio", "--checkpoints", files[0], "--out", "out"])
    assert "for rolt, not for mlp" in capsys.readouterr().err


def test_noise_tests_and_attention_on_stairs(tmp_path, capsys):
    quick = ["--threads", "1", *SMALL, "--steps", "192"]
    flat, stairs, ablation = (str(tmp_path / name) for name in ("flat", "stairs", "ablation"))
    train.main([*quick, "--out", flat])
    train.main([*quick, "--task", "terrain", "--out", stairs, "--init", f"{flat}/checkpoint.pt"])
    train.main([*quick, "--task", "terrain", "--out", ablation, "--init", f"{flat}/policy.pt", "--policy", "no-pe-drop"])
    assert checkpoint.load(f"{stairs}/policy.pt")["init"] == f"{flat}/checkpoint.pt"
    with pytest.raises(SystemExit):
        train.main([*quick, "--task", "terrain", "--out", str(tmp_path / "mlp"), "--init", f"{flat}/policy.pt", "--policy", "mlp"])
    assert "do not fit this policy" in capsys.readouterr().err
    train.main([*quick, "--robot", "go1", "--out", str(tmp_path / "go1"), "--init", f"{flat}/checkpoint.pt"])  # as many joints
    with pytest.raises(SystemExit):
        train.main([*quick, "--robot", "hexapod", "--out", str(tmp_path / "hexapod"), "--init", f"{flat}/policy.pt"])
    assert "do not fit this policy" in capsys.readouterr().err
    files = [f"{stairs}/policy.pt", f"{ablation}/policy.pt"]
    test = ["--checkpoints", *files, "--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", str(tmp_path)]
    for name in ("low_frequency", "high_frequency"):
        evaluate.main([name, *test])
        assert [row["case"] for row in rows(tmp_path / f"{name}.csv")][::2] == ["0", "0.05", "0.1", "0.2", "0.4", "0.8", "1.6"]
    evaluate.main(["attention", *test])
    entropies = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if "entropy" in line]
    table = [(row["method"], row["scan"]) for row in rows(tmp_path / "attention.csv")]
    assert table == [(name, scan) for scan in ("clean", "4 patches missing") for name in ("rolt", "no-pe-drop")]
    assert len(entropies) == 4 and min(entropies) > 0.95  # a gaze that has learned nothing is even
    assert all((tmp_path / f"{name}.png").stat().st_size > 1000 for name in ("low_frequency", "high_frequency", "attention"))


def test_tests_on_stairs_ask_for_their_ground_and_their_noise(tmp_path, monkeypatch):
    asked = []

    def record(args, cases, speed, terrain, noise):
        assert list(cases.values()) == [healthy()] and speed == 0.5 and terrain.columns == ("stairs",)
        asked.append((*cases, *set(terrain.levels), noise))
        figures = {"distance_m": "1", "fall_time_s": "1", "episode_return": "1"}
        return [{"method": "rolt", "seed": 0, "case": case, "episode": 0} | figures for case in cases]

    monkeypatch.setattr("evaluate.run_cases", record)
    card = {"robot": "a1", "task": "terrain", "policy": "rolt", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("rolt", A1).state_dict()}, tmp_path / "policy.pt")
    for name in ("stairs", "low_frequency", "high_frequency"):
        evaluate.main([name, "--checkpoints", str(tmp_path / "policy.pt"), "--out", str(tmp_path)])

    heights = dict(zip(("1.4 cm", "3.2 cm", "5.0 cm", "6.8 cm", "8.6 cm", "10.4 cm", "12.2 cm"), range(-2, 5)))
    expected = [(case, level, ScanNoise()) for case, level in heights.items()]
    expected += [(f"{case} blind", level, ScanNoise(missing_patches=12)) for case, level in heights.items()]
    for kind in ("offset", "sigma"):
        expected += [(f"{scale:g}", 0, ScanNoise(**{kind: scale})) for scale in (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)]
    assert asked == expected


def test_two_variants_of_a_method_are_not_taken_for_one(tmp_path):
    card = {"robot": "a1", "task": "stiffness", "policy": "mlp", "steps": 0, "seed": 0}
    files = [tmp_path / "one.pt", tmp_path / "two" / "policy.pt", tmp_path / "other-seed.pt"]
    files[1].parent.mkdir()
    for file, seed in zip(files, (0, 0, 1)):
        checkpoint.save(card | {"seed": seed, "weights": make_policy("mlp", A1).state_dict()}, file)
    quick = ["--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", str(tmp_path)]
    evaluate.main(["stiffness", "--checkpoints", *map(str, files), *quick])
    assert [row["method"] for row in rows(tmp_path / "stiffness.csv")][::5] == ["mlp (one)", "mlp (two)", "mlp"]
    checkpoint.save(card | {"steps": 9, "weights": make_policy("mlp", A1).state_dict()}, files[0])  # trained for longer
    evaluate.main(["stiffness", "--checkpoints", str(files[0]), str(files[2]), *quick])
    assert [row["method"] for row in rows(tmp_path / "stiffness.csv")][::5] == ["mlp (one)", "mlp (other-seed)"]


def test_tables_are_of_all_shipped_seeds_and_pictures_of_the_first(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "__file__", str(tmp_path / "evaluate.py"))
    (tmp_path / "checkpoints").mkdir()
    card = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0}
    for name, seed in (("rolt", 0), ("rolt-seed2", 2), ("rolt-seed1", 1)):
        content = card | {"seed": seed, "weights": make_policy("rolt", A1).state_dict()}
        checkpoint.save(content, tmp_path / "checkpoints" / f"a1-stiffness-{name}.pt")
    args = SimpleNamespace(checkpoints=None, methods=["rolt"], task="stiffness", robot="a1")
    for experiment, seeds in (("stiffness", [0, 1, 2]), ("gaits", [0]), ("dropout_ratio", [0])):
        args.experiment = experiment
        assert [card["seed"] for _, card in evaluate.find_policies(args).values()] == seeds


def test_damage_test_stands_beside_the_papers(tmp_path, capsys):
    card = {"robot": "hexapod", "task": "damage", "policy": "rolt", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("rolt", ROBOTS["hexapod"]).state_dict()}, tmp_path / "policy.pt")
    quick = ["--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", str(tmp_path)]
    evaluate.main(["damage", "--checkpoints", str(tmp_path / "policy.pt"), *quick])
    cases = [row["case"] for row in rows(tmp_path / "damage.csv")]
    assert cases == "healthy FRT MRT MLC FLC FLT FRC MRC MLT HLT HLC HRT HRC".split()
    assert "14.28 ± 2.93" in capsys.readouterr().out


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
        (["train.py", "--envs", "1e9"], "at most 65536"),
        (["train.py", "--threads", "1e6"], "at most"),
        (["train.py", "--res"], "unrecognized"),
        (["train.py", "--out", "x" * 5000], "cannot write"),
        (["train.py", "--envs", "7", "--threads", "2"], "do not divide"),
        (["train.py", "--epochs", "1", "--minibatches", "1"], "at least 2 minibatches"),
        (["train.py", "--resume", "--out", "nowhere"], "nothing to resume"),
        (["train.py", "--out", "/proc/here"], "cannot write"),
        (["evaluate.py", "swimming"], "stiffness"),
        (["evaluate.py", "stiffness", "--robot", "a2"], "a1"),
        (["evaluate.py", "stiffness", "--methods", "magic"], "rolt"),
        (["evaluate.py", "stiffness", "--episodes", "0"], "at least 1"),
        (["evaluate.py", "stiffness", "--seconds", "-1"], "above 0"),
        (["evaluate.py", "stiffness", "--seconds", "1e308"], "up to 3600"),
        (["evaluate.py", "stiffness", "--checkpoints", "x" * 5000], "no checkpoint"),
        (["evaluate.py", "stiffness", "--checkpoints", "nan.pt"], "weights.norm.bias is not finite"),
        (["evaluate.py", "stiffness", "--checkpoints", "missing.pt"], "no checkpoint missing.pt"),
        (["evaluate.py", "stiffness", "--checkpoints", "truncated.pt"], "not a whole checkpoint"),
        (["evaluate.py", "stiffness", "--checkpoints", "text.pt"], "not a whole checkpoint"),
        (["evaluate.py", "stiffness", "--checkpoints", "other.pt"], "not on the a1|unknown here"),
        (["evaluate.py", "stiffness", "--checkpoints", "misfit.pt"], "do not fit"),
        (["render.py", "good.pt", "--fault", "melt:FR"], "lock:FR_calf"),
        (["render.py", "good.pt", "--fault", "lock:MR_calf"], "no joint or leg"),
        (["render.py", "good.pt", "--out", "walk.mp4"], ".gif or a .png"),
        (["render.py", "good.pt", "--fault", "healthy", "lock:FR_calf", "--out", "walk.gif"], "one fault"),
        (["evaluate.py", "stiffness", "--methods", "mlp", "--checkpoints", "good.pt"], "leave one of them away"),
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
    checkpoint.save(good | {"weights": good["weights"] | {"norm.bias": torch.full((160,), torch.nan)}}, tmp_path / "nan.pt")
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


def test_a_robot_that_no_task_names_is_told_where_to_be_named(monkeypatch, capsys):
    monkeypatch.setitem(ROBOTS, "new", A1)
    for script in (train, watch):
        with pytest.raises(SystemExit) as ended:
            script.main(["--robot", "new"])
        error = capsys.readouterr().err
        assert ended.value.code == 2 and error.count("\n") == 1 and "name it in one of TASKS" in error


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


def test_one_altered_byte_is_noticed_and_the_file_before_is_used(tmp_path):
    path = tmp_path / "checkpoint.pt"
    for value in (1.0, 2.0, 3.0):
        checkpoint.save_next({"weights": torch.full((1000,), value)}, path)
    assert checkpoint.load_newest(path)["weights"][0] == 3.0
    content = bytearray(path.read_bytes())
    content[content.index(torch.full((4,), 3.0).numpy().tobytes()) + 6] ^= 1
    path.write_bytes(content)
    with pytest.raises(checkpoint.CheckpointError, match="not a whole checkpoint"):
        checkpoint.load(path)
    assert checkpoint.load_newest(path)["weights"][0] == 2.0
    (tmp_path / "checkpoint.pt.previous").write_text("gone, too")
    with pytest.raises(checkpoint.CheckpointError):
        checkpoint.load_newest(path)


def test_a_checkpoint_is_never_executed(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    torch.save({"format": checkpoint.FORMAT, "weights": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(checkpoint.CheckpointError):
        checkpoint.load(tmp_path / "evil.pt")
    assert not (tmp_path / "executed").exists()


def test_two_trainings_never_share_a_folder(tmp_path, capsys):
    lock = cli.lock_folder(tmp_path)
    if lock is None:
        pytest.skip("this system has no file locks")
    with pytest.raises(SystemExit) as ended:
        train.main(["--threads", "1", *SMALL, "--steps", "192", "--out", str(tmp_path)])
    assert ended.value.code == 2 and "another process is training" in capsys.readouterr().err
    lock.close()
    train.main(["--threads", "1", *SMALL, "--steps", "192", "--out", str(tmp_path)])


def test_a_folder_in_use_is_said_once_by_two_processes(tmp_path):
    lock = cli.lock_folder(tmp_path)
    if lock is None:
        pytest.skip("this system has no file locks")
    done = run("train.py", "--threads", "2", *SMALL, "--steps", "384", "--out", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "another process is training" in done.stderr


def test_a_torn_row_does_not_stop_the_learning_curve(tmp_path):
    header = "steps,speed,commanded_speed,episode_return,episode_seconds,sigma,kl"
    (tmp_path / "progress.csv").write_text(f"{header}\n1,0,0,1,1,1,0\n2,0,0\n3,0,0,1,1,1,0,9\n4,0,0,1,1,1,0\n")
    learning_curve(tmp_path / "progress.csv", tmp_path / "progress.png")
    assert (tmp_path / "progress.png").stat().st_size > 1000


def test_moving_pictures_are_written_without_a_display(tmp_path, monkeypatch):
    """Where no off-screen rendering works, the scripts must say so in one line."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    card = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0, "seed": 0}
    checkpoint.save(card | {"weights": make_policy("rolt", A1).state_dict()}, tmp_path / "policy.pt")
    short = ["--seconds", "0.4"]
    one = run("render.py", "policy.pt", "--fault", "lock:FL_calf", *short, "--out", "one.gif", cwd=tmp_path)
    all_cases = ["--checkpoints", "policy.pt", "--episodes", "1", *short, "--out", ".", "--video", "all.gif"]
    several = run("evaluate.py", "stiffness", *all_cases, cwd=tmp_path)
    if one.returncode:
        assert all(d.returncode == 2 and "MUJOCO_GL" in d.stderr and d.stderr.count("\n") == 1 for d in (one, several))
        pytest.skip(f"nothing can be rendered here: {one.stderr}")
    assert several.returncode == 0, several.stderr
    one, several = Image.open(tmp_path / "one.gif"), Image.open(tmp_path / "all.gif")
    assert (one.n_frames, one.size) == (10, (480, 300))  # every second step of 20
    assert (several.n_frames, several.size) == (5, (3 * 240, 2 * 160))  # every fourth; five cases
    colours = [len(np.unique(np.asarray(film.convert("RGB")).reshape(-1, 3), axis=0)) for film in (one, several)]
    assert min(colours) > 10  # something is to be seen
