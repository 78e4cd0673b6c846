"""Policies and runs as files: saved whole or not at all, and read without running what is inside.

Two kinds, both of torch.save, both dictionaries of plain values and tensors:
    policy.pt      `CARD` (curve: (n, len(CURVE)), how it learned), policy and critic, matrices in
                   half precision: 2 MB, to show, to give away, and to start from (`--init`)
    checkpoint.pt  the same in full, and all else that `train.py --resume` needs to go on
"""

import math
import os
import sys
from contextlib import contextmanager
from pathlib import Path

import torch

from baselines import make_policy
from faults import TASKS
from robots import ROBOTS
from rolt import SCAN_SHAPE

FORMAT = 2  # 1 was before leg frames
CARD = ("robot", "task", "policy", "scan", "seed", "steps", "stages", "init", "curve")  # about it
CURVE = ("steps", "episode_return", "speed", "commanded_speed", "fall_share")  # how it learned


class CheckpointError(ValueError):
    """A file is missing, damaged or of something else. The message says what would help."""


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


def save_policy(content: dict, path: Path) -> None:
    """The part of a checkpoint.pt that a policy.pt is."""
    part = {key: content[key] for key in CARD}
    for module in ("weights", "critic"):
        x = content[module]
        part[module] = {name: w.half() if w.dim() > 1 else w for name, w in x.items()}
    save(part, path)


def load(path: str | Path) -> dict:
    """The dictionary in the file."""
    if not os.path.isfile(path):
        raise CheckpointError(f"there is no checkpoint {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever damaged bytes provoke in zip, pickle or torch
        raise CheckpointError(f"{path} is not a whole checkpoint: copy it again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path} is of another version (not format {FORMAT}): train it again")
    return content


@contextmanager
def loaded(path: str | Path):
    """`load`; if other things are in it than are asked for, that ends in a CheckpointError, too."""
    content = load(path)
    try:
        yield content
    except (KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
        why = " ".join(str(error).split())[:200]
        raise CheckpointError(f"{path} does not fit ({why}): train it again") from error


def load_policy(path: str | Path, robot: str | None = None) -> tuple[torch.nn.Module, dict]:
    """The policy in the file (of this robot, if one is given), ready to act, and its card."""
    with loaded(path) as content:
        card = {key: content[key] for key in CARD}
        name, task, scan = card["policy"], TASKS[card["task"]], card["scan"]
        policy = make_policy(name, ROBOTS[card["robot"]], task, scan)
        policy.load_state_dict(content["weights"])  # as float32, whatever the file has
    if robot not in (None, card["robot"]):
        raise CheckpointError(f"{path} was trained on the {card['robot']}, not on the {robot}")
    return policy.eval(), card


def start_from(path: str | Path, policy: torch.nn.Module, critic: torch.nn.Module) -> None:
    """Puts the file's policy and critic into fresh ones. New inputs (the scan) come last, and their
    weights start at 0: nothing changes at first (a ROLT's new patch tokens do draw attention)."""
    with loaded(path) as content:
        if not content["critic"]:
            print(f"warning: {path} has no critic; a fresh one starts", file=sys.stderr)
        for module, saved in ((policy, content["weights"]), (critic, content["critic"])):
            own = module.state_dict()
            for name, x in saved.items():
                if x.shape != own[name].shape:  # (outputs, inputs)
                    new = own[name].shape[1] - x.shape[1]
                    if module is critic and new != math.prod(SCAN_SHAPE):
                        raise RuntimeError("the critic was told of other faults")  # not at its end
                    x = torch.cat([x, torch.zeros(len(x), new)], dim=1)
                own[name] = x
            module.load_state_dict(own)
