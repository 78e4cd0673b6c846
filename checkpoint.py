"""Files that last: saved whole or not at all, and read without ever running what is inside them.

Two kinds, both of torch.save, both dictionaries of plain values and tensors:
    policy.pt      the policy's weights and what they are for (robot, task, policy, steps, seed); about 2 MB. This is
                   what evaluate.py reads, and the kind of file for checkpoints/.
    checkpoint.pt  the same and everything else that training needs to go on: `train.py --resume`.

    >>> policy, card = load_policy("checkpoints/a1-stiffness-rolt.pt")
"""

import os
import shutil
import zipfile
from pathlib import Path

import torch

from baselines import METHODS, make_policy
from faults import TASKS
from normalizer import Normalizer
from robots import ROBOTS

FORMAT = 1  # raise it when files of before can no longer be read
CARD = ("robot", "task", "policy", "steps", "seed")  # what a policy file says about itself


class CheckpointError(ValueError):
    """The file cannot be used; the message says why and what would help."""


def save(content: dict, path: Path) -> None:
    """Writes to a temporary file beside `path`, then renames it: a crash or a full disk leaves the old file whole."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            torch.save(content | {"format": FORMAT}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save reports a full disk as a RuntimeError
        temporary.unlink(missing_ok=True)
        raise OSError(f"cannot write {path}: {error}; what was saved there before is untouched") from error


def save_next(content: dict, path: Path) -> None:
    """`save`, with what was there before kept beside it as NAME.previous."""
    if path.exists():
        previous = path.with_name(path.name + ".previous")
        previous.unlink(missing_ok=True)
        try:
            os.link(path, previous)  # a second name for the old file, which `save` then replaces
        except OSError:  # a file system without links
            shutil.copyfile(path, previous)
    save(content, path)


def load_newest(path: Path, say: bool = False) -> dict:
    """The file at `path`, or else the one before it (see `save_next`), and says so if `say`.

    CheckpointError if neither can be used.
    """
    try:
        return load(path)
    except CheckpointError as error:
        try:
            content = load(path.with_name(path.name + ".previous"))
        except CheckpointError:
            raise error from None
        if say:
            print(f"{error}; going on from the one before it", flush=True)
        return content


def load(path: str | Path) -> dict:
    """The dictionary in the file. CheckpointError if it is missing, damaged or of another format."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"there is no checkpoint {path}")
    try:
        with zipfile.ZipFile(path) as archive:  # what torch.save writes; torch.load does not look at its checksums
            if altered := archive.testzip():
                raise ValueError(f"the checksum of {altered} is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever damaged bytes provoke in zip, pickle or torch
        raise CheckpointError(f"{path} is not a whole checkpoint ({type(error).__name__}): copy or train it again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path} is not a checkpoint of this version (format {FORMAT}): train it again")
    return content


def load_policy(path: str | Path, robot: str | None = None) -> tuple[torch.nn.Module, dict]:
    """The policy in a policy.pt or checkpoint.pt, ready to act, and its card (`CARD`).

    robot: if given, the one it must be for. Raises CheckpointError if the file cannot be used.
    """
    content = load(path)
    missing = [key for key in (*CARD, "weights") if key not in content]
    if missing:
        raise CheckpointError(f"{path} holds no policy: {', '.join(missing)} is missing")
    card = {key: content[key] for key in CARD}
    if card["robot"] not in ROBOTS or card["policy"] not in METHODS or card["task"] not in TASKS:
        what = f"{card['robot']}, {card['task']}, {card['policy']}"
        raise CheckpointError(f"{path} is of a robot, task or policy unknown here: {what}")
    if robot is not None and card["robot"] != robot:
        raise CheckpointError(f"{path} was trained on the {card['robot']}, not on the {robot}")
    policy = make_policy(card["policy"], ROBOTS[card["robot"]], TASKS[card["task"]])
    try:
        policy.load_state_dict(content["weights"])
    except (RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(f"the weights in {path} do not fit the policy {card['policy']}: train it again") from error
    return policy.eval(), card


def start_from(path: str | Path, robot: str, policy: torch.nn.Module, critic: torch.nn.Module | None = None) -> None:
    """Puts the weights in the file into a fresh policy and, if it is a checkpoint.pt, into a fresh critic.

    The file may be of another method whose weights include all of the policy's (ROLT's fit the ablations of its dropout).
    What the normalizers measured is kept until the first rollout of the new run replaces it.
    CheckpointError if the file cannot be used.
    """
    content = load(path)
    if content.get("robot") != robot:
        raise CheckpointError(f"{path} was trained on the {content.get('robot')}, not on the {robot}")
    try:
        missing, _ = policy.load_state_dict(content["weights"], strict=False)
        if missing:
            raise KeyError(missing[0])
        if critic is not None and content.get("critic"):  # a finished RMA or ROAM has none
            critic.load_state_dict(content["critic"])
    except (RuntimeError, TypeError, AttributeError, KeyError) as error:
        raise CheckpointError(f"the weights in {path} do not fit this policy: start from one of its own") from error
    for module in policy.modules():
        if isinstance(module, Normalizer):
            module.count.zero_()
