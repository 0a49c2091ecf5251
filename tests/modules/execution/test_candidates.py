# This source code is licensed under the MIT license found in the LICENSE file.
"""Which of several plans is taken: rules on numbers, and a robot between two gaps in closed loop."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from toy_policies import EchoController

from torchrl_koap.modules import DiffusionPolicy, Execution, NoiseStreams, TemporalUnet, make_policy
from torchrl_koap.modules.execution.candidates import first_of_nearest, paths_apart, sample_coherent, steps_apart


def test_the_first_of_the_nearest_quarter_is_taken():
    ends = torch.tensor([9.0, 1.5, 2.1, 2.0, -5.0, 2.4, 7.0, 8.0])
    assert first_of_nearest((ends - 2.0).square()).item() == 2  # 2.0 and 2.1: the first drawn of the two


def test_a_batch_is_chosen_row_by_row_and_episodes_that_begin_take_the_first():
    ends = torch.tensor([[0.0, 1.0, 2.0], [5.0, 1.0, 4.0], [3.0, 1.0, 0.0]])
    plans = ends[..., None, None].expand(3, 3, 4, 1)
    previous, started = torch.tensor([2.0, 4.0, 0.0])[:, None, None], torch.tensor([False, False, True])

    def taken(**more):
        chosen = sample_coherent(lambda history, noise: plans, torch.zeros(3, 1, 1), None, 3, **more)
        return chosen[:, 0, 0].tolist()

    assert taken(distance=lambda plans: steps_apart(plans, previous), started=started) == [2, 4, 3]
    assert taken() == [0, 5, 3]


def test_only_the_steps_that_both_plans_have_are_compared():
    plans = torch.tensor([[0.0, 0.0, 9.0], [0.1, 0.1, 0.0]]).unsqueeze(-1)
    assert steps_apart(plans, torch.zeros(2, 1)).argmin() == 0
    assert steps_apart(plans, torch.zeros(3, 1)).argmin() == 1


def test_many_candidates_do_not_sharpen_the_choice():
    """The spread of what is taken stays as the number grows."""
    generator = torch.Generator().manual_seed(0)

    def spread(number: int) -> float:
        plans = torch.randn(2000, number, generator=generator)
        return plans[torch.arange(2000), first_of_nearest(plans.square())].std().item()

    assert spread(64) == pytest.approx(spread(16), rel=0.2)


def test_a_late_robot_goes_on_with_its_plan_by_going_the_same_way():
    """The current plan leads up and to the right; the candidates start two steps behind it."""
    steps = torch.arange(8.0)
    current = torch.stack([steps, steps], -1)
    behind = torch.stack([steps - 2, steps - 2], -1)  # the same way, late
    straight = torch.stack([torch.zeros(8), steps], -1)  # another way, in time
    plans = torch.stack([straight, behind])
    assert paths_apart(plans[:, 2:], current).argmin() == 1
    assert paths_apart(plans[:, 2:], current)[1] == pytest.approx(0, abs=1e-6)
    assert steps_apart(plans, current).tolist() == [pytest.approx(8.75), 4.0]


class TwoGaps(nn.Module):
    """Plans lead straight to the left or the right, as the noise says; nothing observed matters."""

    history, horizon, num_steps, solver, state_dim = 1, 6, 1, "ddim", 1
    sample_shape = noise_shape = (6, 1)
    noise_key = "noise"

    def sample(self, history, noise=None):
        way = torch.arange(1.0, 7)[:, None]
        return history[..., -1:, :] + way * torch.where(noise[..., :1, :] > 0, 1.0, -1.0)

    def scale_columns(self, plan):
        return plan


def directions(policy, count: int, steps: int, restart: int) -> torch.Tensor:
    """Sign of the current plan at every step ``[count, steps]``; episodes begin anew at step ``restart``."""
    noise, td, signs = NoiseStreams(range(count), policy.noise_shape, block=steps), TensorDict(batch_size=[count]), []
    for step in range(steps):
        td["noise"] = noise.draw()
        td["observation_history"] = torch.zeros(count, 1, 1)
        td["is_init"] = torch.full((count, 1), step in (0, restart))
        td = policy(td)
        signs.append(td["planned_state"][:, 0].sign())
    return torch.stack(signs, 1)


def test_a_robot_between_two_gaps_keeps_its_word():
    def policy(candidates):
        execution = Execution(replan_interval=2, candidates=candidates)
        return make_policy(TwoGaps(), EchoController(num_past=0), state_of=(0,), execution=execution)

    count, restart = 200, 12
    one, many = (directions(policy(candidates), count, 24, restart) for candidates in (1, 16))
    assert (one[:, :12:2].std(1) > 0).float().mean() > 0.8  # a coin for every plan
    for episode in (many[:, :restart], many[:, restart:]):
        assert (episode == episode[:, :1]).float().mean() > 0.9  # one direction for the whole episode,
        assert 0.35 < (episode[:, 0] > 0).float().mean() < 0.65  # and either for about half of them
    assert (many[:, 0] != many[:, restart]).float().mean() > 0.3  # drawn anew at every reset


def test_diffusion_policy_with_candidates_executes_one_of_its_chunks():
    torch.manual_seed(0)
    planner = DiffusionPolicy(TemporalUnet(2, 4, channels=(8,)), state_dim=2, action_dim=2, num_steps=2).eval()
    policy = make_policy(planner, state_of=(0, 1), execution=Execution(replan_interval=3, candidates=5))
    assert policy.noise_shape == (5, 14, 2)
    noise, td = NoiseStreams([7, 8], policy.noise_shape, block=9), TensorDict(batch_size=[2])
    observed = torch.randn(9, 2, 2, 2)
    chunk = None
    for step in range(9):
        td["noise"] = noise.draw()
        td["observation_history"] = observed[step]
        td["is_init"] = torch.full((2, 1), step == 0)
        with torch.no_grad():
            td = policy(td)
            if step % 3 == 0:
                repeated = observed[step].unsqueeze(1).expand(2, 5, 2, 2)
                chunks = planner.sample(repeated, td["noise"])
                index = torch.zeros(2, dtype=torch.long)
                if step:
                    apart = (chunks[:, :, :-3] - chunk[:, None, 3:]).square().mean((-2, -1))
                    index = apart.argmin(-1)  # a quarter of five is one
                chunk = chunks[torch.arange(2), index]
        assert torch.allclose(td["action"], chunk[:, step % 3], atol=1e-6)
