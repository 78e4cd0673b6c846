"""Takes a policy away: a program for torch.export, the robot's model, and a contract in words.

    python export.py checkpoints/a1-stiffness-rolt.pt exported
    python examples/deploy.py exported    # walks, with MuJoCo, numpy and torch alone

OUT gets policy.pt2 (actions from inputs, any number of robots), robot.mjb (MuJoCo's model) and
policy.json (order, meaning and scale of every input and of the actions). What the program answers
is compared with the policy, to the bit, before anything is said to be written.
"""

import argparse
import json
import sys
from pathlib import Path

import mujoco
import torch
from torch import nn

from baselines import ROAM
from checkpoint import load_policy
from env import JOINT_SCALE, MAX_ACTION, TRUNK_SCALE, EnvConfig, LocomotionEnv
from env import __doc__ as ABOUT_INPUTS
from noise import __doc__ as ABOUT_HEIGHTS
from ppo import to_tensors
from robots import CONTROL_DT, PHYSICS_DT
from rolt import Observation


class Plain(nn.Module):
    """The policy as a function of what it reads, at test."""

    def __init__(self, policy: nn.Module, names: list[str]):
        super().__init__()
        self.policy, self.names = policy, names

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        fields = dict.fromkeys(Observation._fields, inputs[0].new_zeros(inputs[0].shape[0], 0))
        return self.policy(Observation(**fields | dict(zip(self.names, inputs))))


def contract(card: dict, env: LocomotionEnv, inputs: dict[str, torch.Tensor]) -> dict:
    """All that who calls the program has to know."""
    keys = "stiffness", "damping", "action_scale", "default_pose", "legs", "joints"
    about = ABOUT_INPUTS.partition("What rewards")[0] + ABOUT_HEIGHTS
    return {
        **{key: card[key] for key in ("robot", "task", "policy", "seed", "steps")},
        **{key: getattr(env.robot, key) for key in keys},
        "control_dt": CONTROL_DT, "physics_dt": PHYSICS_DT, "max_action": MAX_ACTION,
        "joint_scale": JOINT_SCALE.ravel().tolist(), "trunk_scale": TRUNK_SCALE.tolist(),
        "joint_sign": env._joint_sign.tolist(), "trunk_sign": env._trunk_sign.tolist(),
        "inputs": {name: ["robots", *x.shape[1:]] for name, x in inputs.items()},
        "leg_frames": "joint_sign times angles and velocities, trunk_sign times the last twelve; "
        "at the start all steps of the history are the first",
        "output": "actions, leg by leg; whoever applies them clips them to +-max_action; joint "
        "target [rad] = default_pose + action_scale * joint_sign * action",
        "about_inputs": about.splitlines(),
    }  # fmt: skip


def export(path: Path, out: Path) -> None:
    policy, card = load_policy(path)
    if isinstance(policy, ROAM):
        raise ValueError("ROAM draws its behaviour at random, which no program can repeat")
    config = EnvConfig(leg_frames=policy.leg_frames)
    env = LocomotionEnv(card["robot"], 3, num_threads=1, config=config, extras=policy.extras)
    observation = to_tensors(env.reset(), "cpu")
    inputs = {x: getattr(observation, x) for x in ("legs", "action", *policy.extras)}

    plain = Plain(policy, [*inputs]).eval()
    robots = torch.export.Dim("robots")
    shapes = (tuple({0: robots} for _ in inputs),)
    program = torch.export.export(plain, tuple(inputs.values()), dynamic_shapes=shapes)
    out.mkdir(parents=True, exist_ok=True)
    torch.export.save(program, out / "policy.pt2")
    mujoco.mj_saveModel(env.model, str(out / "robot.mjb"))
    (out / "policy.json").write_text(json.dumps(contract(card, env, inputs), indent=1))

    again, states = torch.export.load(out / "policy.pt2").module(), 0
    for _ in range(50):
        action = policy(observation)
        answer = again(*(getattr(observation, name) for name in inputs))
        if not torch.equal(answer, action):
            gap = (answer - action).abs().max()
            raise RuntimeError(f"the program's actions differ from the policy's by {gap}")
        observation, states = to_tensors(env.step(action.numpy())[0], "cpu"), states + len(action)
    print(f"written: {out}/policy.pt2, policy.json, robot.mjb; equal to the bit in {states} states")


def main(argv: list[str] | None = None) -> None:
    plain = {"usage": argparse.SUPPRESS, "formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = argparse.ArgumentParser(description=__doc__, **plain)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="a folder")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            export(args.checkpoint, args.out)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
