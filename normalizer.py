"""Running mean and deviation of what the robots see, so that every number that reaches a network is of order 1.

legged_gym's fixed scales leave most of an observation constant (gravity and heights are near -1, a calf near -1.5 rad,
while joint angles move by 0.1). A network on such inputs answers nearly the same to every state, and so does its
gradient: at the start, the gradients of ROLT's output in two states of standing robots had 98 % of their inner product
in common (25 % with this file). A step of PPO then moves all actions together, whatever the state.

Statistics are shared by all legs and all steps of the history: they do not tell the legs apart. They change between
iterations only, never between a rollout and its update, where PPO's ratio would notice.

Legend: B samples, L legs, J joints a leg, H steps of history.
"""

import torch
from torch import Tensor, nn

from env import Observation

CLIP = 5.0  # deviations, ours: a falling robot's outliers stay bounded
MIN_DEVIATION = 0.01  # ours: what never changes in training is not blown up


class Normalizer(nn.Module):
    """(x - mean) / deviation, clipped. The target angles of `action` use the statistics that they have in `legs`."""

    def __init__(self, num_joints: int, num_privileged: int = 0):
        super().__init__()
        self.num_joints = num_joints
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        for name, width in (("legs", 3 * num_joints + 12), ("heights", 1), ("privileged", num_privileged)):
            self.register_buffer(f"{name}_mean", torch.zeros(width, dtype=torch.float64))
            self.register_buffer(f"{name}_square", torch.ones(width, dtype=torch.float64))  # mean of the squares
            for kind in ("shift", "deviation"):  # what `forward` needs of them, ready made
                self.register_buffer(f"{name}_{kind}", torch.zeros(width), persistent=False)
        self.refresh()
        self.register_load_state_dict_post_hook(lambda module, _: module.refresh())

    def forward(self, observation: Observation) -> Observation:
        J, action = self.num_joints, observation.action
        target = self._scale(action.unflatten(1, (-1, J)), "legs", slice(2 * J, 3 * J)).flatten(1)
        legs, heights = self._scale(observation.legs, "legs"), self._scale(observation.heights, "heights")
        observation = observation._replace(legs=legs, action=target, heights=heights)
        if observation.past.numel():
            observation = observation._replace(past=self._scale(observation.past, "legs"))
        if len(self.privileged_mean) and observation.privileged.numel():
            observation = observation._replace(privileged=self._scale(observation.privileged, "privileged"))
        return observation

    def _scale(self, x: Tensor, name: str, columns: slice = slice(None)) -> Tensor:
        shift, deviation = getattr(self, f"{name}_shift"), getattr(self, f"{name}_deviation")
        return ((x - shift[columns]) / deviation[columns]).clamp(-CLIP, CLIP)

    def refresh(self) -> None:
        """To be called when the statistics have changed."""
        for name in ("legs", "heights", "privileged"):
            mean, square = getattr(self, f"{name}_mean"), getattr(self, f"{name}_square")
            getattr(self, f"{name}_shift").copy_(mean)
            getattr(self, f"{name}_deviation").copy_((square - mean**2).clamp(min=MIN_DEVIATION**2).sqrt())

    @torch.no_grad()
    def update(self, observation: Observation, sum_over_processes, forget: tuple[str, ...] = ()) -> None:
        """Takes in the observations of a rollout, (T, N, ...) or (B, ...) fields.

        sum_over_processes adds up a tensor over all of them (ppo.all_reduce). forget: of "legs", "heights", "privileged",
        whose former statistics are replaced.
        """
        legs, heights = observation.legs[..., -1, :], observation.heights  # the newest step: older ones were newest once
        rows = {"legs": legs.flatten(0, -2), "heights": heights.reshape(-1, 1)}
        if len(self.privileged_mean):
            rows["privileged"] = observation.privileged.flatten(0, -2)
        samples = torch.tensor(float(len(rows["legs"])), dtype=torch.float64, device=self.count.device)
        total = sum_over_processes(samples.clone())
        for name, x in rows.items():
            x, share = x.double(), 1.0 if name in forget else total / (self.count + total)
            for kind, value in (("mean", x.mean(0)), ("square", (x**2).mean(0))):
                value = sum_over_processes(value * samples) / total
                running = getattr(self, f"{name}_{kind}")
                running += share * (value - running)
        self.count += total
        self.refresh()
