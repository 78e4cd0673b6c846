"""The scripts as a user runs them: train, resume, evaluate; and what they say to wrong input."""

import csv
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import checkpoint
import evaluate
import train
import watch
from baselines import make_policy
from faults import TASKS
from robots import A1, ROBOTS

ROOT = Path(__file__).resolve().parent.parent
SMALL = ["--envs", "8", "--minibatches", "2", "--epochs", "1"]  # an iteration has 192 steps
CARD = {"robot": "a1", "task": "stiffness", "policy": "rolt", "scan": False, "seed": 0, "steps": 0, "stages": {}, "init": None}


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def save_policy(path, **card):
    card, path = CARD | card, Path(path)
    policy = make_policy(card["policy"], ROBOTS[card["robot"]], TASKS[card["task"]], card["scan"])
    checkpoint.save(card | {"weights": policy.state_dict()}, path)
    return str(path)


def tensors(value, name=""):
    """(name, value) of all that a checkpoint holds."""
    if isinstance(value, dict | list | tuple):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from tensors(item, f"{name}.{key}")
    else:
        yield name, value


def same_run(one, other):
    """The same checkpoint to the bit (weights, optimiser, simulation, random states), and the same
    rows but for the times."""
    a, b = (dict(tensors(torch.load(run / "checkpoint.pt", weights_only=True))) for run in (one, other))
    assert a.keys() == b.keys()
    for name, x in a.items():
        assert torch.equal(x, b[name]) if isinstance(x, torch.Tensor) else x == b[name], name
    timeless = [[row | {"collect_seconds": 0, "update_seconds": 0} for row in rows(run / "progress.csv")] for run in (one, other)]
    assert timeless[0] == timeless[1] and len(timeless[0]) == a[".iteration"]


def interrupted(words, out, processes):
    """Starts train.py, sends it SIGTERM as soon as it has saved, and waits for its end."""
    command = [sys.executable, ROOT / "train.py", *words, "--threads", processes, "--out", out, "--save-minutes", "1e-9"]
    running = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while running.poll() is None and not (out / "checkpoint.pt").exists():
        time.sleep(0.05)
    running.send_signal(signal.SIGTERM)
    said, _ = running.communicate(timeout=60)
    assert running.returncode == 0 and "stopped at" in said, said


@pytest.mark.parametrize("processes, policy", [(1, "rma"), (2, "rolt")])
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, processes, policy):
    """To the bit, over the change of stages, too; rows that a killed run wrote after its checkpoint
    are dropped."""
    words = ["--robot", "a1", "--policy", policy, *SMALL, "--steps", "3840"]
    interrupted(words, tmp_path / "broken", processes)
    with open(tmp_path / "broken" / "progress.csv") as file:
        last = file.read().splitlines()[-1]
    with open(tmp_path / "broken" / "progress.csv", "a") as file:
        file.write("999" + last[last.index(",") :] + "\n")
    for out, more in (("broken", ["--resume"]), ("whole", [])):
        done = [sys.executable, ROOT / "train.py", *words, "--threads", processes, "--out", tmp_path / out, *more]
        assert subprocess.run(list(map(str, done)), capture_output=True).returncode == 0
    same_run(tmp_path / "broken", tmp_path / "whole")
    policies = sorted(path.name for path in (tmp_path / "whole").glob("policy-*.pt"))
    assert len(policies) >= 1  # kept on the way
    stages = checkpoint.load(tmp_path / "whole" / "policy.pt")["stages"]
    assert stages == ({"base": 3840, "adaptation": 768} if policy == "rma" else {"ppo": 3840})


def test_a_resumed_run_may_not_change(tmp_path, capsys):
    words = ["--threads", "1", *SMALL, "--steps", "384", "--out", str(tmp_path)]
    train.main([*words, "--precision", "fp32"])
    with pytest.raises(SystemExit) as ended:
        train.main([*words, "--precision", "bf16", "--seed", "1", "--resume"])
    assert "had --seed 0, --precision fp32" in str(ended.value)
    with pytest.raises(SystemExit):
        train.main(words)
    assert "holds a run already" in capsys.readouterr().err


