"""The nine rewards of the paper's Table I. Weights are the paper's; what the table leaves open is
legged_gym's, which the paper trained with. As there, the weighted sum is multiplied by the control
period and floored at zero: early on, when all goes wrong, falling is never better than trying.
"""

import numpy as np

TRACKING_SIGMA = 0.25  # (m/s)^2 and (rad/s)^2, legged_gym; the paper names sigma without a value
AIR_TIME_TARGET = 0.5  # s, legged_gym
MOVING_COMMAND = 0.1  # m/s, legged_gym: one told to stand still is not paid for lifting its feet
FALL = -1.0  # ours, for a fall, once, after the floor: lunging must not pay (NOTES 8)


def total_reward(env, dt: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The reward (N,), and each weighted term (N,) before the floor, per second. env: what it may
    read of it is in the head of env.py."""

    def square(x: np.ndarray) -> np.ndarray:
        """(N, ...) -> (N,), the sum of squares."""
        return np.sum(x**2, axis=tuple(range(1, x.ndim)))

    v, w, command = env.linear_velocity, env.angular_velocity, env.command  # (N, 3)
    moving = np.linalg.norm(command[:, :2], axis=1) > MOVING_COMMAND
    terms = {
        # Table I has no square of the error: too slow would pay more than exact
        "xy_velocity_tracking": 1.5 * np.exp(-square(v[:, :2] - command[:, :2]) / TRACKING_SIGMA),
        "yaw_velocity_tracking": 0.5 * np.exp(-((w[:, 2] - command[:, 2]) ** 2) / TRACKING_SIGMA),
        "z_velocity": -2.0 * v[:, 2] ** 2,
        "roll_pitch_velocity": -0.05 * square(w[:, :2]),
        # links with a capsule that touch the ground: legged_gym's sum of the table's indicator
        "collision": -1.0 * np.sum(env.link_contact, axis=1),
        "joint_torques": -2e-4 * square(env.torque),
        "action_rate": -0.01 * square(env.action - env.last_action),
        # of feet that touch down: short steps cost (legged_gym's form)
        "foot_air_time": moving * np.sum(env.touchdown * (env.air_time - AIR_TIME_TARGET), axis=1),
        "joint_error": -0.04 * square(env.joint_error),
    }
    return np.maximum(sum(terms.values()) * dt, 0.0), terms
