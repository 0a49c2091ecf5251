# This source code is licensed under the MIT license found in the LICENSE file.
"""Which of several plans is taken: on numbers, and a robot between two gaps in closed loop."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from toy_policies import EchoController

from torchrl_koap.modules import ChunkedPolicy, DiffusionPolicy, EpisodeNoise, PlanThenControl, TemporalUnet
from torchrl_koap.modules.execution.candidates import (
    MOST_CANDIDATES,
    choose,
    paths_apart,
    sample_coherent,
    steps_apart,
)


def plans_ending_at(*ends: float) -> torch.Tensor:
    """Plans of four steps and one column, at rest where they end: ``[N, 4, 1]``."""
    return torch.tensor(ends)[:, None, None].expand(-1, 4, 1)


def test_the_first_drawn_of_the_nearest_quarter_is_taken():
    plans = plans_ending_at(9.0, 1.5, 2.1, 2.0, -5.0, 2.4, 7.0, 8.0)
    assert choose(plans, torch.full((3, 1), 2.0), None).item() == 2  # 2.0 and 2.1: the first drawn of the two


def test_a_batch_is_chosen_row_by_row_and_episodes_that_begin_take_the_first():
    plans = torch.stack(
        [plans_ending_at(0.0, 1.0, 2.0), plans_ending_at(5.0, 1.0, 4.0), plans_ending_at(3.0, 1.0, 0.0)]
    )
    in_force = torch.tensor([2.0, 4.0, 0.0])[:, None, None].expand(3, 2, 1)
    fresh = torch.tensor([False, False, True])
    assert choose(plans, in_force, fresh).tolist() == [2, 2, 0]
    assert choose(plans, None, None).tolist() == [0, 0, 0]


def test_only_the_steps_that_both_plans_have_are_compared():
    plans = torch.tensor([[0.0, 0.0, 9.0], [0.1, 0.1, 0.0]]).unsqueeze(-1)
    assert choose(plans, torch.zeros(2, 1), None).item() == 0
    assert choose(plans, torch.zeros(3, 1), None).item() == 1


def test_many_candidates_do_not_sharpen_the_choice():
    """The spread of what is taken stays as the number grows."""
    generator = torch.Generator().manual_seed(0)

    def spread(number: int) -> float:
        plans = torch.randn(2000, number, 1, 1, generator=generator)
        index = choose(plans, torch.zeros(2000, 1, 1), None)
        return plans[torch.arange(2000), index].std().item()

    assert spread(64) == pytest.approx(spread(16), rel=0.2)


def test_wrong_calls():
    with pytest.raises(ValueError, match=r"the plan in force has 5 steps, the candidates only 4"):
        choose(plans_ending_at(0.0, 1.0), torch.zeros(5, 1), None)
    with pytest.raises(ValueError, match=r"the plan in force must be \['K', 1\], got \[4, 2\]"):
        choose(plans_ending_at(0.0, 1.0), torch.zeros(4, 2), None)


def test_a_late_robot_goes_on_with_its_plan_by_going_the_same_way():
    """The plan in force leads up and to the right; the candidates start two steps behind it."""
    steps = torch.arange(8.0)
    in_force = torch.stack([steps, steps], -1)
    behind = torch.stack([steps - 2, steps - 2], -1)  # the same way, late
    straight = torch.stack([torch.zeros(8), steps], -1)  # another way, in time
    plans = torch.stack([straight, behind])
    assert paths_apart(plans[:, 2:], in_force).argmin() == 1
    assert paths_apart(plans[:, 2:], in_force)[1] == pytest.approx(0, abs=1e-6)
    assert steps_apart(plans, in_force).tolist() == [pytest.approx(8.75), 4.0]
    assert choose(plans[:, 2:], in_force, None, paths_apart).item() == 1


class TwoGaps(nn.Module):
    """Plans lead straight to the left or the right, as the noise says; nothing observed matters."""

    history, horizon, state_dim, noise_shape = 1, 6, 1, (6, 1)
    noise_key = "noise"

    def sample(self, history, noise=None):
        way = torch.arange(1.0, 7)[:, None]
        return history[..., -1:, :] + way * torch.where(noise[..., :1, :] > 0, 1.0, -1.0)

    def scale_columns(self, plan):
        return plan


def directions(policy, noise: EpisodeNoise, count: int, steps: int, restart: int) -> torch.Tensor:
    """Sign of the plan in force at every step ``[count, steps]``; episodes begin anew at step ``restart``."""
    td, signs = TensorDict(batch_size=[count]), []
    for step in range(steps):
        td = noise(td)
        td["observation_history"] = torch.zeros(count, 1, 1)
        td["is_init"] = torch.full((count, 1), step in (0, restart))
        td = policy(td)
        signs.append(td["remaining_plan"][:, 0, 0].sign())
    return torch.stack(signs, 1)


def test_a_robot_between_two_gaps_keeps_its_word():
    def policy(candidates):
        return PlanThenControl(
            TwoGaps(),
            EchoController(num_past=0),
            state_columns=(0,),
            history=1,
            replan_interval=2,
            candidates=candidates,
        )

    count, restart = 200, 12
    one = directions(policy(1), EpisodeNoise(range(count), (6, 1), num_steps=24), count, 24, restart)
    many = directions(policy(16), EpisodeNoise(range(count), (16, 6, 1), num_steps=24), count, 24, restart)
    assert (one[:, :12:2].std(1) > 0).float().mean() > 0.8  # a coin for every plan
    for episode in (many[:, :restart], many[:, restart:]):
        assert (episode == episode[:, :1]).float().mean() > 0.9  # one direction for the whole episode,
        assert 0.35 < (episode[:, 0] > 0).float().mean() < 0.65  # and either for about half of them
    assert (many[:, 0] != many[:, restart]).float().mean() > 0.3  # drawn anew at every reset


def test_one_candidate_is_the_policy_of_before():
    planner = TwoGaps()
    history, noise = torch.zeros(3, 1, 1), torch.randn(3, 6, 1)
    chosen = sample_coherent(planner.sample, planner.scale_columns, history, noise, number=1, in_force=None, fresh=None)
    assert (chosen == planner.sample(history, noise)).all()


def test_diffusion_policy_with_candidates_executes_one_of_its_chunks():
    torch.manual_seed(0)
    planner = DiffusionPolicy(TemporalUnet(2, 4, channels=(8,)), state_dim=2, action_dim=2, num_steps=2).eval()
    policy = ChunkedPolicy(planner, state_columns=(0, 1), history=2, replan_interval=3, candidates=5)
    noise = EpisodeNoise([7, 8], (5, *planner.noise_shape), num_steps=9)
    draws, td = noise.draws, TensorDict(batch_size=[2])
    observed = torch.randn(9, 2, 2, 2)
    chunk = None
    for step in range(9):
        td = noise(td)
        td["observation_history"] = observed[step]
        td["is_init"] = torch.full((2, 1), step == 0)
        with torch.no_grad():
            td = policy(td)
            if step % 3 == 0:
                repeated = observed[step].unsqueeze(1).expand(2, 5, 2, 2)
                chunks = planner.sample(repeated, draws[:, step])
                index = torch.zeros(2, dtype=torch.long)
                if step:
                    apart = (chunks[:, :, :-3] - chunk[:, None, 3:]).square().mean((-2, -1))
                    index = (apart == apart.amin(-1, keepdim=True)).int().argmax(-1)  # a quarter of five is one
                chunk = chunks[torch.arange(2), index]
        assert torch.allclose(td["action"], chunk[:, step % 3], atol=1e-6)


@pytest.mark.parametrize("number", [0, MOST_CANDIDATES + 1, True])
def test_numbers_of_candidates_out_of_range(number):
    with pytest.raises(ValueError, match=f"candidates must be an integer in 1..{MOST_CANDIDATES}, got {number}"):
        PlanThenControl(TwoGaps(), EchoController(), state_columns=(0,), history=1, candidates=number)


def test_open_loop_keeps_no_plan_to_compare_with():
    with pytest.raises(ValueError, match="several candidates need execution 'feedback'"):
        PlanThenControl(TwoGaps(), EchoController(), state_columns=(0,), history=1, candidates=2, execution="open_loop")
