"""A policy that was taken away answers as it did, and walks without this repository."""

import json
import subprocess
import sys

import torch

import export
from conftest import ROOT, save_policy


def test_the_shipped_policy_walks_on_plain_mujoco(tmp_path, capsys):
    export.main([str(ROOT / "checkpoints" / "a1-stiffness-rolt.pt"), str(tmp_path)])
    assert "equal to the bit in 150 states" in capsys.readouterr().out
    script = tmp_path / "deploy.py"
    script.write_text((ROOT / "deploy.py").read_text())  # alone, in another place
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
        assert [x["name"] for x in card["inputs"]] == ["legs", "action", *names]
        program = torch.export.load(tmp_path / policy / "policy.pt2").module()
        inputs = [torch.zeros(7, *x["shape"][1:]) for x in card["inputs"]]
        assert program(*inputs).shape == (7, 12)