def test_stairs_begin_with_the_flat_policy(tmp_path):
    """What reads the heights is new; an MLP's answers do not change at first, for their weights
    begin at 0."""
    quick = ["--threads", "1", *SMALL, "--steps", "192"]
    for policy in ("mlp", "rma", "rolt"):
        flat, stairs = tmp_path / f"flat-{policy}", tmp_path / f"stairs-{policy}"
        train.main([*quick, "--policy", policy, "--out", str(flat)])
        train.main([*quick, "--policy", policy, "--task", "terrain", "--out", str(stairs), "--init", f"{flat}/checkpoint.pt"])
        assert checkpoint.load(stairs / "policy.pt")["init"] == f"{flat}/checkpoint.pt"
    torch.manual_seed(0)
    before, _ = checkpoint.load_policy(tmp_path / "flat-mlp" / "policy.pt")
    after = make_policy("mlp", A1, TASKS["terrain"], True)
    checkpoint.start_from(tmp_path / "flat-mlp" / "policy.pt", after, torch.nn.Linear(1, 1))
    assert torch.equal(after.hidden[0].weight[:, :480], before.hidden[0].weight)
    assert not after.hidden[0].weight[:, 480:].any()
    with pytest.raises(checkpoint.CheckpointError, match="do not fit"):
        checkpoint.start_from(tmp_path / "flat-mlp" / "policy.pt", make_policy("rolt", A1, TASKS["terrain"], True), after)
    with pytest.raises(checkpoint.CheckpointError, match="do not fit"):  # nor the other way round
        checkpoint.start_from(tmp_path / "stairs-mlp" / "policy.pt", before, torch.nn.Linear(1, 1))


@pytest.mark.parametrize(
    "words, policies",
    [
        (["stiffness"], ["mlp", "no-leg-frames", "roam"]),
        (["gaits"], ["rolt"]),
        (["mechanisms"], ["module-pe", "no-leg-frames"]),
        (["dropout_ratio"], ["rolt"]),
    ],
)
def test_experiments_on_flat_ground(words, policies, tmp_path, capsys):
    files = [save_policy(tmp_path / f"{policy}.pt", policy=policy) for policy in policies]
    quick = [] if words == ["mechanisms"] else ["--seconds", "0.1"]
    evaluate.main([*words, "--checkpoints", *files, "--episodes", "2", "--threads", "1", *quick, "--out", str(tmp_path)])
    name = "gaits-a1" if words == ["gaits"] else words[0]
    assert (tmp_path / f"{name}.png").stat().st_size > 1000 and (tmp_path / f"{name}.csv").exists()
    if words == ["stiffness"]:
        table = rows(tmp_path / "stiffness.csv")
        assert [row["case"] for row in table[:10:2]] == ["healthy", "FR", "FL", "RR", "RL"] and len(table) == 30
    if words == ["dropout_ratio"]:
        table = {(row["masks"], float(row["rate"])): float(row["clipped"]) for row in rows(tmp_path / "dropout_ratio.csv")}
        assert table["stored", 0.2] == 0.0  # whatever the rate
    if words == ["mechanisms"]:
        table = {(row["method"], row["probe"]): float(row["value"]) for row in rows(tmp_path / "mechanisms.csv")}
        assert table["module-pe", "another's action token"] == 0.0 < table["no-leg-frames", "another's action token"]
        assert table["module-pe", "leg positions equal"] > 0


def test_experiments_of_other_robots(tmp_path):
    quick = ["--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", str(tmp_path)]
    evaluate.main(["damage", "--checkpoints", save_policy(tmp_path / "h.pt", robot="hexapod", task="damage"), *quick])
    cases = [row["case"] for row in rows(tmp_path / "damage.csv")]
    assert cases == "healthy FRT MRT MLC FLC FLT FRC MRC MLT HLT HLC HRT HRC".split()
    evaluate.main(["real_world", "--checkpoints", save_policy(tmp_path / "go1.pt", robot="go1"), *quick])
    cases = [row["case"] for row in rows(tmp_path / "real_world.csv")]
    assert cases == ["healthy", "weaken", "weaken FR", "weaken RR", "weaken RL", "box", "skates"]


def test_experiments_on_stairs(tmp_path, capsys):
    files = [save_policy(tmp_path / f"{name}.pt", policy=name, task="terrain", scan=True) for name in ("no-pe-drop", "rolt")]
    quick = ["--checkpoints", *files, "--episodes", "1", "--seconds", "0.1", "--threads", "1", "--out", str(tmp_path)]
    for name in ("low_frequency", "high_frequency", "stairs"):
        evaluate.main([name, *quick])
    assert [row["case"] for row in rows(tmp_path / "low_frequency.csv")][::2] == "0 0.05 0.1 0.15 0.2 0.3 0.4".split()
    assert [row["case"] for row in rows(tmp_path / "stairs.csv")][::2][:2] == ["1.4 cm", "3.2 cm"]
    evaluate.main(["attention", *quick])
    table = rows(tmp_path / "attention.csv")
    assert len(table) == 4 and min(float(row["entropy"]) for row in table) > 0.8  # what has learned nothing is even


