# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests latent-action networks: frames read, scaling, and the kernel of the Fourier features."""

import math

import pytest
import torch

from torchrl_koap.modules import FourierKernel, LatentActionFourier, LatentActionLSTM, LatentActionMLP


def windows(*batch, dtype=torch.float32, num_frames=16, d=2):
    generator = torch.Generator().manual_seed(2)
    return torch.randn(*batch, num_frames, d, generator=generator, dtype=torch.float64).cumsum(-2).to(dtype)


@pytest.mark.parametrize("kind", [LatentActionLSTM, LatentActionMLP])
def test_every_frame_that_is_read_counts(kind):
    torch.manual_seed(0)
    network = kind(2, 4, num_past=1, look_ahead=(4, 8))
    read = network.gather(windows(3)).requires_grad_()
    network.infer(read).square().sum().backward()
    assert read.shape == (3, 16, 4, 2) and (read.grad.abs().sum(-1) > 0).all()


# Fourier observables


def fourier_parts(num_features, curvature=0.3, motion_scale=0.7, position_scale=2.0, seed=0):
    torch.manual_seed(seed)
    network = LatentActionFourier(
        2,
        num_features,
        num_past=1,
        look_ahead=(2, 4),
        kernels={"": FourierKernel(curvature, motion_scale, position_scale)},
    ).double()
    frames = network.gather(windows(10, dtype=torch.float64), network.reader.valid_frames(16)).flatten(0, 1)
    motion = frames[:, [0, 2, 3]].flatten(1)  # D = 6 relative entries
    place = torch.cat([motion / (motion_scale * math.sqrt(6)), frames[:, 1] / position_scale], 1)
    kernel = motion @ motion.T / 6 + curvature * torch.exp(-torch.cdist(place, place).square() / 2)
    latent = network.infer(frames)
    assert latent.shape[-1] == num_features + 6 == network.latent_dim
    return (latent @ latent.T - kernel).detach(), curvature


def test_inner_products_approach_the_kernel_as_the_features_grow():
    errors = {}
    for number in (64, 1024, 16384):
        draws = [fourier_parts(number, seed=seed)[0].square().mean() for seed in range(4)]
        errors[number] = torch.stack(draws).mean().sqrt().item()
    assert errors[16384] < 0.02 * 0.3
    for number in (64, 1024):  # 16 times the features, a quarter of the error
        assert 2.5 < errors[number] / errors[16 * number] < 6.5, errors


def test_a_chosen_kernel_is_that_of_a_network_with_no_other():
    kernels = {"sharp": FourierKernel(10.0, 1.0, 1.0), "smooth": FourierKernel(0.3, 3.0, 4.0)}
    read = windows(3)[:, None]
    networks = []
    for some in (kernels, *({name: kernel} for name, kernel in kernels.items())):
        torch.manual_seed(0)
        networks.append(LatentActionFourier(2, 64, num_past=1, look_ahead=range(2, 16), kernels=some))
    both, *alone = networks
    found = {}
    for name, network in zip(kernels, alone, strict=True):
        both.choose(name)
        found[name] = both.infer(read)
        assert torch.equal(found[name], network.infer(read)), name
    assert not torch.allclose(found["sharp"], found["smooth"])
    loaded = LatentActionFourier(2, 64, num_past=1, look_ahead=range(2, 16), kernels=kernels)
    loaded.load_state_dict(both.state_dict())
    assert torch.equal(loaded.infer(read), found["smooth"])  # the weights tell which kernel was chosen
    assert "kernel" not in alone[0].state_dict()
    assert LatentActionFourier(2, 0, kernels=kernels).blocks == ("",)  # without features kernels do not differ
    with pytest.raises(ValueError, match="kernels: at least one"):
        LatentActionFourier(2, 64, kernels={})


def test_steps_tells_where_a_latent_action_holds_the_steps_of_an_axis():
    network = LatentActionFourier(3, 8, num_past=2, look_ahead=(2, 5))
    state = torch.randn(40, 16, 3, generator=torch.Generator().manual_seed(0)).cumsum(1)
    network.prepare(state)
    latent = network.infer(network.gather(state, range(4, 5)))[:, 0]
    entries, factors = network.axis_features((2, 0))
    expected = torch.stack([state[:, b] - state[:, a] for a, b in ((2, 3), (3, 4), (4, 6), (6, 9))], 1)[..., [2, 0]]
    torch.testing.assert_close(latent[:, entries] * factors, expected)


def test_the_place_is_a_further_linear_part_and_changes_nothing_else():
    torch.manual_seed(0)
    plain = LatentActionFourier(3, 8, num_past=1, look_ahead=(2, 3))
    torch.manual_seed(0)
    placed = LatentActionFourier(3, 8, num_past=1, look_ahead=(2, 3), position_weight=2.0)
    frames = torch.randn(5, 4, 3)
    with_place = placed.infer(frames)
    assert placed.latent_dim == plain.latent_dim + 3 == with_place.shape[-1]
    torch.testing.assert_close(with_place[..., :-3], plain.infer(frames))
    torch.testing.assert_close(with_place[..., -3:], 2 / 3**0.5 * frames[..., 1, :])
