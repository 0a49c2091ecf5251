# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans seen from an object, and of which some steps are modelled: inverse, and blind to what they should not see."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.modules.diffusion.planar_frame import PlanarFrame

# tool x, y, height; object x, y; its cos, sin
POINTS, DIRECTIONS = [(0, 1), (3, 4)], [(5, 6)]
WIDTH = 7


def make_frame():
    return PlanarFrame(POINTS, DIRECTIONS, origin=(3, 4), heading=(5, 6))


def windows(count=20, length=16):
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(count, length, WIDTH, generator=generator).cumsum(1) / 10
    yaw = states[..., 5].clone()
    states[..., 5], states[..., 6] = yaw.cos(), yaw.sin()
    return states


def moved(states, shift, angle):
    """The whole scene moved and turned on the table."""
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    states = states.clone()
    for pair in POINTS:
        states[..., list(pair)] = states[..., list(pair)] @ turn.T + torch.tensor(shift)
    states[..., [5, 6]] = states[..., [5, 6]] @ turn.T
    return states


def make_planner(**options):
    frames = len(options.get("steps", range(options.get("horizon", 14))))
    torch.manual_seed(0)
    planner = StatePlanner(
        MLPDenoiser(WIDTH, 2 * WIDTH, horizon=frames, width=8, depth=1), state_dim=WIDTH, num_steps=2, **options
    )
    planner.fit_normalizers(windows(length=2 + planner.horizon))
    return planner


def test_the_object_lies_at_the_origin_of_its_frame():
    states = windows()
    now = states[:, 1:2]
    seen = make_frame()(states, now)
    assert torch.allclose(seen[:, 1, 3:], torch.tensor([0.0, 0.0, 1.0, 0.0]).expand(20, 4), atol=1e-6)
    assert torch.equal(seen[..., 2], states[..., 2])
    assert torch.allclose(make_frame().inverse(seen, now), states, atol=1e-6)
    gap = (states[..., :2] - now[..., 3:5]).norm(dim=-1)
    assert torch.allclose(seen[..., :2].norm(dim=-1), gap, atol=1e-6)


@pytest.mark.parametrize("relative", [True, False])
def test_a_planner_with_a_frame_does_not_see_where_the_scene_lies(relative):
    planner, plain = make_planner(frame=make_frame(), relative=relative, clip=1.0), make_planner(relative=relative)
    history, noise = windows()[:5, :2], torch.randn(5, 14, WIDTH)
    elsewhere = moved(history, (0.3, -0.2), 1.1)
    assert torch.allclose(planner.condition(elsewhere), planner.condition(history), atol=1e-5)
    assert not torch.allclose(plain.condition(elsewhere), plain.condition(history), atol=1e-2)
    plan = planner.plan(history, noise)
    assert torch.allclose(planner.plan(elsewhere, noise), moved(plan, (0.3, -0.2), 1.1), atol=1e-3)


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("frame", [None, make_frame()])
@pytest.mark.parametrize("steps", [None, (1, 2, 3, 5, 8, 14), (2, 7, 20)])
def test_plans_come_back_at_the_steps_that_are_modelled(relative, frame, steps):
    horizon = 14 if steps is None else steps[-1]
    planner = make_planner(
        relative=relative, frame=frame, horizon=horizon, **({} if steps is None else {"steps": steps})
    )
    history, plan = planner.split_window(windows(length=2 + horizon))
    back = planner.decode_plan(history, planner.encode_plan(history, plan))
    kept = [step - 1 for step in planner.steps]
    assert back.shape == plan.shape and torch.allclose(back[:, kept], plan[:, kept], atol=1e-5)
    assert planner.plan(history).shape == plan.shape


def test_frames_in_between_lie_on_straight_lines():
    planner = make_planner(steps=(1, 4, 14))
    history, plan = planner.split_window(windows())
    back = planner.decode_plan(history, planner.encode_plan(history, plan))
    assert torch.allclose(back[:, 1], (2 * plan[:, 0] + plan[:, 3]) / 3, atol=1e-5)
    assert torch.allclose(back[:, 8], (plan[:, 3] + plan[:, 13]) / 2, atol=1e-5)
    late = make_planner(steps=(4, 14))
    back = late.decode_plan(history, late.encode_plan(history, plan))
    assert torch.allclose(back[:, 1], (history[:, -1] + plan[:, 3]) / 2, atol=1e-5)


def test_states_that_are_known_stay():
    planner = make_planner(steps=(1, 2, 3, 6, 14))
    history, plan = planner.split_window(windows()[:3])
    made = planner.plan(history, known=plan[:, :4])
    assert torch.allclose(made[:, :3], plan[:, :3], atol=1e-4)


@pytest.mark.parametrize("steps", [(1, 2, 13), (0, 14), (3, 2, 14), (2, 2, 14), ()])
def test_steps_that_do_not_rise_to_the_horizon(steps):
    with pytest.raises(ValueError, match="steps must rise from 1 or more to the horizon, 14, got"):
        StatePlanner(MLPDenoiser(WIDTH, 2 * WIDTH, horizon=3), state_dim=WIDTH, steps=steps)
