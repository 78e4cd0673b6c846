"""The methods that ROLT is compared with (paper, section IV); the list of them all is at the end.

A policy is a module with forward(observation, masks) -> (B, A) mean action, std() -> (A,),
sample_masks(n, generator) -> {name: (n, ...) masks or noise}, and a few words on itself (`extras`
and what follows in ROLT). How it is trained is a list of `Stage`s: most have one.

Legend: B samples, L legs, J joints a leg, A = L*J actions, K training situations.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from faults import Task, other_harms
from noise import HEIGHT_SCALE
from ppo import Learner, PPOConfig, network, proprioception
from robots import Robot
from rolt import (
    HISTORY, LOG_STD_BOUNDS, ROLT, SCAN_SHAPE, Decoder, Masks, Observation, ROLTConfig, drop,
)  # fmt: skip

HIDDEN = (512, 256, 128)  # legged_gym
ROLL_DROP_RATE = 1e-4  # paper
LATENT = 8  # size of RMA's z, Kumar et al.
LAST_STAGE = 0.2  # steps of a stage that guesses z or chooses a policy, ours (NOTES 14)


@dataclass(frozen=True)
class Stage:
    """A part of a method's training: who acts where, who learns what."""

    name: str
    share: float  # env steps, relative to the run's --steps
    faults: tuple[tuple[float, str], ...]  # the robots' situations
    actor: nn.Module
    trained: list[nn.Module | nn.Parameter]  # all other weights of the policy are frozen
    critic: nn.Module | None = None  # None = ppo.Critic, fresh
    extras: tuple[str, ...] = ()  # that the observation has to hold, beside `privileged`
    learner: type[Learner] = Learner


class Policy(nn.Module):
    """What the baselines share unless they say otherwise (the words are explained in ROLT)."""

    replays_masks = True
    leg_frames = True
    height_noise = 0.06  # m, in training; the deviation of legged_gym's uniform +-0.1 m

    def __init__(self, robot: Robot, scan: bool):
        super().__init__()
        self.num_actions = len(robot.joints)
        self.inputs = 3 * self.num_actions + 12  # numbers that the whole robot sees in one step
        self.extras = ("heights",) if scan else ()
        self.num_heights = SCAN_SHAPE[0] * SCAN_SHAPE[1] if scan else 0
        self.log_std = nn.Parameter(torch.full((self.num_actions,), ROLTConfig.initial_std).log())

    def std(self) -> Tensor:
        return self.log_std.clamp(*LOG_STD_BOUNDS).exp()

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        """The noise on the heights is drawn and stored as dropout masks are (NOTES 11)."""
        if not (self.height_noise and self.num_heights):
            return {}
        noise = torch.randn(n, *SCAN_SHAPE, generator=generator, device=generator.device)
        return {"height_noise": HEIGHT_SCALE * self.height_noise * noise}


class MLP(Policy):
    """All that ROLT sees, flat, into [512, 256, 128]."""

    def __init__(self, robot: Robot, task: Task, scan: bool):
        super().__init__(robot, scan)
        sizes = (HISTORY * self.inputs + self.num_heights, *HIDDEN)
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.decoder = Decoder(sizes[-1], self.num_actions)

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        masks = masks or {}
        heights = observation.heights + masks.get("height_noise", 0.0)
        x = torch.cat([proprioception(observation.legs), heights.flatten(1)], dim=1)
        for i, layer in enumerate(self.hidden):
            x = drop(nn.functional.elu(layer(x)), masks.get(f"hidden_{i}"), ROLL_DROP_RATE)
        return self.decoder(x)


class MirroredMLP(MLP):
    """Our control: symmetry, but no legs that share. In leg frames (NOTES 1) a state's mirror image
    is the same numbers, left and right legs exchanged and the scan's columns reversed (and those of
    the noise on it, all that this policy draws)."""

    def __init__(self, robot: Robot, task: Task, scan: bool):
        super().__init__(robot, task, scan)
        mirrored = [(x, -y, z) for x, y, z in robot.mounts]
        self.swap = [robot.mounts.index(mount) for mount in mirrored]  # the leg on the other side

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        image = observation._replace(legs=observation.legs[:, self.swap])
        if self.num_heights:
            image = image._replace(heights=observation.heights.flip(2))
        image_masks = {name: noise.flip(2) for name, noise in (masks or {}).items()}
        back = super().forward(image, image_masks).unflatten(1, (len(self.swap), -1))
        return (super().forward(observation, masks) + back[:, self.swap].flatten(1)) / 2


