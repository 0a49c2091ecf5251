# This source code is licensed under the MIT license found in the LICENSE file.
"""The Diffusion Policy as a module: units, keys, noise, shapes."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_koap.modules import DiffusionPolicy, MLPDenoiser, StatePlanner, TemporalUnet

DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


class Columns(nn.Module):
    """Features that are the first column of every frame, times ten."""

    num_features = 2

    def forward(self, history):
        return 10 * history[..., 0]


def make_policy(**options):
    torch.manual_seed(0)
    features = options.get("features")
    width = 2 * options.get("history", 2) + (features.num_features if features is not None else 0)
    denoiser = MLPDenoiser(3, width, horizon=options.get("horizon", 14), width=16, depth=1)
    return DiffusionPolicy(denoiser, state_dim=2, action_dim=3, **options)


def walks(number, length=16):
    return (0.01 * torch.randn(number, length, 2, generator=torch.Generator().manual_seed(3))).cumsum(1)


def labels(number=80):
    generator = torch.Generator().manual_seed(4)
    return torch.tensor([5.0, 0.0, -2.0]) + torch.tensor([1.0, 0.1, 8.0]) * torch.randn(number, 3, generator=generator)


@pytest.mark.parametrize("mode", ["minmax", "standard", "identity"])
def test_decode_inverts_encode_and_all_steps_share_their_scale(mode):
    policy = make_policy()
    actions = labels(70)
    policy.fit_normalizers(walks(50), actions, mode=mode)
    chunks = actions.reshape(5, 14, 3)
    encoded = policy.encode_actions(chunks)
    torch.testing.assert_close(policy.decode_actions(encoded), chunks)
    shuffled = chunks[:, torch.randperm(14)]
    assert torch.equal(policy.encode_actions(shuffled).sort(1)[0], encoded.sort(1)[0])
    expected = {
        "minmax": lambda: (actions.amax(0) - actions.amin(0)) / 2,
        "standard": lambda: actions.std(0, correction=0),
        "identity": lambda: torch.ones(3),
    }[mode]()
    torch.testing.assert_close(policy.action_normalizer.scale, expected)
    if mode == "minmax":
        torch.testing.assert_close(encoded.amax((0, 1)), torch.ones(3))
        assert policy.encode_history(walks(50)[:, :2]).abs().max() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("features", [None, Columns()])
def test_the_condition_is_the_planners(relative, features):
    policy = make_policy(relative=relative, features=features)
    planner = StatePlanner(nn.Identity(), state_dim=2, relative=relative, features=features)
    windows = walks(40)
    history = windows[:4, :2]
    raw = policy.encode_history(history)
    before = history[:, 0] - history[:, 1] if relative else history[:, 0]
    torch.testing.assert_close(raw[:, :4], torch.cat([before, history[:, 1]], -1))
    if features is not None:
        torch.testing.assert_close(raw[:, 4:], 10 * history[..., 0])
    policy.fit_normalizers(windows, labels())
    planner.fit_normalizers(windows)
    torch.testing.assert_close(policy.encode_history(history), planner.encode_history(history))
    assert make_policy().relative is False


def test_sampling_solves_and_decodes():
    """A denoiser that predicts the clean actions, whatever the noise, from the condition alone."""

    class Constant(nn.Module):
        def forward(self, x, time, condition):
            return condition[..., None, 2:4].expand(*x.shape[:-1], 2) * torch.arange(1, x.shape[-2] + 1)[:, None]

    policy = DiffusionPolicy(Constant(), state_dim=2, action_dim=2, horizon=3, solver="ddim")
    policy.action_normalizer.offset.copy_(torch.tensor([1.0, 2.0]))
    policy.action_normalizer.scale.copy_(torch.tensor([10.0, 100.0]))
    actions = policy.sample(torch.tensor([[[9.0, 9.0], [0.5, 0.25]]]))
    torch.testing.assert_close(actions, torch.tensor([[[6.0, 27.0], [11.0, 52.0], [16.0, 77.0]]]))


def test_given_noise_makes_actions_independent_of_the_batch():
    policy = make_policy(num_steps=5, clip=1.0)
    history, noise = torch.randn(6, 2, 2), torch.randn(6, *policy.noise_shape)
    together = policy(TensorDict({"history": history, "noise": noise}, [6]))["action_chunk"]
    for row in range(6):
        torch.testing.assert_close(policy.sample(history[row], noise[row]), together[row], atol=1e-5, rtol=1e-4)
    assert not torch.equal(policy.sample(history), policy.sample(history))


def test_a_generator_repeats_actions():
    policy = make_policy(num_steps=10, clip=1.0)
    history = torch.randn(3, 2, 2)
    first, second, other = (policy.sample(history, generator=torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert torch.equal(first, second) and not torch.equal(first, other)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
def test_any_batch_dtype_and_device(batch, dtype, device):
    policy = DiffusionPolicy(
        TemporalUnet(3, 4, channels=(16,)), state_dim=2, action_dim=3, num_steps=3, clip=1.0, horizon=6
    )
    policy.fit_normalizers(walks(20, 8).double(), labels().double())
    policy.to(device=device, dtype=dtype)
    history = torch.randn(*batch, 2, 2, dtype=dtype, device=device)
    noise = policy.draw_noise(history)
    chunk = policy(TensorDict({"history": history, "noise": noise}, batch))["action_chunk"]
    assert chunk.shape == (*batch, 6, 3) and chunk.dtype == dtype and chunk.isfinite().all()
    flat = policy.sample(history.reshape(-1, 2, 2), noise.reshape(-1, 6, 3))
    torch.testing.assert_close(chunk.reshape(-1, 6, 3), flat)


def test_keys_can_be_renamed_and_the_call_dispatched():
    policy = make_policy(in_keys=[("a", "past")], out_keys=[("a", "do")], noise_key=("a", "luck"), num_steps=3)
    history, noise = torch.randn(3, 2, 2), torch.randn(3, 14, 3)
    data = policy(TensorDict({"a": {"past": history, "luck": noise}}, [3]))
    torch.testing.assert_close(data["a", "do"], policy.sample(history, noise))
    plain = make_policy(num_steps=3)
    assert plain(history=history).shape == (3, 14, 3)
    plain.set_keys(history="past", action_chunk="do")
    data = plain(TensorDict({"past": history, "noise": noise}, [3]))
    torch.testing.assert_close(data["do"], plain.sample(history, noise))


def test_statistics_travel_in_the_state_dict():
    policy, fresh = make_policy(num_steps=3), make_policy(num_steps=3)
    policy.fit_normalizers(walks(30), labels())
    history, noise = walks(5)[:, :2], torch.randn(5, 14, 3)
    assert not torch.allclose(fresh.sample(history, noise), policy.sample(history, noise))
    fresh.load_state_dict(policy.state_dict())
    torch.testing.assert_close(fresh.sample(history, noise), policy.sample(history, noise))
    torch.testing.assert_close(copy.deepcopy(policy).sample(history, noise), policy.sample(history, noise))


def test_noise_shape_of_policy_and_planner():
    assert make_policy(horizon=5).noise_shape == (5, 3)
    assert StatePlanner(nn.Identity(), state_dim=2, horizon=7).noise_shape == (7, 2)


def test_solver_and_steps_can_be_set_and_are_checked():
    policy = make_policy()
    assert policy.solver == "dpm++2m"
    policy.solver, policy.num_steps = "ddim", 50
    with pytest.raises(ValueError, match="num_steps must lie in 1..50"):
        policy.num_steps = 60
    assert policy.solver == "ddim" and policy.num_steps == 50


def test_wrong_shapes_and_hidden_labels_are_explained():
    policy = make_policy(num_steps=3)
    with pytest.raises(ValueError, match=r"'history' must be \[\*B, 2, 2\].* got \[5, 3, 2\]"):
        policy(TensorDict({"history": torch.zeros(5, 3, 2)}, [5]))
    with pytest.raises(ValueError, match=r"'noise' must be \[5, 14, 3\] \(\[\*B, horizon, action_dim\]\)"):
        policy.sample(torch.zeros(5, 2, 2), torch.zeros(5, 14, 2))
    with pytest.raises(ValueError, match=r"'action_chunk' must be \[\*B, 14, 3\].* got \[5, 12, 3\]"):
        policy.encode_actions(torch.zeros(5, 12, 3))
    with pytest.raises(ValueError, match=r"actions must be \[\*M, 3\] \(action_dim\), got \[9, 2\]"):
        policy.fit_normalizers(walks(4), torch.zeros(9, 2))
    with pytest.raises(ValueError, match=r"windows must be \[\*B, 16, 2\]"):
        policy.fit_normalizers(walks(4, 15), labels())
    before = policy.state_dict()["condition_normalizer.scale"].clone()
    hidden = labels()
    hidden[3] = torch.nan
    with pytest.raises(ValueError, match="1 of 80 rows are NaN"):
        policy.fit_normalizers(walks(4), hidden)
    assert torch.equal(policy.condition_normalizer.scale, before)  # a failed call changes nothing
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        make_policy(horizon=0)
    with pytest.raises(ValueError, match="action_dim must be at least 1"):
        DiffusionPolicy(nn.Identity(), state_dim=2, action_dim=0)
    with pytest.raises(ValueError, match="one in_key and one out_key"):
        make_policy(in_keys=["a", "b"])
