"""Policies and runs as files: saved whole or not at all, and read without running what is inside.

Two kinds, both of torch.save, both dictionaries of plain values and tensors:
    policy.pt      the policy's weights and what they are for (`CARD`), about 1 MB, for evaluate.py
    checkpoint.pt  the same and all else that training needs to go on: `train.py --resume`

    python checkpoint.py runs/a1-stiffness-rolt-seed0/policy.pt rolt.pt     # half as large, to ship
"""

import os
import sys
from pathlib import Path

import torch

from baselines import make_policy
from faults import TASKS
from robots import ROBOTS

FORMAT = 2  # 1 was before leg frames
CARD = ("robot", "task", "policy", "scan", "seed", "steps", "stages", "init")  # of a policy


class CheckpointError(ValueError):
    """The file cannot be used; the message says why and what would help."""


def save(content: dict, path: Path) -> None:
    """Writes beside `path`, then renames: a crash or a full disk leaves the old file whole."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            torch.save(content | {"format": FORMAT}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save's RuntimeError is a full disk
        temporary.unlink(missing_ok=True)
        raise OSError(f"cannot write {path} ({error}); the file there is untouched") from error


def load(path: str | Path) -> dict:
    """The dictionary in the file. CheckpointError if it is missing, damaged, of another format."""
    if not os.path.isfile(path):
        raise CheckpointError(f"there is no checkpoint {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever damaged bytes provoke in zip, pickle or torch
        raise CheckpointError(f"{path} is not a whole checkpoint: copy it again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path} is of another version (not format {FORMAT}): train it again")
    return content


def load_policy(path: str | Path, robot: str | None = None) -> tuple[torch.nn.Module, dict]:
    """The policy in a policy.pt or checkpoint.pt, ready to act, and its card (`CARD`). robot: if
    given, the one it must be for. CheckpointError if the file cannot be used."""
    content = load(path)
    try:
        card = {key: content[key] for key in CARD}
        name, task, scan = card["policy"], TASKS[card["task"]], card["scan"]
        policy = make_policy(name, ROBOTS[card["robot"]], task, scan)
        policy.load_state_dict(content["weights"])  # as float32, whatever the file has
    except (KeyError, TypeError, AttributeError, RuntimeError) as error:
        why = " ".join(str(error).split())[:200]
        raise CheckpointError(f"{path} does not fit this program ({why}): train again") from error
    if robot is not None and card["robot"] != robot:
        raise CheckpointError(f"{path} was trained on the {card['robot']}, not on the {robot}")
    if bad := [name for name, x in policy.state_dict().items() if not torch.isfinite(x).all()]:
        raise CheckpointError(f"{path} is of no use: {bad[0]} is not finite")
    return policy.eval(), card


def start_from(path: str | Path, policy: torch.nn.Module, critic: torch.nn.Module) -> None:
    """Puts the file's weights into a fresh policy and, those of a checkpoint.pt, a fresh critic. If
    they are of a policy without the scan: inputs that it did not have come last, and their weights
    start at 0, so that nothing changes at first. CheckpointError if the file cannot be used."""
    content = load(path)
    try:
        for module, saved in ((policy, content["weights"]), (critic, content.get("critic", {}))):
            own = module.state_dict()
            for name, x in saved.items():
                if x.shape != own[name].shape:  # (outputs, inputs)
                    x = torch.cat([x, torch.zeros(len(x), own[name].shape[1] - x.shape[1])], dim=1)
                own[name] = x
            module.load_state_dict(own)
    except (KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        why = " ".join(str(error).split())[:200]
        raise CheckpointError(f"the weights in {path} do not fit this policy ({why})") from error


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python checkpoint.py POLICY COPY")
    try:
        content = load(sys.argv[1])
        weights = {k: x.half() if x.dim() > 1 else x for k, x in content["weights"].items()}
        save({key: content[key] for key in CARD} | {"weights": weights}, Path(sys.argv[2]))
    except (CheckpointError, KeyError, OSError) as error:
        sys.exit(f"error: {error}")
