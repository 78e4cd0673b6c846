"""The methods that the paper compares ROLT with (section IV), each whole in one place, and the list of them all.

    MLP         all that ROLT sees, flat, into [512, 256, 128]
    Roll-Drop   the same network; neurons are dropped in the rollout only (Campanaro et al. 2023)
    RMA         a base policy that is told what is wrong with the robot, then an adaptation module that guesses it
                from the past second (Kumar et al. 2021)
    ROAM        a behaviour a training situation, chosen step by step by value functions (Chen et al. 2024)
    Module PE, No PE Drop, No Feature Drop: switches of ROLT (rolt.py)

A policy is a module with forward(observation, masks) -> (B, A) mean action, sigma() -> (A,), sample_masks(n, generator)
-> {name: (n, ...) bool}, and a few words on itself (`extras` and what follows in ROLT). How it is
trained is a list of `Stage`s: most have one.

Legend: B samples, L legs, J joints a leg, A = L*J actions, H = 10 steps of history, K training situations.

    python baselines.py         # parameters and cost of every method
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn
from torch.utils.benchmark import Timer

from env import HISTORY, LocomotionEnv, Observation
from faults import TASKS, Fault, Task, first_task
from normalizer import Normalizer
from ppo import Learner, PPOConfig, to_tensors
from robots import ROBOTS, Robot
from rolt import LOG_SIGMA_BOUNDS, ROLT, Masks, ROLTConfig, drop
from scandots import SCAN_SHAPE

HIDDEN = (512, 256, 128)  # legged_gym
INITIAL_SIGMA = ROLTConfig.initial_sigma  # the same exploration for every method
# m, standard deviation. The paper adds Gaussian noise in the training of MLP and RMA, without a number; legged_gym's uniform
# +-0.1 m has this deviation.
HEIGHT_NOISE = 0.06
ROLL_DROP_RATE = 1e-4  # paper
LATENT = 8  # size of RMA's z, Kumar et al.
# Share of the env steps for the policies that act; the rest is for what chooses among them or guesses z. Ours: walking takes
# longest to learn.
FIRST_STAGES = 0.9


@dataclass(frozen=True)
class Stage:
    """A part of a method's training: who acts where, who learns what."""

    name: str
    share: float  # of the run's env steps
    faults: tuple[tuple[float, Fault], ...]  # the robots' situations
    actor: nn.Module
    trained: tuple[nn.Module | nn.Parameter, ...]  # all other weights of the policy are frozen
    critic: nn.Module | None = None  # None = ppo.Critic, fresh
    extras: tuple[str, ...] = ()  # that the observation has to hold
    learner: type[Learner] = Learner


def network(*sizes: int) -> nn.Sequential:
    """Linear layers with ELU between them (legged_gym)."""
    layers = [module for a, b in zip(sizes, sizes[1:]) for module in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers[:-1])


def proprioception(legs: Tensor) -> Tensor:
    """(B, L, H, 3J + 12) -> (B, H, L*3J + 12): what all legs see, what they share (velocities, command) once."""
    return torch.cat([legs[..., :-12].transpose(1, 2).flatten(2), legs[:, 0, :, -12:]], dim=2)


class Policy(nn.Module):
    """What the baselines share unless they say otherwise (the words are explained in ROLT)."""

    extras = ()
    height_noise = 0.0
    replays_masks = True
    micro_batch = 1024  # more than ROLT's: wide layers and few activations

    def sigma(self) -> Tensor:
        return self.log_sigma.clamp(*LOG_SIGMA_BOUNDS).exp()

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        return {}


class MLP(Policy):
    """One network for everything."""

    height_noise = HEIGHT_NOISE

    def __init__(self, num_legs: int, num_joints: int):
        super().__init__()
        A = num_legs * num_joints
        self.normalizer = Normalizer(num_joints)
        sizes = (HISTORY * (3 * A + 12) + SCAN_SHAPE[0] * SCAN_SHAPE[1], *HIDDEN)
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.decoder = action_layer(sizes[-1], A)
        self.log_sigma = nn.Parameter(torch.full((A,), INITIAL_SIGMA).log())

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        x = everything(self.normalizer(observation))
        for i, layer in enumerate(self.hidden):
            x = drop(nn.functional.elu(layer(x)), (masks or {}).get(f"hidden_{i}"), ROLL_DROP_RATE)
        return self.decoder(x)