class RollDrop(MLP):
    """The MLP, its neurons dropped while it acts (Campanaro et al. 2023). The update knows nothing
    of it: where one was, PPO's ratio is not 1, even before a weight has moved: a random number that
    PPO takes for progress or clips. Hence the tiny rate: of 896 neurons none is dropped with
    probability (1 - p)^896, 91 % at 1e-4, 0.01 % at 1e-2 (`python evaluate.py dropout_ratio`)."""

    replays_masks = False

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        masks = {}
        for i, layer in enumerate(self.hidden):
            x = torch.rand(n, layer.out_features, generator=generator, device=generator.device)
            masks[f"hidden_{i}"] = x >= ROLL_DROP_RATE
        return masks


class RMA(Policy):
    """Rapid motor adaptation (Kumar et al. 2021). Stage 1, PPO: base(proprioception, heights, z =
    encoder(privileged)). Stage 2, supervised: adaptation(past 50 steps) learns to say z while it
    drives the frozen base. Where the observation has `past`, as at test, z is guessed."""

    def __init__(self, robot: Robot, task: Task, scan: bool):
        super().__init__(robot, scan)
        self.extras += ("past",)
        features = 32 if scan else 0
        if scan:
            self.heights = nn.Sequential(  # the paper's "CNN to encode height values"; sizes ours
                nn.Unflatten(1, (1, -1)), nn.Conv2d(1, 8, 3, stride=2, padding=1), nn.ELU(),
                nn.Conv2d(8, 16, 3, stride=2, padding=1), nn.ELU(), nn.Flatten(),
                nn.Linear(self.num_heights, features), nn.ELU(),
            )  # fmt: skip
        privileged = 2 * self.num_actions + 1 + len(other_harms(task.seen))
        self.encoder = network(privileged, 256, 128, LATENT)  # 256, 128: Kumar et al.
        hidden = network(HISTORY * self.inputs + features + LATENT, *HIDDEN)
        self.base = nn.Sequential(hidden, nn.ELU(), Decoder(HIDDEN[-1], self.num_actions))
        self.adaptation = Adaptation(self.inputs)

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        guessed = observation.past.numel() > 0
        z = self.adaptation(observation.past) if guessed else self.encoder(observation.privileged)
        parts = [proprioception(observation.legs), z]
        if self.num_heights:
            noise = (masks or {}).get("height_noise", 0.0)
            parts.append(self.heights(observation.heights + noise))
        return self.base(torch.cat(parts, dim=1))

    def stages(self, task: Task) -> list[Stage]:
        base = [self.log_std] + [x for x in self.children() if x is not self.adaptation]
        heights = tuple(name for name in self.extras if name != "past")
        return [
            Stage("base", 1.0, task.training, self, base, extras=heights),
            Stage("adaptation", LAST_STAGE, task.training, self, [self.adaptation],
                  extras=self.extras, learner=AdaptationLearner),
        ]  # fmt: skip


class Adaptation(nn.Module):
    """z from 50 steps: each to 32 numbers, then convolutions over time (sizes of Kumar et al.)."""

    def __init__(self, inputs: int):
        super().__init__()
        self.step = nn.Sequential(nn.Linear(inputs, 32), nn.ELU())
        self.time = nn.Sequential(  # 50 -> 11 -> 7 -> 3 steps
            nn.Conv1d(32, 32, 8, stride=4), nn.ELU(), nn.Conv1d(32, 32, 5), nn.ELU(),
            nn.Conv1d(32, 32, 5), nn.ELU(), nn.Flatten(), nn.Linear(3 * 32, LATENT),
        )  # fmt: skip

    def forward(self, past: Tensor) -> Tensor:
        """(B, L, 50, 3J + 12) -> (B, 8)"""
        steps = proprioception(past).unflatten(1, (past.shape[2], -1))
        return self.time(self.step(steps).transpose(1, 2))


class AdaptationLearner(Learner):
    """Stage 2: mean squared error between the guessed z and the encoder's."""

    first_rate = 1e-3  # ours: supervised learning bears more

    def loss(self, batch: dict, old_std: Tensor, progress: float) -> tuple[Tensor, dict]:
        observation = batch["observation"]
        truth = self.policy.encoder(observation.privileged)  # frozen
        error = (self.policy.adaptation(observation.past) - truth).square().mean()
        return error, {"other_loss": error}


