# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the compact lifting: components in units of noise, coordinates of curved surfaces, their number."""

import copy

import pytest
import torch

from torchrl_koap.modules import make_koopman_inverse_dynamics
from torchrl_koap.modules.koopman.compact_lifting import (
    CompactLifting,
    NoiseAdjustedComponents,
    isomap,
    noise_covariance,
)
from torchrl_koap.modules.koopman.smoothed_action import LatentActionSmoothed


def turning(count=400, length=17, bodies=1):
    """Phases of bodies that turn at speeds of their own, ``[count, length, bodies]``."""
    torch.manual_seed(0)
    speed = 0.15 * (1 + torch.arange(bodies) / 2)
    return 6.28 * torch.rand(count, 1, bodies) + speed * torch.arange(length)[:, None]


def embedded(motion, columns=24, noise=0.02):
    torch.manual_seed(1)
    weight, bias = torch.randn(motion.shape[-1], columns), torch.randn(columns)
    seen = torch.tanh(motion @ weight + bias)
    return seen + noise * torch.randn_like(seen)


def train(lifting, windows, steps=250):
    lifting.prepare(windows)
    optimiser = torch.optim.Adam(lifting.parameters(), 5e-3)
    for step in range(steps):
        batch = windows[torch.randint(len(windows), (32,), generator=torch.Generator().manual_seed(step))]
        optimiser.zero_grad()
        lifting.reconstruction_error(lifting.encode(batch), batch).mean().backward()
        optimiser.step()


def test_noise_is_told_from_a_smooth_motion():
    speed = torch.randn(4000, 1, 2, generator=torch.Generator().manual_seed(2))
    windows = (3 * speed + 0.5 * torch.arange(12)[:, None]).sin()
    assert noise_covariance(windows).abs().max() < 1e-3
    spread = torch.tensor([[0.3, 0.0], [0.2, 0.1]])
    noise = torch.randn(windows.shape, generator=torch.Generator().manual_seed(3)) @ spread.mT
    torch.testing.assert_close(noise_covariance(windows + noise).float(), spread @ spread.mT, rtol=0, atol=0.02)


class TestNoiseAdjustedComponents:
    def test_components_with_least_noise_come_first(self):
        phase = turning()
        clean = torch.cat([phase.sin(), phase.cos()], -1)
        windows = torch.cat([0.1 * clean, 10 * torch.randn(400, 17, 2)], -1)
        windows[..., :2] += 0.01 * torch.randn(400, 17, 2)
        components = NoiseAdjustedComponents(4, 3)
        components.fit(windows)
        assert (components.weights > 0).tolist() == [True, True, False]
        # the loud columns are noise alone: a principal component would be one of them
        assert (components.analysis[:2, 2:].abs() < 0.02 * components.analysis[:2, :2].abs().max()).all()

    def test_components_have_unit_spread_and_are_inverted(self):
        windows = embedded(turning(bodies=2).sin(), columns=6, noise=0.0)
        components = NoiseAdjustedComponents(6, 6)
        components.fit(windows)
        made = components(windows).flatten(0, 1)
        torch.testing.assert_close(made.std(0), torch.ones(6), rtol=1e-2, atol=0)
        torch.testing.assert_close(components.invert(components(windows)), windows, rtol=0, atol=1e-3)
        assert abs(components.weights.mean().item() - 1) < 1e-4

    def test_noise_alone_still_leaves_a_component(self):
        components = NoiseAdjustedComponents(3, 3)
        components.fit(torch.randn(300, 17, 3))
        assert (components.weights > 0).any() and components.weights.isfinite().all()

    def test_a_state_that_never_moves(self):
        components = NoiseAdjustedComponents(3, 2)
        components.fit(torch.zeros(20, 17, 3))
        assert components(torch.ones(4, 3)).isfinite().all() and components.weights.isfinite().all()

    def test_no_direction_is_free_of_noise_by_the_chance_of_few_windows(self):
        place = turning(count=200, bodies=2).sin()
        first, second = (torch.randn(2, 40, generator=torch.Generator().manual_seed(seed)) for seed in (3, 5))
        clean = place @ first + 0.3 * (3 * place).sin() @ second
        components = NoiseAdjustedComponents(40, 40)
        components.fit(clean + 0.3 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(4)))
        noise = components.analysis.square().sum(-1).sqrt()  # what white noise of unit size leaves in each component
        stand_out = components(clean).flatten(0, 1).std(0) / noise.clamp_min(1e-9)
        assert stand_out[:2].min() > 3.5  # 1.1 and 2.7 where the estimate is believed as it is