def test_all_shipped_seeds_are_put_together(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "__file__", str(tmp_path / "evaluate.py"))
    (tmp_path / "checkpoints").mkdir()
    for name, seed in (("rolt", 0), ("rolt-seed2", 2), ("rolt-seed1", 1), ("mlp", 0)):
        save_policy(tmp_path / "checkpoints" / f"a1-stiffness-{name}.pt", seed=seed, policy=name.split("-")[0])
    evaluate.main(["stiffness", "--methods", "rolt", "--episodes", "1", "--seconds", "0.1", "--out", str(tmp_path)])
    assert [row["seed"] for row in rows(tmp_path / "stiffness.csv")][::5] == ["0", "1", "2"]


@pytest.mark.parametrize(
    "script, words, says",
    [
        (train, ["--robot", "a2"], "a1"),
        (train, ["--task", "swimming"], "stiffness"),
        (train, ["--task", "damage"], "is for hexapod"),
        (train, ["--policy", "lstm"], "rolt"),
        (train, ["--envs", "-3"], "invalid count value"),
        (train, ["--steps", "1.5"], "invalid count value"),
        (train, ["--envs", "7", "--threads", "2"], "do not divide"),
        (train, ["--epochs", "1", "--minibatches", "1"], "two steps"),
        (train, ["--resume", "--out", "nowhere"], "nothing to resume"),
        (train, [*SMALL, "--threads", "1", "--out", "/proc/here"], "/proc/here"),
        (train, [*SMALL, "--threads", "1", "--out", "new", "--init", "text.pt"], "not a whole checkpoint"),
        (evaluate, ["swimming"], "stiffness"),
        (evaluate, ["stiffness", "--robot", "a2"], "not for a2"),
        (evaluate, ["stiffness", "--robot", "hexapod"], "is for a1"),
        (evaluate, ["stiffness", "--episodes", "0"], "at least one"),
        (evaluate, ["stiffness", "--checkpoints", "missing.pt"], "no checkpoint missing.pt"),
        (evaluate, ["stiffness", "--checkpoints", "text.pt"], "not a whole checkpoint"),
        (evaluate, ["stiffness", "--checkpoints", "old.pt"], "another version"),
        (evaluate, ["stiffness", "--checkpoints", "nan.pt"], "norm.bias is not finite"),
        (evaluate, ["stiffness", "--checkpoints", "other.pt"], "on the hexapod, not on the a1"),
        (evaluate, ["stiffness", "--checkpoints", "misfit.pt"], "does not fit"),
        (evaluate, ["stiffness", "--methods", "mlp", "--checkpoints", "good.pt"], "leave one of them away"),
        (watch, ["--checkpoint", "good.pt", "--fault", "melt:FR", "--out", "a.gif"], "lock:FR_calf"),
        (watch, ["--checkpoint", "good.pt", "--out", "walk.mp4"], ".gif or a .png"),
        (watch, ["--checkpoint", "good.pt", "--fault", "healthy", "lock:FR_calf", "--out", "a.gif"], "one fault"),
    ],
)
def test_wrong_input_ends_in_one_line(script, words, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_policy("good.pt")
    save_policy("other.pt", robot="hexapod", task="damage")
    good = checkpoint.load("good.pt")
    checkpoint.save(good | {"policy": "module-pe"}, Path("misfit.pt"))
    checkpoint.save(good | {"weights": good["weights"] | {"norm.bias": torch.full((160,), torch.nan)}}, Path("nan.pt"))
    torch.save(good | {"format": 1}, "old.pt")
    Path("text.pt").write_text("not a checkpoint")
    with pytest.raises(SystemExit) as ended:
        script.main(words)
    error = capsys.readouterr().err if ended.value.code == 2 else str(ended.value.code)
    assert error.strip().count("\n") == 0 and "error: " in error and re.search(says, error), error


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


def test_the_model_needs_torch_alone():
    code = "import sys, rolt; sys.exit('mujoco' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