class ROAM(Policy):
    """Robust autonomous modulation (Chen et al. 2024): an MLP per situation, each step a draw
    among them, i ~ softmax(V_1(s), ..., V_K(s)). In the last stage each acts in its own situation
    (the observation names it) and the values learn who belongs where."""

    height_noise = 0.0  # of the last stage

    def __init__(self, robot: Robot, task: Task, scan: bool):
        super().__init__(robot, scan)
        self.behaviours = nn.ModuleList(MLP(robot, task, scan) for _ in task.training)
        sizes = (HISTORY * self.inputs + self.num_heights, *HIDDEN, 1)
        self.critics = nn.ModuleList(network(*sizes) for _ in task.training)
        self.generator = torch.Generator().manual_seed(0)  # of the choice at test
        del self.log_std  # each behaviour has its own

    def std(self) -> Tensor:
        return torch.stack([behaviour.std() for behaviour in self.behaviours]).mean(0)

    def values(self, observation: Observation) -> Tensor:
        """(B, K), of what the behaviours see: at test nobody knows more."""
        parts = [proprioception(observation.legs), observation.heights.flatten(1)]
        return torch.cat([critic(torch.cat(parts, dim=1)) for critic in self.critics], dim=1)

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        if observation.situation.numel():
            choice = observation.situation.long()  # (B, 1)
        else:
            odds = self.values(observation).softmax(dim=1).cpu()
            choice = torch.multinomial(odds, 1, generator=self.generator)
        actions = torch.stack([act(observation) for act in self.behaviours], dim=1)  # (B, K, A)
        index = choice.to(actions.device)[:, :, None].expand(-1, -1, actions.shape[2])
        return actions.gather(1, index).squeeze(1)

    def stages(self, task: Task) -> list[Stage]:
        """All steps for each of the behaviours, and some for the values."""
        stages = []
        for actor, fault in zip(self.behaviours, task.seen):
            stages.append(Stage(fault, 1.0, ((1.0, fault),), actor, [actor], extras=self.extras))
        values = Stage(
            "values", LAST_STAGE, task.training, self, [self.critics], critic=OwnValue(self),
            extras=(*self.extras, "situation"), learner=ROAMLearner,
        )  # fmt: skip
        return [*stages, values]


class OwnValue(nn.Module):
    """V of the behaviour whose situation it is."""

    def __init__(self, policy: ROAM):
        super().__init__()
        self.values = policy.values  # a function: its weights are not this module's

    def forward(self, observation: Observation) -> Tensor:
        return self.values(observation).gather(1, observation.situation.long()).squeeze(1)


class ROAMLearner(Learner):
    """The last stage: Bellman loss of the situation's own value, and the cross-entropy over all: a
    state's values are logits that have to name the behaviour that visits it (Chen et al.)."""

    first_rate = PPOConfig.critic_learning_rate

    def loss(self, batch: dict, old_std: Tensor, progress: float) -> tuple[Tensor, dict]:
        values = self.policy.values(batch["observation"])  # (B, K)
        situation = batch["observation"].situation.long()  # (B, 1)
        own = values.gather(1, situation).squeeze(1)
        bellman = (own - batch["returns"]).square().mean()
        entropy = nn.functional.cross_entropy(values, situation.squeeze(1))  # weight 1: Chen et al.
        return bellman + entropy, {"value_loss": bellman, "other_loss": entropy}


# `train.py --policy`, in the order of the results: a class, or a switch of ROLT.
METHODS = {
    "mlp": MLP,
    "mirrored-mlp": MirroredMLP,  # ours
    "roll-drop": RollDrop,
    "rma": RMA,
    "roam": ROAM,
    "module-pe": ROLTConfig(identity="embedding"),
    "no-pe-drop": ROLTConfig(pe_dropout=0.0),
    "no-feature-drop": ROLTConfig(feature_dropout=0.0),
    "no-leg-frames": ROLTConfig(leg_frames=False),  # ours
    "no-identity": ROLTConfig(identity="none"),  # ours
    "rolt": ROLTConfig(),
}


def make_policy(name: str, robot: Robot, task: Task, scan: bool) -> nn.Module:
    """A policy, its weights from torch's global generator. scan: does it read the heights?"""
    method = METHODS[name]
    if isinstance(method, ROLTConfig):
        return ROLT(len(robot.legs), len(robot.links), replace(method, scan=scan))
    return method(robot, task, scan)


def training_stages(policy: nn.Module, task: Task) -> list[Stage]:
    """How the policy is trained, one stage after the other."""
    if hasattr(policy, "stages"):
        return policy.stages(task)
    return [Stage("ppo", 1.0, task.training, policy, [policy], extras=policy.extras)]
