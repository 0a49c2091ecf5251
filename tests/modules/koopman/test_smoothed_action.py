# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests latent actions of smoothed windows, the choice of the raw window, and the smoother."""

import copy

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories, select_state
from torchrl_koap.modules import PRESETS, KoopmanLifting, LatentActionFourier, Normalizer, make_koopman_inverse_dynamics
from torchrl_koap.modules.koopman.smoothed_action import LIFTED, RAW, LatentActionSmoothed, WienerSmoother
from torchrl_koap.training.closed_form import fit_closed_form

BLOCKS = (LIFTED, RAW)


def make_infer(columns=2, dim=2, **options):
    torch.manual_seed(0)
    lifting = KoopmanLifting(columns, dim, include_state=columns == dim, linear_skip=columns != dim)
    return LatentActionSmoothed(lifting, 16, **options)


def make_data(columns, episodes=60, length=30, noise=0.0):
    generator = torch.Generator().manual_seed(1)
    phase, period = 6.28 * torch.rand(episodes, 1, 2, generator=generator), torch.tensor([24.0, 37.0])
    action = 0.1 * torch.sin(6.28 * torch.arange(length)[:, None] / period + phase)
    place = torch.cat([torch.zeros(episodes, 1, 2), action.cumsum(1)], 1)
    mix = torch.randn(2, columns, generator=generator) if columns > 2 else torch.eye(2)
    state = place @ mix
    state = state + noise * torch.randn(state.shape, generator=generator)
    return select_state(flatten_trajectories(state.unbind(), action.unbind()), range(columns))


def test_the_block_chosen_is_written_and_the_other_is_zero():
    infer = make_infer()
    windows = torch.randn(6, 17, 2).cumsum(1)
    infer.finish(windows)
    size = infer.lifted.latent_dim
    latent = infer.infer(infer.gather(windows))
    assert latent.shape == (6, 17, infer.latent_dim) and (latent[..., size:] == 0).all() and latent[..., :size].any()
    infer.choose(RAW)
    latent = infer.infer(infer.gather(windows))
    assert (latent[..., :size] == 0).all()
    torch.testing.assert_close(latent[..., size:], infer.raw.infer(infer.raw.gather(windows)))
    alone = LatentActionFourier(2, 16, num_past=4, look_ahead=(2, 3, 4, 5))
    alone.prepare(windows)
    assert torch.equal(infer.raw.reader.scales, alone.reader.scales)
    infer.choose(LIFTED)
    before = infer.infer(infer.gather(windows))
    infer.finish(windows)  # a second time, as after training
    torch.testing.assert_close(infer.infer(infer.gather(windows)), before)


def test_the_successor_is_never_read():
    infer = make_infer()
    windows = torch.randn(6, 17, 2).cumsum(1)
    infer.finish(windows)
    changed = windows.clone()
    changed[:, 9] += 1.0
    for block in infer.blocks:
        infer.choose(block)
        before, after = (infer.infer(infer.gather(value, range(8, 9))) for value in (windows, changed))
        assert torch.equal(before, after)


def test_the_choice_is_kept_by_the_weights():
    infer, other = make_infer(), make_infer()
    infer.choose(RAW)
    other.load_state_dict(infer.state_dict())
    assert other.chosen == RAW and make_infer().chosen == LIFTED


def test_the_choice_comes_with_weights_that_are_copied_as_tensors():
    windows, infer, other = torch.randn(6, 17, 2).cumsum(1), make_infer(), make_infer()
    infer.finish(windows)
    infer.choose(RAW)
    TensorDict.from_module(other).data.update_(TensorDict.from_module(infer).data)
    assert torch.equal(other(state=windows), infer(state=windows))


def test_the_raw_block_must_not_read_further_frames():
    with pytest.raises(ValueError, match="reads 4 frames back and 5 ahead: .* got 3 and 8"):
        make_infer(num_past=3)
    with pytest.raises(ValueError, match="got 8 and 4"):
        make_infer(look_ahead=(2, 3, 4))
    assert make_infer(look_ahead=8).reader.look_ahead == (8,)


def test_frames_with_a_clamped_look_ahead_count_if_asked_for():
    assert [make_infer(clamped=clamped).reader.valid_frames(20) for clamped in (False, True)] == [
        range(8, 12),
        range(8, 18),
    ]


