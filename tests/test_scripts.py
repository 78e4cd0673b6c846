"""The scripts as a user runs them: train, resume, evaluate; and what they say to wrong input."""

import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import checkpoint
import evaluate
import export
import train
from baselines import make_policy
from conftest import ROOT, env_of, save_policy
from faults import STIFF, TASKS
from ppo import Critic, PPOConfig
from robots import A1
from walk import read_csv

SMALL = "--envs 8 --minibatches 2 --epochs 1"  # an iteration has 192 steps


def plain(value):
    """What a checkpoint holds, tensors as bytes."""
    if isinstance(value, torch.Tensor):
        return value.dtype, value.shape, value.numpy().tobytes()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def same_run(one, other):
    """The same checkpoint to the bit, and the same rows but for the times."""
    no_time, runs = {"collect_seconds": 0, "update_seconds": 0}, []
    for run in (one, other):
        saved = checkpoint.load(run / "checkpoint.pt")
        table = [row | no_time for row in read_csv(run / "progress.csv")]
        assert len(table) == len(saved["rows"]) == saved["iteration"]
        runs.append(plain(saved | {"rows": table}))
    for name, value in runs[0].items():
        assert value == runs[1].pop(name), name
    assert not runs[1]


def interrupted(words, out):
    """Starts train.py, sends it SIGTERM as soon as it has saved, and waits for its end."""
    command = [sys.executable, ROOT / "train.py", *words.split(), out, "--save-minutes", "1e-9"]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while running.poll() is None and not (out / "checkpoint.pt").exists():
        time.sleep(0.05)
    running.send_signal(signal.SIGTERM)
    said, _ = running.communicate(timeout=300)
    assert running.returncode == 0 and "stopped at" in said, said


@pytest.mark.parametrize("processes, policy", [("1", "rma"), ("2", "rolt")])
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, processes, policy):
    """To the bit, over the change of stages, too; rows that a killed run wrote after its checkpoint
    are dropped."""
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    words = f"--policy {policy} {SMALL} --steps 960 --threads {processes} --out"
    interrupted(words, broken)
    with open(broken / "progress.csv", "a") as file:
        file.write("999,99999\n")
    train.main(f"{words} {broken} --resume".split())
    train.main(f"{words} {whole}".split())
    same_run(broken, whole)
    assert list(whole.glob("policy-*.pt"))  # kept on the way
    stages = checkpoint.load(whole / "policy.pt")["stages"]
    assert stages == ({"base": 960, "adaptation": 192} if policy == "rma" else {"ppo": 960})


def test_a_finished_run_says_so_mends_its_table_and_may_not_change(tmp_path, capsys):
    words = f"--threads 1 {SMALL} --steps 384 --out {tmp_path}".split()
    train.main([*words, "--precision", "fp32"])
    whole = (tmp_path / "progress.csv").read_text()
    (tmp_path / "progress.csv").write_text("iteration,steps\n1,x\n")
    train.main([*words, "--precision", "fp32", "--resume"])
    told = capsys.readouterr().out
    assert "it was finished already" in told and "nan" not in told
    assert (tmp_path / "progress.csv").read_text() == whole
    with pytest.raises(SystemExit, match="had --seed 0, --precision fp32"):
        train.main([*words, "--precision", "bf16", "--seed", "1", "--resume"])
    with pytest.raises(SystemExit):
        train.main(words)
    assert "holds a run already" in capsys.readouterr().err


def test_stairs_begin_with_the_flat_policy(tmp_path):
    """What reads the heights is new: its weights begin at 0, so that an MLP's answers are kept."""
    flat, stairs = tmp_path / "flat", tmp_path / "stairs"
    words = f"--policy mlp --threads 1 {SMALL} --steps 192 --out"
    train.main(f"{words} {flat}".split())
    train.main(f"{words} {stairs} --task terrain --init {flat}/checkpoint.pt".split())
    assert checkpoint.load(stairs / "policy.pt")["init"] == f"{flat}/checkpoint.pt"

    critic = Critic(env_of(1, extras=("privileged", "heights")).observe())
    before, _ = checkpoint.load_policy(flat / "policy.pt")
    after = make_policy("mlp", A1, TASKS["terrain"], True)
    checkpoint.start_from(flat / "policy.pt", after, critic)
    assert torch.equal(after.hidden[0].weight[:, :480], before.hidden[0].weight)
    assert not after.hidden[0].weight[:, 480:].any()
    told, heights = critic.network[0].weight.split([480 + 25, 192], dim=1)
    assert told.half().float().equal(told) and told.any() and not heights.any()  # critics, too
    for policy in ("rma", "rolt"):
        path = save_policy(tmp_path / f"{policy}.pt", policy=policy)
        checkpoint.start_from(path, make_policy(policy, A1, TASKS["terrain"], True), critic)
    loaded = env_of(1, faults=[(1, "payload:trunk:2")], extras=("privileged", "heights"))
    of_other_faults = Critic(loaded.observe())  # its heights begin a column later
    back = stairs / "policy.pt", before, critic
    for wrong in ((path, after, critic), back, (flat / "policy.pt", after, of_other_faults)):
        with pytest.raises(checkpoint.CheckpointError, match="does not fit"):
            checkpoint.start_from(*wrong)


