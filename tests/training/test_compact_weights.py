# This source code is licensed under the MIT license found in the LICENSE file.
"""Bytes and scales instead of floats: what is stored, and how near it comes back."""

from __future__ import annotations

import torch

from torchrl_koap.training.compact_weights import compact, expand


def test_matrices_become_bytes_and_the_rest_stays():
    torch.manual_seed(0)
    tensors = {
        "a.weight": torch.randn(64, 128) * torch.logspace(-3, 3, 64)[:, None],
        "conv.weight": torch.randn(32, 16, 9),
        "plan_normalizer.scale": torch.rand(5000),
        "small.weight": torch.rand(8, 8),
        "steps": torch.arange(8192).reshape(2, -1),
    }
    small = compact(tensors)
    assert {name for name, tensor in small.items() if tensor.dtype == torch.int8} == {"a.weight", "conv.weight"}
    assert all(small[name] is tensors[name] for name in ("plan_normalizer.scale", "small.weight", "steps"))
    restored = expand(small)
    assert list(restored) == list(tensors)
    for name in ("a.weight", "conv.weight"):
        largest = tensors[name].flatten(1).abs().amax(1)
        worst = (restored[name] - tensors[name]).flatten(1).abs().amax(1)
        assert (worst <= 0.5001 * largest / 127).all() and restored[name].dtype == torch.float32


def test_rows_of_zeros_and_plain_state_dicts():
    assert (expand(compact({"w": torch.zeros(64, 64)}))["w"] == 0).all()
    plain = {"w": torch.randn(3, 3), "scale": torch.ones(3)}
    assert all(expand(plain)[name] is plain[name] for name in plain)