def everything(observation: Observation) -> Tensor:
    """(B, 480 + 192) of an A1: proprioception and heights."""
    return torch.cat([proprioception(observation.legs).flatten(1), observation.heights.flatten(1)], dim=1)


def action_layer(width: int, num_actions: int) -> nn.Linear:
    """Starts near the default pose, as ROLT's decoder. (0.01: ours; that a policy's last layer should be small is advice of
    Andrychowicz et al. 2021.)"""
    layer = nn.Linear(width, num_actions)
    nn.init.normal_(layer.weight, std=0.01)
    return layer


class RollDrop(MLP):
    """The MLP whose hidden neurons are dropped, at a tiny rate, while it acts.

    The update knows nothing of it: pi_new(a|s) is that of the whole network, pi_old(a|s, mask) was not. So PPO's ratio is
    not 1 where a neuron was dropped, even before a weight has moved: a random number that PPO takes for progress or clips.
    With n = 896 neurons and rate p, a sample is untouched with probability (1 - p)^n: 91 % at the paper's 1e-4,
    hence the tiny rate; 0.01 % at 1e-2. `python evaluate.py dropout_ratio` draws it. Consistent dropout replays the masks
    and may drop a tenth of all features.
    """

    height_noise = 0.0
    replays_masks = False

    def sample_masks(self, n: int, generator: torch.Generator) -> Masks:
        def keep(width: int) -> Tensor:
            return torch.rand(n, width, generator=generator, device=generator.device) >= ROLL_DROP_RATE

        return {f"hidden_{i}": keep(layer.out_features) for i, layer in enumerate(self.hidden)}


# ---------------------------------------------------------------------- RMA


class RMA(Policy):
    """Rapid motor adaptation. Stage 1, PPO: base(proprioception, heights, z) with z = encoder(privileged). Stage 2,
    supervised: adaptation(past 50 steps) learns to say z while it drives the frozen base.

    Whether z is known or guessed follows from the observation: where `past` is there, it is guessed. At test only
    `past` is there.
    """

    extras = ("past",)
    height_noise = HEIGHT_NOISE

    def __init__(self, num_legs: int, num_joints: int):
        super().__init__()
        A = num_legs * num_joints
        frame = 3 * A + 12
        self.normalizer = Normalizer(num_joints, num_privileged=2 * A + 1)
        self.heights = nn.Sequential(  # the paper's "CNN to encode height values"; sizes ours
            nn.Unflatten(1, (1, SCAN_SHAPE[0])), nn.Conv2d(1, 8, 3, stride=2, padding=1), nn.ELU(),
            nn.Conv2d(8, 16, 3, stride=2, padding=1), nn.ELU(), nn.Flatten(),
            nn.Linear(SCAN_SHAPE[0] * SCAN_SHAPE[1], 32), nn.ELU(),
        )  # fmt: skip
        self.encoder = network(2 * A + 1, 256, 128, LATENT)  # hidden layers of 256 and 128: Kumar et al.
        self.base = network(HISTORY * frame + 32 + LATENT, *HIDDEN, A)
        self.base[-1] = action_layer(HIDDEN[-1], A)
        self.adaptation = Adaptation(frame)
        self.log_sigma = nn.Parameter(torch.full((A,), INITIAL_SIGMA).log())

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        observation = self.normalizer(observation)
        z = self.adaptation(observation.past) if observation.past.numel() else self.encoder(observation.privileged)
        senses = proprioception(observation.legs).flatten(1), self.heights(observation.heights)
        return self.base(torch.cat([*senses, z], dim=1))

    def stages(self, task: Task) -> list[Stage]:
        base = (self.heights, self.encoder, self.base, self.log_sigma)
        both = ("privileged", "past")
        return [
            Stage("base", FIRST_STAGES, task.training, self, base, extras=("privileged",)),
            Stage("adaptation", 1 - FIRST_STAGES, task.training, self, (self.adaptation,), NoCritic(), both, AdaptationLearner),
        ]


