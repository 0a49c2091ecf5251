# This source code is licensed under the MIT license found in the LICENSE file.
"""Planners, controllers and environments whose outputs identify their inputs, and synthetic episodes."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap.envs.avoiding import OBSTACLES
from torchrl_koap.modules import StatePlanner
from torchrl_koap.tasks import Modes


class CountingPlanner(nn.Module):
    """Plans ``(x + 1000 (i + 1), x)`` as frame ``i`` at state ``x``."""

    history, horizon, state_dim = 2, 6, 2
    noise_shape = (6, 2)
    noise_key = "noise"

    def __init__(self):
        super().__init__()
        self.calls = []

    def sample(self, history, noise=None):
        assert history.shape[-2:] == (2, 2)
        self.calls.append(history[..., -1, 0].flatten().tolist())
        ahead = 1000.0 * torch.arange(1, self.horizon + 1)
        now = history[..., -1:, 0]
        return torch.stack([now + ahead, now.expand(*now.shape[:-1], self.horizon)], -1)


class CountingSampler(CountingPlanner):
    """Samples ``(k, x, previous x, second column of x)`` as entry ``k`` of a chunk at state ``x``."""

    noise_shape = (6, 4)

    def sample(self, history, noise=None):
        assert history.shape[-2:] == (2, 2)
        self.calls.append(history[..., -1, 0].flatten().tolist())
        steps = torch.arange(6.0).expand(*history.shape[:-2], 6)
        seen = torch.stack([history[..., -1, 0], history[..., 0, 0], history[..., -1, 1]], -1)
        return torch.cat([steps.unsqueeze(-1), seen.unsqueeze(-2).expand(*steps.shape, 3)], -1)


class EchoController(TensorDictModuleBase):
    """Returns entries of the window as action of frame ``t``: ``x_{t-1}``, ``x_t``, both columns of ``x_{t+1}``."""

    def __init__(self, num_past=1, in_key="state", out_key="action"):
        super().__init__()
        self.in_keys, self.out_keys, self.num_past = [in_key], ["something_else", out_key], num_past

    def forward(self, tensordict):
        state = tensordict.get(self.in_keys[0])
        before = torch.cat([state[..., :1, :1], state[..., :-1, :1]], -2)
        after = torch.cat([state[..., 1:, :], state[..., -1:, :]], -2)
        return tensordict.set(self.out_keys[-1], torch.cat([before, state[..., :1], after], -1))


def state_number(env, episode, step):
    """Returns the first state column: a number below 1000, unique per environment, episode and step."""
    return float(100 * env + 20 * episode + step)


class EpisodesOfRandomLength(EnvBase):
    """Observations encode environment, episode and step; each episode has its own number of steps."""

    def __init__(self, num_envs, lengths, action_dim=4):
        super().__init__(batch_size=[num_envs])
        self.lengths = lengths  # [env][episode], used cyclically
        self.episode = [-1] * num_envs
        self.step_number = [0] * num_envs
        shape = (num_envs,)
        self.observation_spec = Composite({"observation": Unbounded((num_envs, 3))}, shape=shape)
        self.action_spec = Bounded(-1e6, 1e6, (num_envs, action_dim))
        self.reward_spec = Unbounded((num_envs, 1))

    def _observation(self):
        rows = [
            [-1.0, state_number(env, episode % 5, step), 7.0]
            for env, (episode, step) in enumerate(zip(self.episode, self.step_number, strict=True))
        ]
        return torch.tensor(rows)

    def _reset(self, tensordict):
        flags = None if tensordict is None else tensordict.get("_reset", None)
        for env in range(self.batch_size[0]):
            if flags is None or flags[env].item():
                self.episode[env] += 1
                self.step_number[env] = 0
        return TensorDict(
            {"observation": self._observation(), "done": torch.zeros(*self.batch_size, 1, dtype=torch.bool)},
            self.batch_size,
        )

    def _step(self, tensordict):
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        for env in range(self.batch_size[0]):
            self.step_number[env] += 1
            lengths = self.lengths[env]
            done[env] = self.step_number[env] >= lengths[self.episode[env] % len(lengths)]
        reward = torch.zeros(*self.batch_size, 1)
        return TensorDict(
            {"observation": self._observation(), "reward": reward, "done": done, "terminated": done.clone()},
            self.batch_size,
        )

    def _set_seed(self, seed):
        pass


class Wandering(nn.Module):
    """A denoiser that plans straight ahead, away from the next cylinder, to a side given by the noise."""

    def forward(self, x, time, condition):
        now = condition[..., -2:]
        ahead = torch.arange(1, x.shape[-2] + 1, dtype=x.dtype, device=x.device)
        sideways = 0.003 * x[..., 0, 0]
        for _, *centre, _, _ in OBSTACLES:
            gap = now - now.new_tensor(centre)
            push = 0.008 * torch.exp(-((gap[..., 0] / 0.05) ** 2)) * torch.sign(gap[..., 0])
            sideways = sideways + push * ((gap[..., 1] > -0.13) & (gap[..., 1] < 0.02))
        speed = torch.stack([sideways, torch.full_like(sideways, 0.009)], -1)
        return now[..., None, :] + ahead[:, None] * speed[..., None, :]


def wandering_planner():
    """Returns a planner whose plans lead into different gaps or cylinders, depending on the noise alone."""
    return StatePlanner(Wandering(), state_dim=2, horizon=14, relative=False, num_steps=1)


class PlannedStep(TensorDictModuleBase):
    """A controller without parameters: its action is the difference of the next two frames."""

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys, self.num_past = ["state"], ["action"], 1

    def forward(self, tensordict):
        state = tensordict["state"]
        step = torch.cat([state[..., 1:, :], state[..., -1:, :]], -2)
        return tensordict.set("action", torch.cat([step[..., 1:, :], step[..., -1:, :]], -2) - step)


def episode_of(steps, *, success=False, collision=False, mode=3, start=0.0, plans=True):
    """Returns an episode whose position counts its steps and whose mode flag is a plain number."""
    count = start + torch.arange(steps + 1.0)[:, None].expand(-1, 4).contiguous()
    flags = {"success": success, "collision": collision}
    nested = {key: torch.zeros(steps, 1, dtype=torch.bool) for key in flags}
    for key, value in flags.items():
        nested[key][-1] = value
    chunk = {"plan": count[:-1, None, :2].expand(-1, 14, 2)} if plans else {}
    return TensorDict(
        {
            "observation": count[:-1],
            "action": torch.zeros(steps, 2),
            "next": {"observation": count[1:], "mode": torch.full((steps, 1), mode), **nested},
            **chunk,
        },
        [steps],
    )


def numbered_modes(number, **options):
    """Returns modes whose flag in :func:`episode_of` is their number."""
    return Modes((("way", tuple(map(str, range(number)))),), tuple((mode,) for mode in range(number)), **options)
