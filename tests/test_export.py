"""Policies that walk without this repository; the env as other libraries want it."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

import export
from conftest import ROOT, save_policy
from env import EnvConfig


def test_the_shipped_policy_walks_on_plain_mujoco(tmp_path, capsys):
    export.main([str(ROOT / "checkpoints" / "a1-stiffness-rolt.pt"), str(tmp_path)])
    assert "equal to the bit in 150 states" in capsys.readouterr().out
    script = tmp_path / "deploy.py"
    script.write_text((ROOT / "examples" / "deploy.py").read_text())  # alone, in another place
    command = [sys.executable, "-I", str(script), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    walked, height = (float(done.stdout.split()[i]) for i in (1, -3))
    assert 6 < walked < 9 and 0.25 < height < 0.4


def test_policies_with_a_scan_or_a_long_memory_can_go_too(tmp_path):
    for policy, names in (("rolt", ["heights"]), ("rma", ["heights", "past"])):
        file = save_policy(tmp_path / "p.pt", policy=policy, task="terrain", scan=True)
        export.main([file, str(tmp_path / policy)])
        card = json.loads((tmp_path / policy / "policy.json").read_text())
        assert [*card["inputs"]] == ["legs", "action", *names]
        program = torch.export.load(tmp_path / policy / "policy.pt2").module()
        inputs = [torch.zeros(7, *shape[1:]) for shape in card["inputs"].values()]
        assert program(*inputs).shape == (7, 12)


def test_the_vector_env_keeps_gymnasiums_contract():
    checker = pytest.importorskip("gymnasium.utils.env_checker")
    sys.path.append(str(ROOT / "examples"))
    from vector_env import WalkingRobots

    envs = WalkingRobots("a1", 4, num_threads=1, config=EnvConfig(episode_seconds=0.2))
    checker.check_reset_seed_determinism(envs)
    checker.check_reset_return_type(envs)
    zeros, tries = np.zeros((4, 12), dtype=np.float32), []
    for _ in range(2):
        envs.reset(seed=1)
        tries.append(envs.step(zeros))
    assert checker.data_equivalence(tries[0], tries[1])
    observation, _ = envs.reset(seed=0)
    assert observation in envs.observation_space and set(observation) == {"legs", "action"}
    for step in range(1, 11):
        observation, reward, terminated, truncated, info = envs.step(zeros)
        assert observation in envs.observation_space and reward.shape == (4,)
        assert truncated.all() == (step == 10) and ("final_obs" in info) == (step == 10)
    last = info["final_obs"][2]
    assert last in envs.single_observation_space
    assert not np.array_equal(last["legs"], observation["legs"][2])  # the next episode's
