"""A run ends well whatever happens, and goes on from nothing but what fits. (tests/stress.py does the same at length.)"""

import os
import re
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import checkpoint
import processes
import train
from baselines import make_policy
from env import LocomotionEnv
from ppo import Critic
from robots import A1

COMMON = ["--policy", "mlp", "--threads", "1", "--envs", "8", "--minibatches", "2"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run of one iteration, and its checkpoint."""
    out = tmp_path_factory.mktemp("trained") / "run"
    train.main([*COMMON, "--steps", "192", "--out", str(out)])
    return out, checkpoint.load(out / "checkpoint.pt")


def resume(trained, content, tmp_path):
    """Resumes a copy of the run with another checkpoint.pt, for another iteration."""
    (tmp_path / "progress.csv").write_text((trained[0] / "progress.csv").read_text())
    checkpoint.save(content, tmp_path / "checkpoint.pt")
    train.main([*COMMON, "--steps", "384", "--out", str(tmp_path), "--resume"])


def changed(content, key, *rest):
    """A copy of nested dictionaries and lists with one value replaced, or removed if it is `...`."""
    inner = rest[0] if len(rest) == 1 else changed(content[key], *rest)
    if isinstance(content, list):
        return [inner if i == key else item for i, item in enumerate(content)]
    return {k: v for k, v in content.items() if k != key} | ({} if inner is ... else {key: inner})


@pytest.mark.parametrize(
    "path_and_value, says",
    [
        (["identity", ...], "is a policy, not a training"),
        (["identity", "envs", 16], "envs was 16, is 8; set it back"),
        (["identity", "processes", 4], r"processes was 4, is 1; .* --threads"),
        (["identity", "PPOConfig.clip", "0.1"], "PPOConfig.clip was 0.1, is 0.2"),
        (["identity", "weight of joint_error", "-1"], "weight of joint_error was -1, is -0.04"),
        (["identity", "FALL", "-5.0"], "FALL was -5.0, is -1.0"),
        (["identity", "TREAD", "0.2"], "TREAD was 0.2, is 0.31"),
        (["identity", "Robot.stiffness", "30.0"], "Robot.stiffness was 30.0, is 20.0"),
        (["iteration", ...], "does not say where"),
        (["stage", 1], "does not say where"),
        (["steps", "192"], "does not say where"),
        (["weights", "decoder.bias", ...], "weights.decoder.bias is missing"),
        (["weights", "decoder.bias", torch.zeros(13)], r"weights.decoder.bias is \(13,\) torch.float32, not \(12,\)"),
        (["critic", 3], "critic is not what it should be"),
        (["learner", "learning_rate", float("nan")], "learner.learning_rate is not finite"),
        (["learner", "optimizer", "state", 0, "exp_avg", torch.zeros(12).double()], "exp_avg is"),
        (["learner", "optimizer", "param_groups", 0, "params", 0, 1], "params is"),
        (["processes", []], "processes is not what it should be"),
        (["processes", 0, "env", "age", torch.zeros(1, dtype=torch.int64)], r"env.age is \(1,\)"),
        (["processes", 0, "env", "fault_index", torch.full((8,), 9)], "does not fit this run"),
        (["processes", 0, "env", "random", "bit_generator", "MT19937"], "does not fit this run"),
        (["processes", 0, "env", "state", torch.full((8, 1), torch.nan)], "env.state is not finite"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused_by_name(path_and_value, says, trained, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        resume(trained, changed(trained[1], *path_and_value), tmp_path)
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1 and re.search(says, error), error


def test_a_constant_that_an_older_run_did_not_know_is_no_contradiction(trained, tmp_path):
    resume(trained, changed(trained[1], "identity", "PPOConfig.clip", ...), tmp_path)
    assert checkpoint.load(tmp_path / "checkpoint.pt")["iteration"] == 2


def test_the_identity_of_a_run_knows_its_ablation(tmp_path):
    def dropout(policy):
        args = train.parse_arguments(["--policy", policy, "--out", str(tmp_path)])
        return train.identity(args).get("ROLTConfig.pe_dropout")

    assert [dropout(policy) for policy in ("rolt", "no-pe-drop", "module-pe", "mlp")] == ["0.75", "0.0", "0.75", None]


def test_a_start_from_a_file_takes_its_weights_and_statistics(trained, capsys):
    """Of the policy and the critic; what a policy.pt does not hold is said."""
    content, policy = trained[1], make_policy("mlp", A1)
    critic = Critic(LocomotionEnv("a1", 1).reset(), policy.normalizer)
    checkpoint.start_from(trained[0] / "checkpoint.pt", policy, critic)
    for module, key in ((policy, "weights"), (critic, "critic")):
        for name, tensor in module.state_dict().items():
            assert torch.equal(tensor, content[key][name]), name
    assert not capsys.readouterr().out
    checkpoint.start_from(trained[0] / "policy.pt", policy, critic)
    assert "holds no critic" in capsys.readouterr().out


def test_after_a_start_from_a_file_only_the_heights_are_measured_anew(trained, tmp_path):
    """A robot that walked on flat ground, where heights hardly vary, meets stairs; its joints' statistics are kept."""
    weights = trained[1]["weights"]
    legs, heights = torch.full((21,), 10.0), torch.tensor([100.0], dtype=torch.float64)
    weights = weights | {"normalizer.legs_mean": legs.double(), "normalizer.count": torch.tensor(1e9).double()}
    weights |= {"normalizer.heights_mean": heights, "normalizer.heights_square": heights**2}
    checkpoint.save(trained[1] | {"weights": weights, "critic": {}}, tmp_path / "flat.pt")
    words = ["--task", "terrain", "--steps", "192", "--out", str(tmp_path / "stairs"), "--init", str(tmp_path / "flat.pt")]
    train.main([*COMMON, *words])
    now = checkpoint.load(tmp_path / "stairs" / "policy.pt")["weights"]
    assert now["normalizer.legs_mean"] == pytest.approx(10.0, abs=0.01) and abs(now["normalizer.heights_mean"]) < 5
    assert now["normalizer.count"] == 1e9 + 2 * 8 * 24 * 4  # two rollouts, the first for the normalizer alone


@pytest.mark.parametrize(
    "text, kept",
    [
        ("iteration,x\n1,a\n2,b\n3,c\n", ["1,a", "2,b"]),  # 3: after the checkpoint
        ("iteration,x\n1,a\n2", ["1,a"]),  # torn
        ("iteration,x\n1,a\n\0\0,\xff\n2,b\n", ["1,a", "2,b"]),
        ("iteration,y\n1,a\n", []),  # columns of another version
        ("", []),
        (None, []),
    ],
)
def test_the_log_goes_on_after_the_checkpoints_row(text, kept, tmp_path):
    if text is not None:
        (tmp_path / "progress.csv").write_text(text, encoding="latin-1")
    progress = train.Progress(SimpleNamespace(out=tmp_path, steps=100), iteration=2, steps=10)
    progress._begin("iteration,x")
    assert (tmp_path / "progress.csv").read_text().splitlines() == ["iteration,x", *kept]
    assert (tmp_path / "progress.previous.csv").exists() == (text is not None and "y" in text)


def test_ctrl_c_twice_while_saving_does_no_harm(tmp_path, monkeypatch, capsys):
    save = checkpoint.save_next

    def interrupted(content, path):
        signal.raise_signal(signal.SIGINT)
        save(content, path)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(checkpoint, "save_next", interrupted)
    before = signal.getsignal(signal.SIGINT)
    train.main([*COMMON, "--steps", "1920", "--save-minutes", "1e-9", "--out", str(tmp_path)])
    content = checkpoint.load(tmp_path / "checkpoint.pt")
    assert content["iteration"] == 2  # the one in which it was pressed, while saving, and the next
    assert "stopped at 384 steps and saved" in capsys.readouterr().out and signal.getsignal(signal.SIGINT) is before


def test_a_full_disk_ends_the_run_in_one_line(tmp_path, monkeypatch, capsys):
    def full(content, file):
        file.write(b"half of it")
        raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 4854400 vs 4854292")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(SystemExit) as ended:
        train.main([*COMMON, "--steps", "192", "--out", str(tmp_path)])
    error = f"error: cannot write {tmp_path}/policy.pt: there is no room for it; what was saved there before is untouched\n"
    assert ended.value.code == 1 and capsys.readouterr().err == error
    assert sorted(file.name for file in tmp_path.iterdir()) == [".lock", "progress.csv"]


def ends_badly(rank, args, sync, stop):
    """Stands in for the training loop: process 1 ends as told, process 0 would wait for it for ever."""
    if rank == 1:
        if args.how == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        raise FloatingPointError("the gradient of decoder.bias is not finite")
    time.sleep(300)


@pytest.mark.parametrize(
    "how, says", [("killed", "was ended by SIGKILL; --resume goes on"), ("diverged", "decoder.bias is not finite: start anew with")]
)
def test_if_a_process_dies_so_do_the_others(how, says, tmp_path, capfd):
    (tmp_path / "checkpoint.pt").touch()
    started = time.monotonic()
    with pytest.raises(SystemExit) as ended:
        processes.run(ends_badly, SimpleNamespace(processes=2, out=tmp_path, how=how))
    error = capfd.readouterr().err
    assert ended.value.code == 1 and time.monotonic() - started < 280
    assert error.count("\n") == 1 and says in error


def test_a_diverged_robot_never_reaches_the_buffer(tmp_path, monkeypatch):
    """Numbers that are not finite, given to a robot in every step of a training: counted, and nothing else."""
    step = train.LocomotionEnv.step

    def broken(env, action):
        env._qvel[3, 8] = np.nan
        return step(env, action)

    monkeypatch.setattr(train.LocomotionEnv, "step", broken)
    train.main([*COMMON, "--steps", "192", "--out", str(tmp_path)])
    rows = (tmp_path / "progress.csv").read_text().splitlines()
    divergences = dict(zip(rows[0].split(","), rows[1].split(",")))["divergences"]
    assert divergences == "48"  # 24 steps for the normalizer, and 24
    weights = checkpoint.load(tmp_path / "policy.pt")["weights"].values()
    assert all(torch.isfinite(x).all() for x in weights)


def test_any_number_of_cores_can_share_the_robots(tmp_path, monkeypatch):
    for cores, used in ((1, 1), (2, 2), (6, 4), (12, 8), (20, 16), (28, 16)):
        monkeypatch.setattr(train, "num_cores", lambda: cores)  # noqa: B023
        assert train.parse_arguments(["--device", "cpu", "--out", str(tmp_path)]).processes == used


def test_the_papers_size_and_what_is_said_beside_it(tmp_path):
    args = train.parse_arguments(["--paper", "--envs", "1024", "--device", "cpu", "--out", str(tmp_path)])
    assert (args.envs, args.steps, args.epochs, args.minibatches) == (1024, 400_000_000, 5, 4)
