# This source code is licensed under the MIT license found in the LICENSE file.
"""The operator: one step, eigenvalues, the input matrix, keys."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import KoopmanOperator


def make_operator(**options):
    torch.manual_seed(0)
    operator = KoopmanOperator(6, **options).double()
    torch.nn.init.normal_(operator.weight)
    return operator


def test_eigenvalues_are_those_of_the_matrix_largest_first():
    operator = make_operator()
    values, expected = operator.eigenvalues(), torch.linalg.eigvals(operator.weight)
    assert values.dtype == torch.complex128 and values.shape == (6,) and not values.requires_grad
    assert (values.abs().diff() <= 1e-12).all()
    left = sorted(values.tolist(), key=lambda value: (round(value.real, 9), round(value.imag, 9)))
    right = sorted(expected.tolist(), key=lambda value: (round(value.real, 9), round(value.imag, 9)))
    assert left == pytest.approx(right)


@pytest.mark.parametrize("input_dim", [None, 3])
def test_one_step_is_the_matrices_times_the_vectors(input_dim):
    operator = make_operator(input_dim=input_dim, in_keys=("z", ("a", "u")), out_key="following")
    lifted, latent = torch.randn(2, 5, 6).double(), torch.randn(2, 5, input_dim or 6).double()
    if input_dim:
        torch.testing.assert_close(operator.step(lifted, latent), lifted @ operator.weight.T)  # B is zero at first
        torch.nn.init.normal_(operator.input)
    b = torch.eye(6).double() if operator.input is None else operator.input
    td = operator(TensorDict({"z": lifted, "a": {"u": latent}}, [2, 5]))
    for window in range(2):
        for t in range(5):
            expected = operator.weight @ lifted[window, t] + b @ latent[window, t]
            torch.testing.assert_close(td["following"][window, t], expected)
    td["following"].square().sum().backward()
    assert all(parameter.grad.abs().min() > 0 for parameter in operator.parameters())
    assert operator.input_dim == (input_dim or 6) and operator.out_keys == ["following"]


def test_it_starts_near_the_identity():
    operator = KoopmanOperator(6)
    before = operator.weight.detach().clone()
    operator.reset_parameters()
    assert not torch.equal(before, operator.weight) and (operator.weight - torch.eye(6)).abs().max() < 0.01
