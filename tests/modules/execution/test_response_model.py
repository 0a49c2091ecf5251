# This source code is licensed under the MIT license found in the LICENSE file.
"""The response to commands: what it predicts, and that a fit finds the system that made the data."""

import pytest
import torch

from torchrl_koap.modules import ResponseModel

AXES = 2


def a_system() -> ResponseModel:
    """A stable, coupled system of two axes."""
    system = ResponseModel([0, 1], [0, 1], [0, 1])
    system.weight[[0, 1], [0, 1], 0] = torch.tensor([0.7, 0.5])  # momentum
    system.weight[[0, 1], [0, 1], 2] = torch.tensor([0.1, 0.2])  # pull of the command
    system.weight[[0, 1], [0, 1], 1] = torch.tensor([-0.2, 0.1])  # else its coordinates depend on each other
    system.weight[[0, 1], [0, 1], 3] = torch.tensor([0.2, 0.3])
    system.weight[[0, 1], [0, 1], 4] = torch.tensor([-0.1, 0.1])
    system.weight[1, 0, 3] = -0.1  # the second axis is moved by the first command
    return system.double()


def rollout(system: ResponseModel, changes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions ``[T, J]`` and commands ``[T, J]`` (the last one at each of them) from rest at 0."""
    nothing = torch.zeros(3, AXES, dtype=torch.float64)
    moved = system.predict(nothing, nothing[0], nothing[1:], changes)
    positions = torch.cat([nothing[:1], moved[:-1]])
    return positions, torch.cat([nothing[:1], changes[:-1].cumsum(0)])


def steps_of(system: ResponseModel, count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    changes = 0.01 * torch.randn(count, AXES, dtype=torch.float64)
    x, c = rollout(system, changes)
    t = torch.arange(2, count - 1)
    history = torch.stack([x[t - 2], x[t - 1], x[t]], 1)
    past = torch.stack([changes[t - 2], changes[t - 1]], 1)
    return system.coordinates(history, c[t] - x[t], past), x[t + 1] - x[t]


def test_a_fit_finds_the_system():
    system = a_system()
    fitted = ResponseModel([0, 1], [0, 1], [0, 1]).double().fit_ridge(*steps_of(system), penalty=1e-12)
    torch.testing.assert_close(fitted.weight, system.weight, atol=1e-5, rtol=0)


def test_uncoupled_axes_know_nothing_of_each_other():
    fitted = (
        ResponseModel([0, 1], [0, 1], [0, 1]).double().fit_ridge(*steps_of(a_system()), penalty=1e-12, coupled=False)
    )
    assert not fitted.weight[0, 1].any() and not fitted.weight[1, 0].any()
    torch.testing.assert_close(fitted.weight[0, 0], a_system().weight[0, 0], atol=1e-2, rtol=0)


def test_impulses_add_up_to_the_prediction():
    system, steps = a_system(), 6
    changes = torch.randn(steps, AXES, dtype=torch.float64)
    nothing = torch.zeros(3, AXES, dtype=torch.float64)
    wanted = system.predict(nothing, nothing[0], nothing[1:], changes)
    matrix = system.impulse_matrix(steps)
    assert matrix.shape == (steps, AXES, steps - 1, AXES)
    torch.testing.assert_close(torch.einsum("njka,ka->nj", matrix, changes[:-1]), wanted)
    assert not matrix[0].any()  # what is commanded now is not in the next measurement


def test_bad_columns_and_shapes_are_refused():
    with pytest.raises(ValueError, match="'commands': 1"):
        ResponseModel([0, 1], [0], [0, 1])
    with pytest.raises(ValueError, match=r"wanted coordinates \[n, 1, 5\]"):
        ResponseModel([0], [0], [0]).fit_ridge(torch.zeros(0, 1, 5), torch.zeros(0, 1))
