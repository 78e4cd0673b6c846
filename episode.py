"""Everything random about an episode, as numbers with their sources; env.py draws them.

An `EnvConfig` is all that training, tests and pictures ask differently of the same env.
"""

from dataclasses import asdict, dataclass

import numpy as np

from robots import PHYSICS_DT

SUBSTEPS = 4  # legged_gym: 50 Hz control
CONTROL_DT = SUBSTEPS * PHYSICS_DT  # s


@dataclass(frozen=True)
class EnvConfig:
    """Ranges are (low, high), uniform. ValueError for values that make no sense."""

    episode_seconds: float = 20.0  # legged_gym, and the paper's tests
    # s that a command lasts, through falls, until the next reset after that. Ours: legged_gym draws one every 10 s and
    # at every fall. A change within an episode changes the value more than any action does: it made 3/4 of the variance
    # of the advantages, and two policy gradients of one policy pointed different ways (cosine 0.0; 0.6 without). A
    # new one at a fall lets robots fall until they draw a slow one: soon nobody practises walking.
    command_seconds: float = 20.0
    # m/s; ours: the tests walk forward (legged_gym: -1 to 1, and less than 0.2 counts as a command to stand)
    forward_speed: tuple[float, float] = (0.0, 1.0)
    lateral_speed: tuple[float, float] = (0.0, 0.0)  # m/s; ours, likewise
    heading: tuple[float, float] = (-0.5, 0.5)  # rad, legged_gym's heading mode; ours: enough to hold a course, and
    # early on a robot that stands is paid for not turning (legged_gym: -pi to pi, where it is paid next to nothing)
    friction: tuple[float, float] = (0.5, 1.25)  # legged_gym, drawn once a robot there, here at every reset
    start_pose: tuple[float, float] = (0.5, 1.5)  # times the default joint angles, legged_gym
    start_speed: float = 0.5  # m/s and rad/s, each component of the trunk's velocity within +-, legged_gym
    push_seconds: float = 15.0  # legged_gym: then the trunk's velocity is redrawn
    push_speed: float = 1.0  # m/s, x and y within +-, legged_gym; 0 = no pushes
    start_rows: int = 3  # of the terrain, on which robots begin, ours (legged_gym: 6 of 10)
    climb: bool = True  # from row to row by the curriculum; False = always start on the first rows

    def __post_init__(self):
        for name, value in asdict(self).items():
            low, high = value if isinstance(value, tuple) else (0, value)
            if not -np.inf < low <= high < np.inf:
                raise ValueError(f"{name} is {value}; a range is (low, high), a single number is not negative, all are finite")
            if name.endswith("_seconds") and value < CONTROL_DT:
                raise ValueError(f"{name} is {value}; a control step already lasts {CONTROL_DT} s")
        if self.friction[0] <= 0 or self.start_rows < 1:
            raise ValueError("friction is above 0, and robots begin on at least 1 row")