def experiment(words, cards, folder, *more):
    """Runs one on fresh policies with these cards; returns the rows of its table."""
    files = [save_policy(folder / f"{i}.pt", **card) for i, card in enumerate(cards)]
    quick = f"{words} --seconds 0.1 --episodes 1 --threads 1 --out {folder}".split()
    evaluate.main([*quick, *more, *(["--checkpoints", *files] if files else [])])
    out = folder / words.replace(" --", "-")
    assert out.with_suffix(".png").stat().st_size > 1000
    return [] if words == "curves" else read_csv(out.with_suffix(".csv"))


MLP, ROLT, NO_FRAMES, ROAM = ({"policy": x} for x in ("mlp", "rolt", "no-leg-frames", "roam"))
STAIRS = [{"task": "terrain", "scan": True, "policy": name} for name in ("no-pe-drop", "rolt")]
NOISE = "0 0.05 0.1 0.15 0.2 0.3 0.4".split()
HEIGHTS = [f"{cm} cm" for cm in "1.4 3.2 5.0 6.8 8.6 10.4 12.2".split()]
PAIRS = "FR+FL FR+RR FR+RL FL+RR FL+RL RR+RL".split()
HARMS = "lock", "disable", "weaken to 0.75", "weaken to 0.5", "weaken to 0.25"
HEXAPODS = "healthy FRT MRT MLC FLC FLT FRC MRC MLT HLT HLC HRT HRC".split()
REAL_WORLD = ["healthy", "weaken", "weaken FR", "weaken RR", "weaken RL", "box", "skates"]
DEAD = [f"disable:{leg}_calf" for leg in A1.legs]


@pytest.mark.parametrize("words, cards, cases, rows", [
    ("stiffness", [MLP, NO_FRAMES, ROAM], ["healthy", "FR", "FL", "RR", "RL"], 15),
    ("damage", [{"robot": "hexapod", "task": "damage"}], HEXAPODS, 13),
    ("real_world", [{"robot": "go1"}], REAL_WORLD, 7),
    ("gaits", [ROLT], ["healthy", *STIFF], 20),
    ("low_frequency", STAIRS, NOISE, 14),
    ("high_frequency", STAIRS, NOISE, 14),
    ("stairs", STAIRS, [*HEIGHTS, *(f"{height} blind" for height in HEIGHTS)], 28),
    ("growth", [{"steps": 1_000_000}, {"steps": 2_000_000}], ["1.0", "2.0"], 6),
    ("legs", [ROLT, {"task": "two-legs"}], ["healthy", *STIFF, *DEAD], 18),
    ("matrix", [ROLT], [f"{joint}, {harm}" for joint in A1.joints for harm in HARMS], 60),
    ("matrix --pairs", [ROLT], [f"{pair}, {harm}" for pair in PAIRS for harm in HARMS], 30),
    ("senses", [ROLT], list("01234"), 5),
    ("curves", [ROLT], [], 0),
])  # fmt: skip
def test_experiments_tell_of_every_case(words, cards, cases, rows, tmp_path):
    table = experiment(words, cards, tmp_path)
    assert [*dict.fromkeys(row["case"] for row in table)] == cases and len(table) == rows
    methods = {row["method"] for row in table}
    names = {"growth": {"rolt"}, "legs": {"rolt stiffness", "rolt two-legs"}}
    assert methods == names.get(words, methods)


def test_snapshots_that_are_not_measured_anew_stay_and_two_faults_of_a_joint_are_two_rows(
    tmp_path, monkeypatch
):
    for steps, cases in ((2e6, ["2.0"]), (1e6, ["1.0", "2.0"]), (2e6, ["1.0", "2.0"])):
        rows = experiment("growth", [{"steps": int(steps)}], tmp_path)
        assert [row["case"] for row in rows] == [case for case in cases for _ in STIFF[1:]]

    task = replace(TASKS["stiffness"], unseen=("disable:FR_calf",))
    monkeypatch.setitem(TASKS, "stiffness", task)
    rows = experiment("stiffness", [MLP], tmp_path)
    told = [(row["case"], row["seen"]) for row in rows]
    assert told == [("healthy", "1"), ("FR", "1"), ("disable:FR_calf", "0")]


