"""Files that last: saved whole or not at all, and read without ever running what is inside them.

Two kinds, both of torch.save, both dictionaries of plain values and tensors:
    policy.pt      the policy's weights and what they are for (robot, task, policy, steps, seed); about 2 MB. This is
                   what evaluate.py reads, and the kind of file for checkpoints/.
    checkpoint.pt  the same and everything else that training needs to go on: `train.py --resume`.

    >>> policy, card = load_policy("checkpoints/a1-stiffness-rolt.pt")

    python checkpoint.py runs/a1-stiffness-roam-seed0/policy.pt checkpoints/a1-stiffness-roam.pt    # a copy half as large
"""

import os
import shutil
import zipfile
from pathlib import Path

import torch

from baselines import METHODS, make_policy
from cli import Parser, fail
from faults import TASKS
from robots import ROBOTS

FORMAT = 1  # raise it when files of before can no longer be read
CARD = {"robot": "a1", "task": "stiffness", "policy": "rolt", "steps": 0, "seed": 0}  # what a policy file says


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
    except (OSError, RuntimeError) as error:
        temporary.unlink(missing_ok=True)
        why = error if isinstance(error, OSError) else "there is no room for it"  # torch.save's RuntimeError of a full disk
        raise OSError(f"cannot write {path}: {why}; what was saved there before is untouched") from error


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
    """The dictionary in the file. CheckpointError if it is missing, damaged, of another format or holds a NaN."""
    if not os.path.isfile(path):
        raise CheckpointError(f"there is no checkpoint {path}")
    try:
        with zipfile.ZipFile(path) as archive:  # what torch.save writes; torch.load does not look at its checksums
            if altered := archive.testzip():
                raise ValueError(f"the checksum of {altered} is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
        bad = [name for name, x in numbers(content) if not torch.isfinite(x).all()]
    except Exception as error:  # whatever damaged bytes provoke in zip, pickle or torch
        raise CheckpointError(f"{path} is not a whole checkpoint ({type(error).__name__}): copy or train it again") from error
    if not isinstance(content, dict) or type(content.get("format")) is not int or content["format"] != FORMAT:
        raise CheckpointError(f"{path} is not a checkpoint of this version (format {FORMAT}): train it again")
    if bad:
        raise CheckpointError(f"{path} is of no use: {bad[0]} is not finite")
    return content


def numbers(value, name: str = ""):
    """(name, tensor) of all tensors and floats in nested dictionaries and lists, e.g. ("weights.decoder.bias", ...)."""
    if isinstance(value, torch.Tensor | float):
        yield name, torch.as_tensor(value)
    elif isinstance(value, dict | list | tuple):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from numbers(item, f"{name}.{key}".lstrip("."))


def misfit(saved, own, name: str) -> str | None:
    """What keeps `saved` from taking the place of `own`: another key, type, length, shape, dtype, or list of whole numbers
    (the optimiser's indices of parameters). None if nothing does."""
    if isinstance(own, dict) and isinstance(saved, dict):
        if odd := [str(key) for key in own if key not in saved] + [str(key) for key in saved if key not in own]:
            return f"{name}.{odd[0]} is {'missing' if odd[0] in map(str, own) else 'unknown'}"
        pairs = [(saved[key], own[key], f"{name}.{key}") for key in own]
    elif isinstance(own, list) and isinstance(saved, list) and len(own) == len(saved):
        if own and isinstance(own[0], int) and saved != own:
            return f"{name} is {saved}, not {own}"
        pairs = [(a, b, f"{name}.{i}") for i, (a, b) in enumerate(zip(saved, own))]
    elif isinstance(own, torch.Tensor) and isinstance(saved, torch.Tensor):
        forms = [(tuple(x.shape), x.dtype, x.layout) for x in (saved, own)]
        return None if forms[0] == forms[1] else f"{name} is {forms[0][0]} {forms[0][1]}, not {forms[1][0]} {forms[1][1]}"
    elif type(saved) is type(own) and not isinstance(own, list):
        return None
    else:
        return f"{name} is not what it should be"
    return next((found for pair in pairs if (found := misfit(*pair))), None)


def load_policy(path: str | Path, robot: str | None = None) -> tuple[torch.nn.Module, dict]:
    """The policy in a policy.pt or checkpoint.pt, ready to act, and its card (`CARD`).

    robot: if given, the one it must be for. Raises CheckpointError if the file cannot be used.
    """
    content = load(path)
    missing = [key for key in (*CARD, "weights") if key not in content]
    if missing:
        raise CheckpointError(f"{path} holds no policy: {', '.join(missing)} is missing")
    card = {key: content[key] for key in CARD}
    if why := misfit(card, CARD, "the file's card"):
        raise CheckpointError(f"{path} holds no policy: {why}")
    if card["robot"] not in ROBOTS or card["policy"] not in METHODS or card["task"] not in TASKS:
        what = f"{card['robot']}, {card['task']}, {card['policy']}"
        raise CheckpointError(f"{path} is of a robot, task or policy unknown here: {what}")
    if robot is not None and card["robot"] != robot:
        raise CheckpointError(f"{path} was trained on the {card['robot']}, not on the {robot}: say so with --robot")
    policy, weights = make_policy(card["policy"], ROBOTS[card["robot"]], TASKS[card["task"]]), content["weights"]
    if isinstance(weights, dict):
        weights = {name: x.float() if getattr(x, "dtype", None) == torch.half else x for name, x in weights.items()}
    if why := misfit(weights, policy.state_dict(), "weights"):
        raise CheckpointError(f"the weights in {path} do not fit the policy {card['policy']} ({why}): train it again")
    policy.load_state_dict(weights)
    return policy.eval(), card


def halve(path: Path, copy: Path) -> None:
    """Copies a policy with its matrices in half precision, for files that are large to ship: ROAM's has four networks.

    CheckpointError if the file holds no policy; OSError if the copy cannot be written.
    """
    (policy, card), init = load_policy(path), load(path).get("init")
    weights = {name: x.half() if x.dim() > 1 else x for name, x in policy.state_dict().items()}
    save(card | {"init": init, "weights": weights}, copy)


def start_from(path: str | Path, policy: torch.nn.Module, critic: torch.nn.Module) -> None:
    """Puts the weights in the file into a fresh policy and, if it is a checkpoint.pt, into a fresh critic.

    The file may be of another method whose weights include all of the policy's (ROLT's fit the ablations of its dropout),
    and of another robot with as many legs and joints (an A1's fit a Go1).
    CheckpointError if the file cannot be used.
    """
    content = load(path)
    try:
        missing, _ = policy.load_state_dict(content["weights"], strict=False)
        if missing:
            raise KeyError(missing[0])
        own = any(module is critic for module in policy.modules())  # ROAM's values are among its weights
        if content.get("critic") and not own:
            critic.load_state_dict(content["critic"])
        elif not own:  # a policy.pt, or a finished RMA, whose last stage needs none
            print(f"{path} holds no critic: it starts afresh")
    except (RuntimeError, TypeError, AttributeError, KeyError) as error:
        raise CheckpointError(f"the weights in {path} do not fit this policy: start from one of its own") from error


if __name__ == "__main__":
    parser = Parser(__doc__)
    parser.add_argument("file", type=Path, help="a policy.pt")
    parser.add_argument("copy", type=Path)
    args = parser.parse_args()
    try:
        halve(args.file, args.copy)
    except (CheckpointError, OSError) as error:
        fail(error)
    print(f"written: {args.copy} ({args.copy.stat().st_size / 1e6:.1f} MB, {args.file} has {args.file.stat().st_size / 1e6:.1f})")
