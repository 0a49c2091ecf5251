# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests lifting and operator: states as observables, and linear maps by principal components."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import KoopmanLifting, KoopmanOperator


def test_states_are_the_first_observables():
    state = torch.randn(4, 6, 3)
    lifting = KoopmanLifting(3, 5, include_state=True)
    lifted = lifting.encode(state)
    assert torch.equal(lifted[..., :3], state)
    torch.testing.assert_close(lifted[..., 3:], lifting.encoder(state))
    same = KoopmanLifting(3, 3, include_state=True)
    assert torch.equal(same.encode(state), state) and same.keeps_state and not lifting.keeps_state


def test_bad_liftings_are_refused():
    with pytest.raises(ValueError, match="include_state needs latent_dim >= state_dim, got 2 < 3"):
        KoopmanLifting(3, 2, include_state=True)
    with pytest.raises(ValueError, match="linear_skip is for a learned lifting"):
        KoopmanLifting(3, 5, include_state=True, linear_skip=True)
    with pytest.raises(ValueError, match=r"expected states with 3 columns, got shape \[6, 2\]"):
        KoopmanLifting(3, 5).encode(torch.randn(6, 2))


def test_a_decoded_state_of_fewer_columns_is_not_broadcast():
    class OneColumn(KoopmanLifting):
        def decode(self, lifted):
            return super().decode(lifted)[..., :1]

    lifting, state = OneColumn(3, 8), torch.randn(2, 5, 3)
    with pytest.raises(ValueError, match=r"decode must return \[2, 5, 3\] .*, got \[2, 5, 1\]"):
        lifting.reconstruction_error(lifting.encode(state), state)


def test_linear_maps_are_the_principal_components_at_unit_spread():
    generator = torch.Generator().manual_seed(0)
    states = (3 + torch.randn(50, 16, 2, generator=generator)) @ torch.randn(2, 6, generator=generator)
    lifting = KoopmanLifting(6, 2, hidden_dims=(8,), linear_skip=True)
    lifting.prepare(states)
    made = states @ lifting.encoder_skip.weight.mT
    torch.testing.assert_close(made.flatten(0, 1).T.cov(), torch.eye(2), rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(made @ lifting.decoder_skip.weight.mT, states, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(lifting.encode(states), lifting.encoder(states) + made)


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