class TestCompactLifting:
    @pytest.mark.parametrize(("bodies", "kept"), [(2, 2), (4, 4)])
    def test_kept_coordinates_are_as_many_as_moving_bodies(self, bodies, kept):
        windows = embedded(turning(bodies=bodies).sin())
        lifting = CompactLifting(24, 2)
        train(lifting, windows)
        lifting.finish(windows)
        assert int(lifting.kept.sum()) == kept
        lifted = lifting.encode(windows)
        assert (lifted.flatten(0, 1).std(0) > 1e-3).sum() == kept
        error = (lifting.decode(lifted) - windows).square().mean() / windows.var()
        assert error < 0.2
        lifting.prepare(windows)
        assert lifting.kept.all()  # the next training chooses anew

    def test_a_folded_state_is_unfolded_before_training(self):
        place = torch.linspace(0, 1, 120)[:, None, None] + 0.004 * torch.arange(15)[:, None]  # [120, 15, 1]
        windows = (-0.5 * ((place - torch.linspace(0, 1, 24)) / 0.04) ** 2).exp()
        windows = windows + 0.02 * torch.randn(windows.shape, generator=torch.Generator().manual_seed(0))
        torch.manual_seed(0)
        lifting, told = CompactLifting(24, 1), []
        lifting.prepare(windows)

        def matches():
            lifted = lifting.small.encode(lifting.components(windows)).flatten()
            return torch.corrcoef(torch.stack([lifted, place.flatten()]))[0, 1].abs()

        assert matches() < 0.9
        lifting.pretrain(windows, 300, lambda done, wanted: told.append((done, wanted)))
        assert matches() > 0.99
        assert told[0] == (1, 600) and told[-1] == (600, 600)
        error = lifting.reconstruction_error(lifting.encode(windows), windows).mean()
        assert error < 0.3 * lifting.components(windows).square().mul(lifting.components.weights).mean()

    def test_what_is_learned_before_the_losses_depends_on_the_data_alone(self, monkeypatch):
        windows, told = embedded(turning(100).sin()), []
        lifting = CompactLifting(24, 2)
        lifting.prepare(windows)
        same = copy.deepcopy(lifting)
        for seed, each in enumerate((lifting, same)):
            torch.manual_seed(seed)
            monkeypatch.setattr("torchrl_koap.modules.koopman.compact_lifting.PRETRAINING_UPDATES", 3)
            each.pretrain(windows, 99, lambda *counts: told.append(counts))
        assert told[-1] == (6, 6) and all(weight.grad is None for weight in lifting.parameters())
        assert all(torch.equal(value, same.state_dict()[name]) for name, value in lifting.state_dict().items())

    def test_the_reconstruction_error_weights_components(self):
        windows = embedded(turning(bodies=2).sin())
        lifting = CompactLifting(24, 2)
        lifting.prepare(windows)
        lifted, weights = lifting.encode(windows), lifting.components.weights
        assert weights.max() > 2 * weights[weights > 0].min()
        target = windows @ lifting.components.analysis.mT
        errors = [
            (made - target).square() @ weights / len(weights)
            for made in (lifting.small.decode(lifted[..., :2]), lifting.large.decode(lifted[..., 2:]))
        ]
        torch.testing.assert_close(lifting.reconstruction_error(lifted, windows), sum(errors) / 2)
        # the first components initialise the linear part
        torch.testing.assert_close(lifting.small.encoder_skip.weight.abs(), torch.eye(2, 24), rtol=0, atol=0.05)
        torch.testing.assert_close(lifting.small.decoder_skip.weight.abs(), torch.eye(24, 2), rtol=0, atol=0.05)

    def test_coordinates_left_out_do_not_shrink_the_others(self):
        windows = embedded(turning(bodies=2).sin())
        lifting = CompactLifting(24, 2)
        lifting.prepare(windows)
        sizes = []
        for kept in ([1, 1, 0, 0, 0, 0], [0, 0, 1, 1, 1, 1]):
            lifting.kept.copy_(torch.tensor(kept))
            infer = LatentActionSmoothed(lifting, 0, num_past=8, look_ahead=range(2, 9))
            infer.finish(windows)
            motion = infer.infer(infer.gather(windows, range(8, 9)))[..., : infer.lifted.latent_dim]
            sizes.append(motion.square().sum(-1).mean())
        torch.testing.assert_close(torch.stack(sizes), torch.ones(2), rtol=0.05, atol=0)

    def test_other_columns_are_refused(self):
        with pytest.raises(ValueError, match="expected states with 24 columns"):
            CompactLifting(24, 2).encode(torch.randn(3, 25))

    def test_narrow_states_are_kept_as_they_are(self):
        for columns, kept in ((8, True), (9, False)):
            model = make_koopman_inverse_dynamics(columns, 2, preset="semi_supervised")
            assert model.lifting.keeps_state == kept


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def explained(coordinates, wanted):
    """Share of the variance of what is wanted that a linear map of the coordinates explains."""
    inputs = torch.cat([coordinates, torch.ones(len(coordinates), 1).to(coordinates)], 1)
    left = wanted - inputs @ torch.linalg.lstsq(inputs, wanted).solution
    return 1 - (left.var(0) / wanted.var(0)).max().item()


def test_coordinates_have_unit_spread_the_widest_first_and_what_is_not_there_is_zero():
    points = torch.cat([3 * uniform(400, 1), uniform(400, 1, seed=1), torch.zeros(400, 3)], 1)
    coordinates = isomap(points, 2)
    torch.testing.assert_close(coordinates.std(0, correction=0), torch.ones(2))
    assert explained(coordinates[:, :1], points[:, :1]) > 0.99
    line = isomap(torch.arange(5.0)[:, None], 8)
    assert line.shape == (5, 8) and explained(line[:, :1], torch.arange(5.0)[:, None]) > 0.999
    assert (line[:, 5:] == 0).all()


def test_parts_that_are_far_apart_are_joined():
    points = torch.cat([uniform(100, 2), 50 + uniform(100, 2, seed=1)])
    coordinates = isomap(points, 2)
    assert coordinates.isfinite().all()
    near, far = coordinates[:100, 0], coordinates[100:, 0]
    assert (near.max() < far.min()) or (far.max() < near.min())


def test_points_that_coincide_and_dtypes():
    points = uniform(50, 3).repeat(4, 1)
    for dtype in (torch.float32, torch.float64):
        coordinates = isomap(points.to(dtype), 2)
        assert coordinates.dtype == dtype and coordinates.isfinite().all()
    assert isomap(torch.ones(30, 3), 2).abs().max() < 1e-9  # all in one place
