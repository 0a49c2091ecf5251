# This source code is licensed under the MIT license found in the LICENSE file.
"""Lifting and operator: structures, spectra, bounds, input matrix, batches and types."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import KoopmanLifting, KoopmanOperator, LatentActionMLP
from torchrl_koap.modules.networks import SequenceLSTM

STRUCTURES = [("dense", 2), ("diagonal", 2), ("block_diagonal", 1), ("block_diagonal", 2), ("block_diagonal", 3)]


def make_operator(structure, block_dim, **options):
    torch.manual_seed(0)
    operator = KoopmanOperator(6, structure=structure, block_dim=block_dim, **options).double()
    torch.nn.init.normal_(operator.weight)
    return operator


# operator


@pytest.mark.parametrize("bound", [None, 0.9, 100.0])
@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_propagating_is_multiplying_by_the_matrix(structure, block_dim, bound):
    operator = make_operator(structure, block_dim, max_spectral_radius=bound)
    matrix = operator.matrix()
    assert matrix.shape == (6, 6)
    for shape in ((6,), (5, 6), (2, 3, 4, 6)):
        lifted = torch.randn(*shape, dtype=torch.float64)
        expected = torch.stack([matrix @ row for row in lifted.reshape(-1, 6)]).reshape(shape)
        torch.testing.assert_close(operator.propagate(lifted), expected)
    size = {"dense": 6, "diagonal": 1, "block_diagonal": block_dim}[structure]
    inside = torch.block_diag(*[torch.ones(size, size)] * (6 // size)).bool()
    assert (matrix[~inside] == 0).all() and (matrix[inside] != 0).all()
    if bound == 100.0:
        assert torch.equal(matrix[inside].sort()[0], operator.weight.flatten().sort()[0])


@pytest.mark.parametrize("bound", [None, 0.9])
@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_eigenvalues_are_those_of_the_matrix(structure, block_dim, bound):
    operator = make_operator(structure, block_dim, max_spectral_radius=bound)
    values, expected = operator.eigenvalues(), torch.linalg.eigvals(operator.matrix())
    assert values.dtype == torch.complex128 and values.shape == (6,) and not values.requires_grad
    assert (values.abs().diff() <= 1e-12).all()
    left = sorted(values.tolist(), key=lambda value: (round(value.real, 9), round(value.imag, 9)))
    right = sorted(expected.tolist(), key=lambda value: (round(value.real, 9), round(value.imag, 9)))
    assert left == pytest.approx(right)


@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_bound_holds_and_gradients_flow(structure, block_dim):
    operator = make_operator(structure, block_dim, max_spectral_radius=0.7)
    with torch.no_grad():
        operator.weight.mul_(10)
    assert operator.eigenvalues()[0].abs() <= 0.7 + 1e-9
    assert torch.linalg.matrix_norm(operator.matrix(), ord=2) <= 0.7 + 1e-9
    lifted = torch.randn(4, 6, dtype=torch.float64)
    grown = lifted
    for _ in range(200):
        grown = operator.propagate(grown)
    assert grown.norm() < 1e-20
    operator.propagate(lifted).square().sum().backward()
    gradient = operator.weight.grad
    assert gradient.isfinite().all()
    if structure != "diagonal" and block_dim > 1:  # one number scaled to its bound has no freedom left but its sign
        assert gradient.abs().max() > 1e-6


@pytest.mark.parametrize("scale", [0.5, 2.0])
@pytest.mark.parametrize(("structure", "block_dim"), [("dense", 2), ("block_diagonal", 3)])
def test_gradient_of_the_bound_is_right(structure, block_dim, scale):
    operator = make_operator(structure, block_dim, max_spectral_radius=1.0)
    with torch.no_grad():
        operator.weight.mul_(scale / 2)
    lifted = torch.randn(3, 6, dtype=torch.float64)

    def run(weight):
        return torch.func.functional_call(operator, {"weight": weight}, (TensorDict({"lifted_state": lifted}, [3]),))

    operator.forward = lambda td: operator.propagate(td["lifted_state"])
    assert torch.autograd.gradcheck(run, (operator.weight.detach().clone().requires_grad_(),))


def test_gradient_of_the_bound_is_finite_where_all_singular_values_are_equal():
    operator = KoopmanOperator(4, max_spectral_radius=0.9)
    with torch.no_grad():
        operator.weight.copy_(torch.eye(4))
    operator.propagate(torch.randn(3, 4)).sum().backward()
    assert operator.weight.grad.isfinite().all()
    torch.testing.assert_close(operator.matrix(), 0.9 * torch.eye(4))


@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_input_matrix(structure, block_dim):
    operator = make_operator(structure, block_dim, input_dim=3)
    lifted, latent = torch.randn(2, 5, 6).double(), torch.randn(2, 5, 3).double()
    torch.testing.assert_close(operator.step(lifted, latent), operator.propagate(lifted))  # B is zero at first
    torch.nn.init.normal_(operator.input)
    td = operator(TensorDict({"lifted_state": lifted, "latent_action": latent}, [2, 5]))
    for b in range(2):
        for t in range(5):
            expected = operator.matrix() @ lifted[b, t] + operator.input @ latent[b, t]
            torch.testing.assert_close(td["next", "lifted_state"][b, t], expected)
    operator.step(lifted, latent).square().sum().backward()
    assert operator.input.grad.abs().min() > 0


@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_without_an_input_matrix_latent_actions_are_added(structure, block_dim):
    operator = make_operator(structure, block_dim, in_keys=("z", ("a", "u")), out_key="following")
    lifted, latent = torch.randn(2, 6).double(), torch.randn(2, 6).double()
    td = operator(TensorDict({"z": lifted, "a": {"u": latent}}, [2]))
    torch.testing.assert_close(td["following"], lifted @ operator.matrix().T + latent)
    assert operator.input_dim == 6 and operator.input is None
    assert operator.in_keys == ["z", ("a", "u")] and operator.out_keys == ["following"]


@pytest.mark.parametrize(("structure", "block_dim"), STRUCTURES)
def test_initial_operators(structure, block_dim):
    torch.manual_seed(0)
    operator = KoopmanOperator(6, structure=structure, block_dim=block_dim)
    assert (operator.matrix() - torch.eye(6)).abs().max() < 0.01
    before = operator.weight.detach().clone()
    operator.reset_parameters()
    assert not torch.equal(before, operator.weight) and (operator.matrix() - torch.eye(6)).abs().max() < 0.01
    normal = KoopmanOperator(300, structure="diagonal", init="normal").weight.detach()
    assert abs(float(normal.mean())) < 0.2 and abs(float(normal.std()) - 1) < 0.15


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"structure": "diagnal"}, "unknown operator structure 'diagnal'; did you mean 'diagonal'"),
        ({"structure": None}, "unknown operator structure None; known: dense, diagonal, block_diagonal"),
        ({"init": "zeros"}, "unknown operator init 'zeros'"),
        ({"structure": "block_diagonal", "block_dim": 4}, "latent_dim 6 is not a multiple of block_dim 4"),
        ({"structure": "block_diagonal", "block_dim": 0}, "block_dim must be at least 1, got 0"),
        ({"max_spectral_radius": 0.0}, "max_spectral_radius must be positive, got 0.0"),
        ({"max_spectral_radius": float("nan")}, "max_spectral_radius must be positive, got nan"),
    ],
)
def test_bad_operators_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        KoopmanOperator(6, **options)


@pytest.mark.parametrize(("structure", "block_dim"), [("dense", 2), ("block_diagonal", 2)])
def test_a_bounded_operator_compiles(structure, block_dim):
    torch._dynamo.reset()
    operator = make_operator(structure, block_dim, max_spectral_radius=0.9, input_dim=3)
    lifted, latent = torch.randn(2, 6).double(), torch.randn(2, 3).double()
    compiled = torch.compile(operator.step, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(lifted, latent), operator.step(lifted, latent))


# lifting


@pytest.mark.parametrize("options", [{}, {"include_state": True}, {"recurrent": True}])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lifting_takes_any_batch(options, dtype):
    torch.manual_seed(0)
    lifting = KoopmanLifting(3, 5, hidden_dims=(8,), **options).to(dtype)
    state = torch.randn(2, 3, 7, 3, dtype=dtype)
    lifted = lifting.encode(state)
    assert lifted.shape == (2, 3, 7, 5) and lifted.dtype == dtype
    torch.testing.assert_close(lifting.encode(state[1, 2]), lifted[1, 2])
    back = lifting.decode(lifted)
    assert back.shape == state.shape
    torch.testing.assert_close(lifting.decode(lifted[1, 2]), back[1, 2])
    assert lifting.encode(state[:0]).shape == (0, 3, 7, 5)


def test_states_are_the_first_observables():
    state = torch.randn(4, 6, 3)
    lifting = KoopmanLifting(3, 5, include_state=True)
    lifted = lifting.encode(state)
    assert torch.equal(lifted[..., :3], state)
    torch.testing.assert_close(lifted[..., 3:], lifting.encoder(state))
    assert torch.equal(KoopmanLifting(3, 3, include_state=True).encode(state), state)


def test_what_a_lifted_state_depends_on():
    """The paper's g is a function of one state; the released one of the whole prefix and nothing later."""
    state = torch.randn(6, 3, requires_grad=True)
    for recurrent in (False, True):
        lifted = KoopmanLifting(3, 5, recurrent=recurrent).encode(state)
        for t in range(6):
            (gradient,) = torch.autograd.grad(lifted[t].sum(), state, retain_graph=True)
            read = [frame for frame in range(6) if gradient[frame].abs().max() > 0]
            assert read == (list(range(t + 1)) if recurrent else [t])


