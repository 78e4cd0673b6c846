"""What takes too long for pytest: a run is killed, stopped, damaged and thrown about, and must come out whole.

    python tests/stress.py kill         # 50 SIGKILLs at random instants, a resume after each       (about 10 minutes)
    python tests/stress.py resume       # stopped at 5 random iterations, {1, 2} processes x {rolt, mlp, rma}     (10)
    python tests/stress.py fuzz         # 300 wrong argument lists and damaged checkpoints                         (3)
    python tests/stress.py flail        # a million env steps of random actions over all robots, faults, terrain  (5)
    python tests/stress.py kill 10 --seed 1      # ten, other ones

Ends with exit code 0 and a line of what was measured, or with an AssertionError. Leaves nothing behind.
"""

import argparse
import contextlib
import copy
import io
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import checkpoint  # noqa: E402
import evaluate  # noqa: E402
import render  # noqa: E402
import train  # noqa: E402
from env import LocomotionEnv  # noqa: E402
from faults import disable, half_lock, healthy, lock, skate, tow, weaken  # noqa: E402
from robots import ROBOTS  # noqa: E402
from terrain import TRAINING_MAP  # noqa: E402

SMALL = ["--envs", "8", "--minibatches", "2", "--save-minutes", "1e-6"]  # a checkpoint after every iteration of 192 steps
TIMING = ("collect_seconds", "update_seconds")  # the columns of progress.csv that may differ


# ---------------------------------------------------------------------- runs in processes of their own


def start(*words):
    """train.py in a session of its own, so that all its processes can be killed at one instant."""
    command = [sys.executable, str(ROOT / "train.py"), *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True)


def finish(process) -> None:
    error = process.communicate()[1]
    assert process.returncode == 0 and not error, error


def iterations(out: Path) -> int:
    """Whole rows of progress.csv."""
    path = out / "progress.csv"
    return max(0, path.read_text().count("\n") - 1) if path.exists() else 0


def saved(out: Path) -> dict:
    return checkpoint.load_newest(out / "checkpoint.pt")


def wait_for(condition, process) -> None:
    while not condition() and process.poll() is None:
        time.sleep(0.01)


def same_run(one: Path, other: Path) -> None:
    """The same checkpoint to the bit, and the same rows but for the times."""
    a, b = saved(one), saved(other)
    assert not (why := checkpoint.misfit(a, b, "checkpoint")), why
    for (name, x), (_, y) in zip(checkpoint.numbers(a), checkpoint.numbers(b), strict=True):
        assert torch.equal(x, y), name
    assert str(a) == str(b)  # whatever is no tensor
    tables = [[line.split(",") for line in (out / "progress.csv").read_text().splitlines()] for out in (one, other)]
    columns = [i for i, name in enumerate(tables[0][0]) if name not in TIMING]
    assert [[row[i] for i in columns] for row in tables[0]] == [[row[i] for i in columns] for row in tables[1]]


