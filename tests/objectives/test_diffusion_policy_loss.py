# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the Diffusion Policy's loss: closed forms, time alignment, labels, padding, statistics."""

import pytest
import torch
from denoising_test_base import DenoisingLossTestBase, noised
from tensordict import TensorDict

from torchrl_koap.modules import DiffusionPolicy, MLPDenoiser
from torchrl_koap.objectives import DiffusionPolicyLoss

HORIZON, ACT = 6, 3


def make_policy(history=2, **options):
    denoiser = MLPDenoiser(ACT, 2 * history, horizon=HORIZON, width=32)
    policy = DiffusionPolicy(denoiser, state_dim=2, action_dim=ACT, history=history, horizon=HORIZON, **options)
    data = batch_of(64, history=history)
    policy.fit_normalizers(data["state"], data["action"][data["has_action"].squeeze(-1)])
    return policy


def make_loss(seed=0, policy_options=None, **options):
    torch.manual_seed(seed)
    return DiffusionPolicyLoss(make_policy(**(policy_options or {})), **options)


def batch_of(*batch, history=2):
    generator = torch.Generator().manual_seed(3)
    length = history + HORIZON
    has_action = torch.rand(*batch, length, 1, generator=generator) < 0.7
    action = 2 + 5 * torch.randn(*batch, length, ACT, generator=generator)
    return TensorDict(
        {
            "state": torch.randn(*batch, length, 2, generator=generator).cumsum(-2),
            "action": torch.where(has_action, action, torch.nan),
            "has_action": has_action,
            "policy_noise": torch.randn(*batch, HORIZON, ACT, generator=generator),
            "policy_time": torch.randint(1, 50, batch, generator=generator),
        },
        batch,
    )


class TestDiffusionPolicyLoss(DenoisingLossTestBase):
    default_keys = {
        "state": "state",
        "action": "action",
        "has_action": "has_action",
        "padded": "padded",
        "noise": "policy_noise",
        "time": "policy_time",
    }
    in_names, out_keys = ("state", "action", "has_action"), ("loss_policy",)

    make_loss = staticmethod(make_loss)
    make_batch = staticmethod(batch_of)

    def counted(self, batch, key, elements):
        return int(batch["has_action"][..., 1:-1, :].sum()) * ACT


def test_statistics_fitted_after_the_loss_was_built_are_those_it_trains_with():
    loss, data = make_loss(), batch_of(64)
    loss.network.fit_normalizers(100 * data["state"], 100 * data["action"][data["has_action"].squeeze(-1)])
    assert torch.equal(loss(data)["loss_policy"], DiffusionPolicyLoss(loss.network)(data)["loss_policy"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("history", [1, 3])
def test_value_in_closed_form(dtype, history):
    loss = make_loss(policy_options={"history": history}, reduction="none").to(dtype)
    data = batch_of(5, history=history).apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    value = loss(data)["loss_policy"]

    policy, noise, time = loss.network, data["policy_noise"], data["policy_time"].to(dtype)
    frames = slice(history - 1, history - 1 + HORIZON)
    counts = data["has_action"][:, frames]
    clean = (data["action"][:, frames] - policy.action_normalizer.offset) / policy.action_normalizer.scale
    clean = clean.nan_to_num(0.0)
    condition = data["state"][:, :history].flatten(1)
    condition = (condition - policy.condition_normalizer.offset) / policy.condition_normalizer.scale
    with loss.network_params.to_module(policy):
        output = policy.denoiser(noised(policy, clean, noise, time), time, condition)
    torch.testing.assert_close(value, torch.where(counts, (output - clean) ** 2, 0.0), atol=1e-4, rtol=1e-4)
    assert value.dtype == dtype and 0 < counts.sum() < counts.numel()


def test_only_labelled_recorded_transitions_from_the_present_on_count():
    data = batch_of(1)
    data["has_action"] = torch.ones(1, 8, 1, dtype=torch.bool)
    data["action"] = torch.randn(1, 8, ACT)
    loss = make_loss(reduction="none")

    def counted(**entries):
        return (loss(data.clone().update(entries))["loss_policy"] > 0).all(-1)[0].nonzero().flatten().tolist()

    frames = torch.arange(8)
    assert counted() == [0, 1, 2, 3, 4, 5]
    assert counted(has_action=((frames == 1) | (frames == 6))[None, :, None]) == [0, 5]
    assert counted(has_action=((frames == 0) | (frames == 7))[None, :, None]) == []
    assert counted(padded=(frames >= 5)[None]) == [0, 1, 2]  # frame 4 -> 5 leads into padding
    assert counted(padded=(frames < 1)[None, :, None]) == [0, 1, 2, 3, 4, 5]  # a repeated past takes no action away
    assert counted(padded=(frames < 2)[None]) == [1, 2, 3, 4, 5]


def test_the_future_states_are_not_read():
    data, loss = batch_of(4), make_loss()
    other = data.clone()
    other["state"][:, 2:] = torch.nan
    assert torch.equal(loss(data)["loss_policy"], loss(other)["loss_policy"])
    other["state"][:, 1] += 1
    assert not torch.equal(loss(data)["loss_policy"], loss(other)["loss_policy"])


def test_bad_input_is_explained():
    loss = make_loss()
    data = batch_of(4)
    with pytest.raises(ValueError, match=r"windows must be \[\*B, 8, 2\]"):
        loss(data.clone().set("state", data["state"][:, 1:]))
    with pytest.raises(ValueError, match=r"'action' must be \[4, 8, 3\] \(\[\*B, T, act\]\), got \[4, 6, 3\]"):
        loss(data.clone().set("action", data["action"][:, 1:-1]))
    with pytest.raises(ValueError, match=r"'has_action' must be bool \[4, 8, 1\] .*, got torch.float32"):
        loss(data.clone().set("has_action", data["has_action"].float()))