def test_no_ratio_is_clipped_with_stored_masks_whatever_the_rate(tmp_path, monkeypatch):
    monkeypatch.setattr(PPOConfig, "steps", 3)
    rows = experiment("dropout_ratio", [ROLT], tmp_path)
    stored = [row for row in rows if row["method"] == "stored masks"]
    assert {(row["clipped"], row["off_by"]) for row in stored} == {("0.0000", "1.0000")}


def test_mechanisms_tell_what_a_policy_does_not_read(tmp_path):
    rows = experiment("mechanisms", [{"policy": "module-pe"}, NO_FRAMES], tmp_path)
    found = {(row["method"], row["case"]): float(row["value"]) for row in rows}
    token = "another's action token"
    assert ("module-pe", token) not in found and found["no-leg-frames", token] > 0
    assert found["module-pe", "leg positions equal"] > 0


def test_what_has_learned_nothing_looks_everywhere(tmp_path):
    entropies = [float(row["entropy"]) for row in experiment("attention", STAIRS, tmp_path)]
    assert len(entropies) == 4 and min(entropies) > 0.8


def test_all_shipped_seeds_are_put_together(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "__file__", str(tmp_path / "evaluate.py"))
    (tmp_path / "checkpoints").mkdir()
    for name, seed in (("rolt", 0), ("rolt-seed2", 2), ("rolt-seed1", 1), ("mlp", 0)):
        path = tmp_path / "checkpoints" / f"a1-stiffness-{name}.pt"
        save_policy(path, seed=seed, policy=name.split("-")[0])
    rows = experiment("stiffness", [], tmp_path, "--methods", "rolt")
    assert [row["seed"] for row in rows][::5] == ["0", "1", "2"]


@pytest.mark.parametrize("script, words, says", [
    (train, "--robot a2", "a1"),
    (train, "--task damage", "is for hexapod"),
    (train, "--envs -3", "invalid count value"),
    (train, "--envs 7 --threads 2", "do not divide"),
    (train, "--epochs 1 --minibatches 1", "two steps"),
    (train, "--resume --out nowhere", "nothing to resume"),
    (train, "--out=", "is empty"),
    (train, f"{SMALL} --threads 1 --out /proc/here", "/proc/here"),
    (train, f"{SMALL} --threads 1 --out new --init text.pt", "not a whole"),
    (evaluate, "stiffness --robot a2", "invalid choice"),
    (evaluate, "stiffness --robot hexapod", "no such checkpoints/hexapod-st"),
    (evaluate, "stiffness --episodes 0", "at least one"),
    (evaluate, "stiffness --checkpoints missing.pt", "no checkpoint missing.pt"),
    (evaluate, "stiffness --checkpoints text.pt", "not a whole checkpoint"),
    (evaluate, "stiffness --checkpoints old.pt", "another version"),
    (evaluate, "stiffness --checkpoints other.pt", "on the hexapod, not on the a1"),
    (evaluate, "stiffness --checkpoints misfit.pt", "does not fit"),
    (evaluate, "stiffness --methods mlp --checkpoints good.pt", "not allowed"),
    (evaluate, "stiffness --checkpoints good.pt ./good.pt same.pt", "the same"),
    (evaluate, "stiffness --stairs 0", "--stairs is an option of watch"),
    (evaluate, "watch --checkpoints good.pt --film walk.mp4", "is a .gif"),
    (evaluate, "watch --checkpoints good.pt --film a.gif --fault melt:FR", "lock:FR_calf"),
    (export, "roam.pt exported", "ROAM draws its behaviour"),
])  # fmt: skip
def test_wrong_input_ends_in_one_line(script, words, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_policy("good.pt")
    save_policy("other.pt", robot="hexapod", task="damage")
    save_policy("roam.pt", policy="roam")
    good = checkpoint.load("good.pt")
    checkpoint.save(good, Path("same.pt"))
    checkpoint.save(good | {"policy": "module-pe"}, Path("misfit.pt"))
    torch.save(good | {"format": 1}, "old.pt")
    Path("text.pt").write_text("not a checkpoint")
    with pytest.raises(SystemExit) as ended:
        script.main(words.split())
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
    imports = re.findall(r"^(?:from|import) (\w+)", (ROOT / "rolt.py").read_text(), re.MULTILINE)
    assert set(imports) - sys.stdlib_module_names == {"torch"}
