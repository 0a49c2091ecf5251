# This source code is licensed under the MIT license found in the LICENSE file.
"""Base class of tests for planner and Diffusion Policy: keys, noise, statistics, shapes, batches."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


def walks(number: int, length: int = 16, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Returns windows of random walks with two columns, ``[number, length, 2]``."""
    generator = torch.Generator().manual_seed(3)
    return (0.01 * torch.randn(number, length, 2, generator=generator, dtype=dtype)).cumsum(1)


class SamplerTestBase:
    """Tests of a sampler; a subclass makes and fits it and sets its output entry and width."""

    out_key, width = "", 0

    def make(self, **options):
        """Returns a small sampler, always with the same weights."""
        raise NotImplementedError

    def make_unet(self, **options):
        """Returns a sampler with a U-Net, for any horizon."""
        raise NotImplementedError

    def fit(self, sampler, dtype=torch.float32):
        """Fits the sampler's statistics to windows of its horizon; returns it."""
        raise NotImplementedError

    def test_encoding_is_undone_by_decoding(self):
        sampler = self.fit(self.make())
        history, sequence = walks(5)[:, :2], torch.randn(5, 14, self.width)
        again = sampler.decode(history, sampler.encode(history, sequence))
        torch.testing.assert_close(again, sequence, atol=1e-5, rtol=1e-5)

    @pytest.mark.parametrize("device", DEVICES)
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
    def test_any_batch_dtype_and_device(self, batch, dtype, device):
        sampler = self.fit(self.make_unet(num_steps=3, horizon=6), dtype=torch.float64)
        sampler.to(device=device, dtype=dtype)
        history = torch.randn(*batch, 2, 2, dtype=dtype, device=device)
        noise = torch.randn(*batch, *sampler.noise_shape, dtype=dtype, device=device)
        sequence = sampler(TensorDict({"history": history, "noise": noise}, batch))[self.out_key]
        assert sequence.shape == (*batch, 6, self.width) and sequence.dtype == dtype and sequence.isfinite().all()
        flat = sampler.sample(history.reshape(-1, 2, 2), noise.reshape(-1, 6, self.width))
        torch.testing.assert_close(sequence.reshape(-1, 6, self.width), flat)

    def test_states_of_another_type_are_refused(self):
        with pytest.raises(ValueError, match=r"'history' is torch.float64, .* torch.float32: cast one of them"):
            self.make().sample(torch.zeros(3, 2, 2, dtype=torch.float64))  # like states of MuJoCo in Gymnasium

    @pytest.mark.parametrize("exploration", ExplorationType)
    def test_samples_differ_if_no_noise_is_given(self, exploration):
        sampler, history = self.make(), torch.randn(3, 2, 2)
        with set_exploration_type(exploration):
            assert not torch.equal(sampler.sample(history), sampler.sample(history))

    def test_an_ensemble_under_vmap_samples_as_its_members(self):
        first, _ = members = [self.fit(self.make(num_steps=3)), self.make(num_steps=3)]
        history, noise = walks(3)[:, :2], torch.randn(3, *first.noise_shape)

        def sample(weights):
            with weights.to_module(first):
                return first.sample(history, noise)

        samples = torch.vmap(sample)(TensorDict.from_modules(*members))
        torch.testing.assert_close(samples, torch.stack([member.sample(history, noise) for member in members]))

    def test_a_prefix_is_kept_and_the_rest_fits_it(self):
        sampler = self.fit(self.make())
        history, prefix, noise = walks(3)[:, :2], 0.01 * torch.randn(3, 4, self.width), torch.randn(3, 14, self.width)
        with torch.no_grad():
            free, bound = sampler.sample(history, noise), sampler.sample(history, noise, prefix=prefix)
        torch.testing.assert_close(bound[:, :4], prefix, atol=1e-5, rtol=1e-5)
        assert not torch.allclose(free[:, 4:], bound[:, 4:])
        for length in (0, 14):
            with pytest.raises(ValueError, match=rf"a prefix must be \[\*B, 1..13, {self.width}\]"):
                sampler.sample(history, noise, prefix=torch.zeros(3, length, self.width))

    def test_keys_can_be_chosen_and_the_call_dispatched(self):
        sampler = self.make(in_key=("a", "past"), out_key=("a", "next"), noise_key=("a", "luck"), num_steps=3)
        history, noise = torch.randn(3, 2, 2), torch.randn(3, 14, self.width)
        data = sampler(TensorDict({"a": {"past": history, "luck": noise}}, [3]))
        torch.testing.assert_close(data["a", "next"], sampler.sample(history, noise))
        assert self.make(num_steps=3)(history=history).shape == (3, 14, self.width)

    def test_state_dict_holds_the_statistics(self):
        sampler, fresh = self.fit(self.make(num_steps=3)), self.make(num_steps=3)
        with torch.device("meta"):  # networks without storage
            bare = self.make_unet(num_steps=3), self.make(num_steps=3)
        history, noise = walks(5)[:, :2], torch.randn(5, 14, self.width)
        assert not torch.allclose(fresh.sample(history, noise), sampler.sample(history, noise))
        bare[0].load_state_dict(self.fit(self.make_unet(num_steps=3)).state_dict(), assign=True)
        assert bare[0].sample(history, noise).isfinite().all()
        for other in (fresh, bare[1]):
            other.load_state_dict(sampler.state_dict(), assign=other is bare[1])
            torch.testing.assert_close(other.sample(history, noise), sampler.sample(history, noise))
        torch.testing.assert_close(copy.deepcopy(sampler).sample(history, noise), sampler.sample(history, noise))

    def test_solvers_sizes_and_shapes_are_checked(self):
        assert self.make(horizon=5).noise_shape == (5, self.width)
        with pytest.raises(ValueError, match="did you mean 'ddim'"):
            self.make(solver="dim")
        with pytest.raises(ValueError, match="num_steps must lie in 1..50"):
            self.make(num_steps=60)
        with pytest.raises(ValueError, match="horizon must be at least 1"):
            self.make(horizon=0)
        sampler = self.make(num_steps=3)
        with pytest.raises(KeyError, match=rf"{type(sampler).__name__} reads 'history'; there are \['past'\]"):
            sampler(TensorDict({"past": torch.zeros(5, 2, 2)}, [5]))
        for length in (1, 3):
            with pytest.raises(ValueError, match=rf"'history' must be \[\*B, 2, 2\].* got \[5, {length}, 2\]"):
                sampler(TensorDict({"history": torch.zeros(5, length, 2)}, [5]))
        with pytest.raises(ValueError, match=rf"'noise' must be \[5, 14, {self.width}\].* got \[5, 12, {self.width}\]"):
            sampler.sample(torch.zeros(5, 2, 2), torch.zeros(5, 12, self.width))
        with pytest.raises(ValueError, match=rf"'{self.out_key}' must be \[\*B, 14, {self.width}\].* got \[5, 12"):
            sampler.encode(torch.zeros(5, 2, 2), torch.zeros(5, 12, self.width))
        with pytest.raises(ValueError, match=r"windows must be \[\*B, 16, 2\] \(history \+ horizon, state_dim\), got"):
            sampler.split_window(torch.zeros(4, 15, 2))