class Adaptation(nn.Module):
    """z from 50 steps: each step to 32 numbers, then convolutions over time (Kumar et al.'s sizes)."""

    def __init__(self, frame: int):
        super().__init__()
        self.step = nn.Sequential(nn.Linear(frame, 32), nn.ELU())
        self.time = nn.Sequential(  # 50 -> 11 -> 7 -> 3 steps
            nn.Conv1d(32, 32, 8, stride=4), nn.ELU(), nn.Conv1d(32, 32, 5), nn.ELU(), nn.Conv1d(32, 32, 5), nn.ELU(),
            nn.Flatten(), nn.Linear(3 * 32, LATENT),
        )  # fmt: skip

    def forward(self, past: Tensor) -> Tensor:
        """(B, L, 50, 3J + 12) -> (B, 8)"""
        return self.time(self.step(proprioception(past)).transpose(1, 2))


class NoCritic(nn.Module):
    """Where nobody asks for values."""

    def forward(self, observation: Observation) -> Tensor:
        return torch.zeros(len(observation.legs), device=observation.legs.device)


class AdaptationLearner(Learner):
    """Stage 2: mean squared error between the guessed z and the encoder's."""

    measures = False  # the base is frozen, and so is what it sees

    def __init__(self, policy: RMA, critic: NoCritic, config: PPOConfig):
        super().__init__(policy, critic, replace(config, learning_rate=1e-3))  # ours: supervised learning bears more

    def loss(self, batch: dict, old_sigma: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        observation = self.policy.normalizer(batch["observation"])
        with torch.no_grad():
            truth = self.policy.encoder(observation.privileged)
        error = (self.policy.adaptation(observation.past) - truth).square().mean()
        return error, {"other_loss": error.detach()}


# ---------------------------------------------------------------------- ROAM


class ROAM(Policy):
    """Robust autonomous modulation: at each step, act by behaviour i ~ softmax(V_1(s), ..., V_K(s)).

    Every behaviour is an MLP that was trained in one situation. In the last stage each acts in its own situation (the
    observation names it) and the values learn who belongs where.
    """

    def __init__(self, num_legs: int, num_joints: int, num_situations: int = 2):
        super().__init__()
        inputs = HISTORY * (3 * num_legs * num_joints + 12) + SCAN_SHAPE[0] * SCAN_SHAPE[1]
        self.behaviours = nn.ModuleList(MLP(num_legs, num_joints) for _ in range(num_situations))
        self.critics = nn.ModuleList(BehaviourValue(inputs, behaviour.normalizer) for behaviour in self.behaviours)
        self.generator = torch.Generator().manual_seed(0)  # of the choice at test
        self.picked = torch.zeros(0, num_situations)  # (B, K) how often each robot chose each behaviour at test

    def sigma(self) -> Tensor:
        return torch.stack([behaviour.sigma() for behaviour in self.behaviours]).mean(0)

    def values(self, observation: Observation) -> Tensor:
        """(B, K)"""
        return torch.stack([critic(observation) for critic in self.critics], dim=1)

    def forward(self, observation: Observation, masks: Masks | None = None) -> Tensor:
        if observation.situation.numel():
            choice = observation.situation.long()  # (B, 1)
        else:
            odds = self.values(observation).softmax(dim=1).cpu()
            choice = torch.multinomial(odds, 1, generator=self.generator).to(observation.legs.device)
            if len(self.picked) != len(choice):
                self.picked = torch.zeros(odds.shape)
            self.picked += nn.functional.one_hot(choice.squeeze(1).cpu(), odds.shape[1])
        actions = torch.stack([behaviour(observation) for behaviour in self.behaviours], dim=1)  # (B, K, A)
        return actions.gather(1, choice[:, :, None].expand(-1, -1, actions.shape[2])).squeeze(1)

    def stages(self, task: Task) -> list[Stage]:
        """Equal parts of the steps for the behaviours, the rest for the values."""
        share, stages = FIRST_STAGES / len(task.training), []
        for behaviour, value, (_, fault) in zip(self.behaviours, self.critics, task.training, strict=True):
            stages.append(Stage(str(fault), share, ((1.0, fault),), behaviour, (behaviour, value), value))
        rest, values = 1 - FIRST_STAGES, (self.critics,)
        last = Stage("values", rest, task.training, self, values, OwnValue(self), ("situation",), ROAMLearner)
        return [*stages, last]


class BehaviourValue(nn.Module):
    """V_i(s), on what the MLP sees (the other methods' critic sees its previous action twice)."""

    def __init__(self, inputs: int, normalizer: Normalizer):
        super().__init__()
        self.normalizer = normalizer  # the behaviour's
        self.network = network(inputs, *HIDDEN, 1)

    def forward(self, observation: Observation) -> Tensor:
        return self.network(everything(self.normalizer(observation))).squeeze(1)


class OwnValue(nn.Module):
    """V of the behaviour whose situation it is."""

    def __init__(self, policy: ROAM):
        super().__init__()
        self.policy = [policy]  # in a list: its weights are not this module's

    def forward(self, observation: Observation) -> Tensor:
        return self.policy[0].values(observation).gather(1, observation.situation.long()).squeeze(1)


def roam_loss(values: Tensor, situation: Tensor, target: Tensor, weight: float = 1.0) -> tuple[Tensor, Tensor]:
    """Bellman loss of the value that belongs to the situation, and cross-entropy over all of them: the values of
    a state are logits that have to name the behaviour that visits it.

    values (B, K), situation (B,) long, target (B,) return. weight: 1 for stiffness tests (Chen et al.).
    Returns both parts, each a mean over the batch, the second times `weight`.
    """
    own = values.gather(1, situation[:, None]).squeeze(1)
    return (own - target).square().mean(), weight * nn.functional.cross_entropy(values, situation)


class ROAMLearner(Learner):
    """The last stage: nothing but the values learns."""

    measures = False

    def __init__(self, policy: ROAM, critic: OwnValue, config: PPOConfig):
        super().__init__(policy, critic, replace(config, learning_rate=config.critic_learning_rate))

    def loss(self, batch: dict, old_sigma: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        observation = batch["observation"]
        situation = observation.situation.squeeze(1).long()
        bellman, entropy = roam_loss(self.policy.values(observation), situation, batch["value_target"])
        return bellman + entropy, {"value_loss": bellman.detach(), "other_loss": entropy.detach()}


# ---------------------------------------------------------------------- all of them

# `train.py --policy`, in the order in which results list them.
METHODS = {
    "mlp": MLP,
    "roll-drop": RollDrop,
    "rma": RMA,
    "roam": ROAM,
    "module-pe": partial(ROLT, config=ROLTConfig(leg_pe=True)),
    "no-pe-drop": partial(ROLT, config=ROLTConfig(pe_dropout=0.0)),
    "no-feature-drop": partial(ROLT, config=ROLTConfig(feature_dropout=0.0)),
    "rolt": ROLT,
}
STAGED = tuple(name for name, method in METHODS.items() if hasattr(method, "stages"))  # trained in more than one way


def make_policy(name: str, robot: Robot, task: Task = TASKS["stiffness"]) -> nn.Module:
    """A policy for the robot, with fresh weights from torch's global generator. The task matters to ROAM alone."""
    options = {"num_situations": len(task.training)} if name == "roam" else {}
    return METHODS[name](len(robot.legs), len(robot.links), **options)


def training_stages(policy: nn.Module, task: Task) -> list[Stage]:
    """How the policy is trained, one stage after the other; their shares of the steps add up to 1."""
    if hasattr(policy, "stages"):
        return policy.stages(task)
    return [Stage("ppo", 1.0, task.training, policy, (policy,))]


def main() -> None:
    torch.set_num_threads(1)
    for robot in ROBOTS.values():
        print(f"{robot.name:18}{'parameters':>12}{'one robot acts in':>20}{'256 robots':>14}   (one thread)")
        for name in METHODS:
            policy, times = make_policy(name, robot, TASKS[first_task(robot.name)]).eval(), []
            for n in (1, 256):
                observation = to_tensors(LocomotionEnv(robot, n, extras=policy.extras).reset(), "cpu")
                times.append(Timer("policy(observation)", globals={"policy": policy, "observation": observation}))
            with torch.no_grad():
                one, many = (timer.blocked_autorange(min_run_time=0.3).median * 1000 for timer in times)
            print(f"{name:18}{sum(p.numel() for p in policy.parameters()):12,}{one:17.2f} ms{many:11.1f} ms")


if __name__ == "__main__":
    main()
