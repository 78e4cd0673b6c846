"""The nine rewards of the paper's Table I: functions of the env (attributes: env.py) -> (N,).

Weights are the paper's; what the table leaves open is legged_gym's, which the paper trained with.
As there, the weighted sum is multiplied by the control period and floored at zero: early on, when
all goes wrong, falling at once is never better than trying.
"""

import numpy as np

TRACKING_SIGMA = 0.25  # (m/s)^2 and (rad/s)^2, legged_gym; the paper names sigma without a value
AIR_TIME_TARGET = 0.5  # s, legged_gym
MOVING_COMMAND = 0.1  # m/s, legged_gym: one told to stand still is not paid for lifting its feet
FALL = -1.0  # ours, for a fall, once, after the floor: lunging must not pay (NOTES 8)


def xy_velocity_tracking(env) -> np.ndarray:
    """exp(-|v_xy - v_cmd|^2 / sigma). Table I has no square: too slow would pay more than exact."""
    error = env.linear_velocity[:, :2] - env.command[:, :2]
    return np.exp(-np.sum(error**2, axis=1) / TRACKING_SIGMA)


def yaw_velocity_tracking(env) -> np.ndarray:
    """exp(-(w_z - w_cmd)^2 / sigma)"""
    return np.exp(-((env.angular_velocity[:, 2] - env.command[:, 2]) ** 2) / TRACKING_SIGMA)


def z_velocity(env) -> np.ndarray:
    """v_z^2"""
    return env.linear_velocity[:, 2] ** 2


def roll_pitch_velocity(env) -> np.ndarray:
    """|w_xy|^2"""
    return np.sum(env.angular_velocity[:, :2] ** 2, axis=1)


def collision(env) -> np.ndarray:
    """How many links with a capsule touch the ground: legged_gym's sum of the table's indicator."""
    return np.sum(env.link_contact, axis=1)


def joint_torques(env) -> np.ndarray:
    """|tau|^2"""
    return np.sum(env.torque**2, axis=(1, 2))


def action_rate(env) -> np.ndarray:
    """|a_t - a_{t-1}|^2"""
    return np.sum((env.action - env.last_action) ** 2, axis=(1, 2))


def foot_air_time(env) -> np.ndarray:
    """Sum over feet that touch down of (t_air - 0.5 s): short steps cost (legged_gym's form)."""
    moving = np.linalg.norm(env.command[:, :2], axis=1) > MOVING_COMMAND
    return moving * np.sum(env.touchdown * (env.air_time - AIR_TIME_TARGET), axis=1)


def joint_error(env) -> np.ndarray:
    """|q - q_default|^2"""
    return np.sum(env.joint_error**2, axis=(1, 2))


REWARDS = {  # weight of each term (paper, Table I)
    xy_velocity_tracking: 1.5,
    yaw_velocity_tracking: 0.5,
    z_velocity: -2.0,
    roll_pitch_velocity: -0.05,
    collision: -1.0,
    joint_torques: -2e-4,
    action_rate: -0.01,
    foot_air_time: 1.0,
    joint_error: -0.04,
}


def total_reward(env, dt: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The reward (N,), and each weighted term (N,) before the floor, per second."""
    terms = {term.__name__: weight * term(env) for term, weight in REWARDS.items()}
    return np.maximum(sum(terms.values()) * dt, 0.0), terms
