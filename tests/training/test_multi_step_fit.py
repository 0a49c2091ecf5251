# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting a response to predictions over many steps: what single steps get wrong is put right, nothing else is."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import ResponseModel
from torchrl_koap.training import multi_step_fit
from torchrl_koap.training.multi_step_fit import Stretches, fit_predictions, prediction_errors
from torchrl_koap.training.response import fit_response


def a_response() -> ResponseModel:
    return ResponseModel([0, 1], [0, 1], [0, 1]).double()


def a_system() -> ResponseModel:
    system = a_response()
    system.weight[[0, 1], [0, 1], 0] = torch.tensor([0.7, 0.5], dtype=torch.float64)
    system.weight[[0, 1], [0, 1], 2] = torch.tensor([0.1, 0.2], dtype=torch.float64)
    system.weight[[0, 1], [0, 1], 3] = torch.tensor([0.2, 0.3], dtype=torch.float64)
    return system


def stretches(count: int = 40, steps: int = 12, *, offset: float = 0.0, known: bool = True) -> Stretches:
    """Answers of the system to random commands; the commands that are told are off by a constant per stretch."""
    torch.manual_seed(0)
    position = torch.randn(count, 3, 2, dtype=torch.float64).cumsum(1) * 0.01
    command = position[:, -1] + 0.02 * torch.randn(count, 2, dtype=torch.float64)
    changes, future = 0.01 * torch.randn(count, 2, 2, dtype=torch.float64), torch.randn(count, steps, 2).double() * 0.01
    measured = a_system().predict(position, command, changes, future)
    told = command + offset * torch.randn(count, 2, dtype=torch.float64)
    return Stretches(position, told, changes, future, measured, torch.full((count,), known))


def test_the_system_itself_makes_no_error():
    assert prediction_errors(a_system(), stretches()).abs().max() < 1e-12


def test_a_constant_is_forgiven_where_the_command_is_unknown_and_nowhere_else():
    unknown, known = stretches(offset=0.1, known=False), stretches(offset=0.1)
    assert prediction_errors(a_system(), unknown).abs().max() < 1e-12
    assert prediction_errors(a_system(), known).abs().max() > 1e-2
    mixed = unknown._replace(known=torch.arange(40) % 2 == 0)
    error = prediction_errors(a_system(), mixed).abs().amax((1, 2))
    assert error[1::2].max() < 1e-12 and error[::2].min() > 1e-4


@pytest.mark.parametrize("known", [True, False])
def test_coefficients_that_are_off_are_found_from_predictions(known):
    response, data = a_response(), stretches(offset=0.0 if known else 0.1, known=known)
    response.weight.copy_(a_system().weight * 0.8)
    before = prediction_errors(response, data).square().mean()
    fit_predictions(response, data, coupled=True)
    assert prediction_errors(response, data).square().mean() < 0.01 * before


def test_axes_that_are_not_coupled_stay_so():
    response = a_response()
    response.weight.copy_(a_system().weight * 0.8)
    fit_predictions(response, stretches(), coupled=False)
    assert response.weight[0, 1].abs().max() == 0 and response.weight[1, 0].abs().max() == 0
    assert not torch.equal(response.weight, a_system().weight * 0.8)


def test_without_a_stretch_nothing_changes():
    response = a_response()
    response.weight.copy_(a_system().weight)
    fit_predictions(response, stretches().take(torch.zeros(0, dtype=torch.long)), coupled=True)
    assert torch.equal(response.weight, a_system().weight)


def test_of_many_stretches_some_are_taken(monkeypatch):
    seen, errors = [], prediction_errors

    def counted(response, data, weight):
        seen.append(len(data.known))
        return errors(response, data, weight)

    monkeypatch.setattr(multi_step_fit, "MOST", 7)
    monkeypatch.setattr(multi_step_fit, "prediction_errors", counted)
    fit_predictions(a_response(), stretches(), coupled=True)
    assert set(seen) == {7}


def test_a_model_that_single_steps_get_wrong_is_put_right(monkeypatch):
    """A sensor that errs by a little makes a regression of single steps forget momentum; predictions do not."""
    torch.manual_seed(0)
    parts = []
    for episode in range(8):
        action = (0.01 * torch.randn(60, 2, dtype=torch.float64)).cumsum(0) * 0.3
        start = torch.randn(2, dtype=torch.float64)
        moved = a_system().predict(start.expand(3, 2), start, torch.zeros(2, 2, dtype=torch.float64), action)
        position = torch.cat([start.unsqueeze(0), moved[:-1]])
        seen = position + 0.003 * torch.randn(60, 2, dtype=torch.float64)
        command = torch.cat([start.unsqueeze(0), start + action[:-1].cumsum(0)])
        entries = {"state": seen, "observation": torch.cat([command, seen], -1), "action": action}
        labels = {"has_action": torch.ones(60, 1, dtype=torch.bool), "episode": torch.full((60,), episode)}
        parts.append(TensorDict(entries | labels, 60))
    data, answers = torch.cat(parts), []
    for many in (True, False):
        response = a_response()
        if not many:
            monkeypatch.setattr("torchrl_koap.training.response.fit_predictions", lambda *_, **__: None)
        found = fit_response(response, data)
        assert math.isfinite(found["held_out_error"])
        answers.append((response.impulse_matrix(12) - a_system().impulse_matrix(12)).square().mean().sqrt())
    assert answers[0] < 0.5 * answers[1]