def kill(number: int, dice: random.Random, folder: Path) -> str:
    """SIGKILL to all processes of a run, a quarter of them while it starts. It ends as one that was never killed."""
    lost, ends = 0, []
    for threads, kills in ((1, number - number // 4), (2, number // 4)):
        out, whole = folder / f"killed{threads}", folder / f"whole{threads}"
        words, end = ["--policy", "mlp", *SMALL, "--threads", threads, "--steps"], 0
        for i in range(kills):
            process = start(*words, 10**6, "--out", out, *["--resume"] * (end > 0))
            if dice.random() < 0.75:
                wait_for(lambda: iterations(out) > end + 1, process)
                time.sleep(dice.uniform(0, 0.5))
            else:
                time.sleep(dice.uniform(0, 5))
            assert process.poll() is None, process.communicate()[1]
            done, before = iterations(out), end
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            end = saved(out)["iteration"] if (out / "checkpoint.pt").exists() else 0
            assert before <= end <= iterations(out), (before, end, iterations(out))
            lost = max(lost, done - end)
            print(f"{threads} processes, kill {i + 1}: iteration {before} -> {end}", flush=True)
        ends.append(end + 1)
        finish(start(*words, ends[-1] * 192, "--out", out, "--resume"))
        finish(start(*words, ends[-1] * 192, "--out", whole))
        same_run(out, whole)
    return f"{number} SIGKILLs in {sum(ends)} iterations: at most {lost} lost by one; the end is the same to the bit"


def resume(number: int, dice: random.Random, folder: Path) -> str:
    """Stopped by SIGTERM at `number` random iterations of 24 and resumed: the run that was not stopped, to the bit."""
    stops, steps = [], 24 * 192
    for processes in (1, 2):
        for policy in ("rolt", "mlp", "rma"):
            words = ["--policy", policy, *SMALL, "--steps", steps, "--threads", processes]
            whole, broken = folder / f"{policy}{processes}", folder / f"{policy}{processes}-broken"
            finish(start(*words, "--out", whole))
            for k in sorted(dice.sample(range(1, 23), number)):
                done = iterations(broken)
                process = start(*words, "--out", broken, *["--resume"] * broken.exists())
                wait_for(lambda: iterations(broken) >= max(k, done + 1), process)
                process.terminate()
                finish(process)
                stops.append(saved(broken)["iteration"])
            finish(start(*words, "--out", broken, "--resume"))
            same_run(whole, broken)
            print(f"{policy}, {processes} processes: stopped after {stops[-number:]}, the same to the bit", flush=True)
    return f"{len(stops)} stops, 6 runs: the same to the bit"


# ---------------------------------------------------------------------- wrong input

BAD = ["", " ", "-1", "0", "nan", "inf", "-inf", "1e400", "1e30", "1.5", "x", "--", "a1,go1", "٣", "\udcff", "x" * 5000]
QUICK = ["--episodes", "1", "--seconds", "0.02", "--out", "o"]
OPTIONS = {
    "train.py": ["--robot", "--task", "--policy", "--envs", "--steps", "--epochs", "--minibatches", "--seed", "--device",
                 "--threads", "--out", "--save-minutes", "--init", "--res", "--unknown"],
    "evaluate.py": ["stiffness", "--robot", "--methods", "--checkpoints", "--episodes", "--seconds", "--seed", "--threads"],
    "render.py": ["--fault", "--seconds", "--speed", "--seed", "--out"],
}  # fmt: skip


def wrong_words(dice: random.Random, good: Path) -> list[str]:
    """A command with one to three wrong values. What happens to be right is a run of one iteration."""
    script = dice.choice(list(OPTIONS))
    words = {
        "train.py": ["train.py", "--out", "new", "--steps", "192", "--threads", "1", "--envs", "8", "--minibatches", "2"],
        "evaluate.py": ["evaluate.py", "stiffness", "--checkpoints", str(good), *QUICK],
        "render.py": ["render.py", str(good), "--seconds", "0.1", "--out", "walk.gif"],
    }[script]  # fmt: skip
    for option in dice.sample(OPTIONS[script], dice.randint(1, 3)):
        words += [option, dice.choice(BAD)]
    return words


def places(value, path=()):
    """Every path into nested dictionaries and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


def damage(dice: random.Random, source: Path, target: Path) -> str:
    """Writes `source` to `target` with one thing wrong, either in its bytes or in what it holds. Returns what."""
    data = bytearray(source.read_bytes())
    how = dice.choice(["cut", "flip", "zero", "noise"] + 4 * ["remove", "replace", "tensor"])
    if how in ("cut", "flip", "zero", "noise"):
        at = dice.randrange(len(data))
        if how == "cut":
            del data[at:]
        elif how == "flip":
            data[at] ^= 1 << dice.randrange(8)
        else:
            data[at : at + 1000] = bytes(1000) if how == "zero" else dice.randbytes(1000)
        target.write_bytes(data)
        return f"{how} at {at}"
    content = copy.deepcopy(checkpoint.load(source))
    top = dice.choice(list(content))  # not always in the weights, which have the most places
    path = dice.choice([p for p in places(content) if p[0] == top])
    parent = content
    for key in path[:-1]:
        parent = parent[key]
    value = parent[path[-1]]
    if how == "tensor" and isinstance(value, torch.Tensor):
        wrong = [value[None], value.flatten()[:1], value.to(torch.complex64), value.short(), value.float() * torch.nan]
        parent[path[-1]] = dice.choice(wrong)
    elif how == "remove":
        del parent[path[-1]]
    else:
        wrong = [None, "x", 3, -7, 2.5, torch.nan, True, [], {}, [1], (2,), torch.zeros(3), {"a": 1}, 10**30]
        parent[path[-1]] = dice.choice(wrong)
    torch.save(content, target)
    return f"{how} {path} to {str(parent)[:100]}"


def call(words: list[str]) -> tuple[int, str]:
    """Exit code and stderr of a script, run in this process (a process of its own takes seconds)."""
    error, script = io.StringIO(), {"train.py": train, "evaluate.py": evaluate, "render.py": render}[words[0]]
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        try:
            script.main(words[1:])
            code = 0
        except SystemExit as end:
            code = end.code
        except BaseException:
            code = traceback.format_exc()
    return code, error.getvalue()


def fuzz(number: int, dice: random.Random, folder: Path) -> str:
    """Half of them wrong words, half damaged files. One in 25 in a process of its own."""
    os.chdir(folder)
    train_words = ["train.py", "--policy", "mlp", *SMALL, "--threads", "1", "--out"]
    assert call([*train_words, "good", "--steps", "384"])[0] == 0
    codes = {0: 0, 2: 0}
    for i in range(number):
        what = ""
        if i % 2:
            words = wrong_words(dice, Path("good/policy.pt"))
        else:
            script = dice.choice(["train.py", "evaluate.py", "render.py"])
            out = Path(f"damaged{i}")
            out.mkdir()
            files = ["checkpoint.pt"] if script == "train.py" else ["policy.pt", "checkpoint.pt"]
            source = Path("good") / dice.choice(files)
            what = damage(dice, source, out / source.name)
            words = {
                "train.py": [*train_words, str(out), "--steps", "576", "--resume"],
                "evaluate.py": ["evaluate.py", "stiffness", "--checkpoints", str(out / source.name), *QUICK],
                "render.py": ["render.py", str(out / source.name), "--seconds", "0.1", "--out", "walk.gif"],
            }[script]  # fmt: skip
        if i % 25 == 0:
            done = subprocess.run([sys.executable, str(ROOT / words[0]), *words[1:]], capture_output=True, text=True)
            code, error = done.returncode, done.stderr
        else:
            code, error = call(words)
        assert code in (0, 2) and error.count("\n") == (code == 2), f"{words}\n{what}\ncode {code}\n{error}"
        codes[code] += 1
    return f"{number} inputs: {codes[2]} refused in one line, {codes[0]} harmless"


# ---------------------------------------------------------------------- random actions


def every_fault(robot) -> tuple[list, list]:
    """Each kind of fault on each joint or leg; and those that hang something on a leg, which makes for another model."""
    faults, props = [healthy()], []
    for leg, pose in zip(robot.legs, robot.default_pose):
        faults += [kind(f"{leg}_{link.name}") for link in robot.links for kind in (lock, disable)]
        faults += [weaken(leg, 0.3), half_lock(f"{leg}_{robot.links[-1].name}", pose[-1])]
        props += [tow(leg), skate(leg)]
    return faults, props


def flail(number: int, dice: random.Random, folder: Path) -> str:
    """Uniform actions of ten times the usual size, on robots that have every fault there is, on flat ground and on terrain.
    Now and then some are given a state that is not finite, or nearly so."""
    worlds = [(robot, faults, None) for robot in ROBOTS.values() for faults in every_fault(robot)]
    worlds += [(robot, every_fault(robot)[0], TRAINING_MAP) for robot in ROBOTS.values()]
    n, divergences, given, steps = 256, 0, 0, number // 256 // len(worlds) + 1
    started = time.monotonic()
    for robot, faults, terrain in worlds:
        fastest, odds = 0.0, tuple((1 / len(faults), fault) for fault in faults)
        extras = ("privileged", "past", "situation")
        env = LocomotionEnv(robot, n, dice.randrange(1000), 0, odds, extras=extras, terrain=terrain)
        env.reset(random_ages=True)
        rng = np.random.default_rng(dice.randrange(1000))
        for step in range(steps):
            ids = rng.choice(n, 3, replace=False) if step % 10 == 5 else []
            for i in ids:
                array = (env._qpos, env._qvel)[rng.integers(2)]
                array[i, rng.integers(array.shape[1])] = rng.choice([np.nan, np.inf, 1e12, -1e20])
            observation, reward, terminated, truncated, info = env.step(rng.uniform(-10, 10, size=(n, env.num_actions)))
            given += len(ids)
            assert info["diverged"][ids].all() and terminated[info["diverged"]].all()
            rewards = {f"rewards {name}": value for name, value in info.pop("rewards").items()}
            last = {f"final {name}": x for name, x in info.pop("final_observation")._asdict().items()}
            for name, x in {**observation._asdict(), **last, **info, **rewards, "reward": reward}.items():
                assert np.isfinite(x).all(), (robot.name, step, name)
            fastest = max(fastest, np.abs(env._qvel).max())
        divergences += env.divergences
        what = f"{robot.name}, {faults[-1]} and others, {'terrain' if terrain else 'flat'}"
        print(f"{what}: {env.divergences} divergences, fastest {fastest:.0f} m/s or rad/s", flush=True)
    total, seconds = len(worlds) * steps * n, time.monotonic() - started
    return f"{total:,} steps, {total / seconds:,.0f}/s, all finite: {divergences} divergences, {given} of them given"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tests = {kill: 50, resume: 5, fuzz: 300, flail: 1_000_000}
    parser.add_argument("test", choices=[test.__name__ for test in tests])
    parser.add_argument("number", type=int, nargs="?")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    test, number = next((test, n) for test, n in tests.items() if test.__name__ == args.test)
    with tempfile.TemporaryDirectory() as folder:
        print(test(args.number or number, random.Random(args.seed), Path(folder).resolve()))