def test_steps_of_the_state_are_at_the_declared_positions():
    infer = make_infer()
    windows = torch.randn(50, 17, 2).cumsum(1)
    infer.finish(windows)
    for block, past in ((LIFTED, 8), (RAW, 4)):
        infer.choose(block)
        if block == LIFTED:
            infer.smoother.gain.copy_(torch.eye(len(infer.smoother.gain)))
        latent = infer.infer(infer.gather(windows, range(8, 9)))[:, 0]
        entries, factors = infer.axis_features([0, 1])
        steps = latent[:, entries] * factors
        torch.testing.assert_close(steps[:, past - 1], windows[:, 8] - windows[:, 7])
    infer.choose(LIFTED)
    infer.smoother.gain.zero_()  # every frame becomes the mean of its window
    assert infer.infer(infer.gather(windows))[..., : infer.lifted.motion_dim].abs().max() < 1e-5
    wide = make_infer(columns=20)
    assert wide.axis_features([0]) is None
    wide.choose(RAW)
    assert wide.axis_features([0]) is not None


@pytest.mark.parametrize("columns", [2, 12])
def test_the_raw_block_is_kept_where_its_held_out_error_is_clearly_smaller(columns, monkeypatch):
    data = make_data(columns, noise=0.15)
    torch.manual_seed(0)
    model = make_koopman_inverse_dynamics(
        columns,
        2,
        preset="semi_supervised",
        num_features=0,
        state_normalizer=Normalizer.fit(data["state"], mode="standard"),
        action_normalizer=Normalizer.fit(data["action"], mode="rms"),
    )
    windows = data["state"].view(-1, 30, columns)
    model.prepare(windows)
    model.finish(windows)
    data["has_action"] = data["has_action"] & (data["episode"] < 2)[:, None]
    errors = {}
    for block in BLOCKS:
        with monkeypatch.context() as patch:
            patch.setattr(LatentActionSmoothed, "blocks", (block,))
            errors[block] = fit_closed_form(model, data)["held_out_error"]
    ratio = errors[RAW] / errors[LIFTED]
    for share, kept in ((1.01 * ratio, RAW), (0.99 * ratio, LIFTED)):
        monkeypatch.setattr("torchrl_koap.modules.koopman.smoothed_action.RAW_SHARE", share)
        fit = fit_closed_form(model, data)
        assert fit["block"] == model.latent_action.chosen == kept
        assert fit["held_out_error"] == pytest.approx(errors[kept], rel=1e-4)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("columns", [33, 2000])
def test_every_preset_is_built_for_wide_states(preset, columns):
    model = make_koopman_inverse_dynamics(columns, 2, preset=preset)
    written = model(TensorDict({"state": torch.randn(1, 17, columns)}, [1]))
    assert written["action"].shape == (1, 17, 2) and written["action"].isfinite().all()


@pytest.mark.parametrize("columns", [3, 33])
@pytest.mark.parametrize("preset", PRESETS)
def test_a_single_window_needs_no_batch_dimension(preset, columns):
    torch.manual_seed(0)
    model, window = make_koopman_inverse_dynamics(columns, 2, preset=preset), torch.randn(60, columns).cumsum(0)
    fitted = [copy.deepcopy(model) for _ in range(2)]
    for each, given in zip(fitted, (window, window[None]), strict=True):
        each.prepare(given, updates=1)
        each.finish(given)
    torch.testing.assert_close(*(each.state_dict() for each in fitted))


FRAMES = [-4, -3, -2, -1, 0, 2, 3, 4]


def make_motion(noise, num=1500, frames=12):
    generator = torch.Generator().manual_seed(0)
    phase = 6.28 * torch.rand(num, 1, 2, generator=generator)
    clean = torch.sin(0.25 * torch.arange(frames)[:, None] + phase)
    return clean, clean + noise * torch.randn(clean.shape, generator=generator)


def test_smoothing_takes_noise_out_and_leaves_clean_windows():
    index = [4 + frame for frame in FRAMES]
    clean, noisy = make_motion(0.3)
    smoother = WienerSmoother(len(index), 2)
    assert torch.allclose(smoother(noisy[:, index]), noisy[:, index], atol=1e-6)  # before the fit
    smoother.fit(noisy[:, index], noisy)
    error = (smoother(noisy[:, index]) - clean[:, index]).square().mean().sqrt()
    assert error < 0.6 * 0.3
    smoother.fit(clean[:, index], clean)
    assert (smoother(clean[:, index]) - clean[:, index]).abs().max() < 1e-4
    assert smoother(clean[:, index][None]).shape == (1, 1500, 8, 2)
    smoother.fit((noisy - clean)[:, index], noisy - clean)  # noise alone: no direction is turned round
    assert torch.linalg.eigvals(smoother.gain).real.min() > -1e-4