def test_the_recurrent_network_is_torch_lstm():
    network = SequenceLSTM(3, 4, 2)
    reference = torch.nn.LSTM(3, 4, batch_first=True)
    reference.load_state_dict(network.lstm.state_dict())
    sequence = torch.randn(5, 7, 3)
    torch.testing.assert_close(network(sequence), network.readout(reference(sequence)[0]))


def test_perceptron_without_hidden_layers_is_linear_and_dropout_belongs_to_every_hidden_layer():
    assert [type(layer).__name__ for layer in LatentActionMLP(2, 3, hidden_dims=()).network] == ["Linear"]
    network = LatentActionMLP(2, 3, hidden_dims=(4, 4), dropout=0.1).network
    assert [type(layer).__name__ for layer in network] == ["Linear", "Dropout", "ReLU"] * 2 + ["Linear"]


def test_keys_of_the_lifting():
    lifting = KoopmanLifting(3, 5, in_key=("agent", "x"), out_key=("agent", "z"))
    td = lifting(TensorDict({"agent": {"x": torch.randn(2, 6, 3)}}, [2]))
    assert td["agent", "z"].shape == (2, 6, 5)
    assert lifting.in_keys == [("agent", "x")] and lifting.out_keys == [("agent", "z")]


def test_bad_liftings_are_refused():
    with pytest.raises(ValueError, match="include_state needs latent_dim >= state_dim, got 2 < 3"):
        KoopmanLifting(3, 2, include_state=True)
    with pytest.raises(ValueError, match="include_state needs a lifting of single states"):
        KoopmanLifting(3, 5, include_state=True, recurrent=True)
    with pytest.raises(ValueError, match=r"expected states with 3 columns, got shape \[6, 2\]"):
        KoopmanLifting(3, 5).encode(torch.randn(6, 2))
