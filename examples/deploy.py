"""An exported policy (export.py) walks 10 s: MuJoCo, numpy and torch, nothing of this repository.

    python examples/deploy.py exported
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import torch

if len(sys.argv) != 2:
    sys.exit("error: which folder? One that export.py has written")
folder = Path(sys.argv[1])
card = json.loads((folder / "policy.json").read_text())
policy = torch.export.load(folder / "policy.pt2").module()
model = mujoco.MjModel.from_binary_path(str(folder / "robot.mjb"))
names = "default_pose", "joint_sign", "trunk_sign", "joint_scale", "trunk_scale"
default, joint_sign, trunk_sign, joint_scale, trunk_scale = (np.array(card[x]) for x in names)
if [*card["inputs"]] != ["legs", "action"]:
    sys.exit("error: this example walks blind, and the policy reads more than legs and action")

data, action, history = mujoco.MjData(model), np.zeros_like(default), None
mujoco.mj_resetDataKeyframe(model, data, 0)
for _ in range(round(10 / card["control_dt"])):
    mujoco.mj_forward(model, data)
    # what a leg sees: its joints, and the trunk, a left leg all of it mirrored
    rotation = data.body("trunk").xmat.reshape(3, 3)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    angle, velocity = (x.reshape(default.shape) for x in (data.qpos[7:], data.qvel[6:]))
    joints = np.stack([joint_sign * (angle - default), joint_sign * velocity, action], axis=1)
    trunk = [[0.75, 0, np.clip(-0.5 * yaw, -1, 1)], rotation.T @ data.qvel[:3], data.qvel[3:6]]
    trunk = trunk_sign * trunk_scale * np.concatenate([*trunk, -rotation[2] - (0, 0, -1)])
    frame = np.concatenate([(joint_scale[:, None] * joints).reshape(len(trunk), -1), trunk], axis=1)
    if history is None:
        history = np.repeat(frame[:, None], card["inputs"]["legs"][2], axis=1)
    history = np.concatenate([history[:, 1:], frame[:, None]], axis=1)

    inputs = (torch.tensor(x[None], dtype=torch.float32) for x in (history, action.ravel()))
    action = policy(*inputs)[0].detach().double().numpy().reshape(default.shape)
    action = action.clip(-card["max_action"], card["max_action"])
    data.ctrl[:] = (default + card["action_scale"] * joint_sign * action).ravel()
    for _ in range(round(card["control_dt"] / card["physics_dt"])):
        mujoco.mj_step(model, data)
print(f"walked {data.qpos[0]:.2f} m of 7.5 in 10 s; the trunk is {data.qpos[2]:.2f} m up")
