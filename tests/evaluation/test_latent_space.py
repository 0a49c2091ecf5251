# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests spectrum, multi-step errors and linear probe on systems with known answers."""

import json
import math
import shutil

import pytest
import torch
from tiny_runs import TINY, koap
from torch import nn

from torchrl_koap.data import LabelBudget, flatten_trajectories, select_state
from torchrl_koap.evaluation import InspectConfig, inspect
from torchrl_koap.evaluation.findings import OUTSIDE_THE_BUDGET, describe_inspection
from torchrl_koap.evaluation.latent_space import (
    analyse_latent,
    infer_steps,
    prediction_errors,
    probe,
    split_trajectories,
)
from torchrl_koap.modules import (
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LinearActionDecoder,
    Normalizer,
    make_koopman_inverse_dynamics,
)
from torchrl_koap.modules.koopman.latent_action import LatentActionModule
from torchrl_koap.reports.inspection_plots import draw_latent
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.tasks import get_task


def turn(angle, size=1.0):
    cos, sin = math.cos(angle) * size, math.sin(angle) * size
    return torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)


# x_{t+1} = A x_t + w_t with w_{t+1} = R w_t: from x_t and x_{t+2} alone w_t is known
DRIFT, WIND = turn(0.3, 0.95), turn(1.1)


class KnowsTheWind(LatentActionModule):
    def infer(self, frames):
        now, later = frames.unbind(-2)
        return (later - now @ (DRIFT @ DRIFT).T) @ (DRIFT + WIND).inverse().T


def knowing(normalizer=None):
    lifting = KoopmanLifting(2, 2, include_state=True)  # z = x
    lifting.decoder = nn.Identity()
    operator = KoopmanOperator(2)
    operator.double().weight.data.copy_(DRIFT)
    decoder = LinearActionDecoder(2, 2).double()
    nn.init.eye_(decoder.linear.weight), nn.init.zeros_(decoder.linear.bias)
    infer = KnowsTheWind(2, 2, num_past=0, look_ahead=2)
    return KoopmanInverseDynamics(infer, decoder, lifting=lifting, operator=operator, state_normalizer=normalizer)


def blown(lengths=(12, 15, 11, 20), drifts=None):
    generator = torch.Generator().manual_seed(0)
    frames, winds = [], []
    for index, length in enumerate(lengths):
        x, w = torch.randn(2, 2, dtype=torch.float64, generator=generator)
        path, wind = [x], []
        for _ in range(length):
            wind.append(w)
            path.append((DRIFT if drifts is None else drifts[index]) @ path[-1] + w)
            w = WIND @ w
        frames.append(torch.stack(path)), winds.append(torch.stack(wind))
    return select_state(flatten_trajectories(frames, winds, dtype=torch.float64), (0, 1))


PARTS = {"whole": [0, 1], "second": [1]}


@pytest.mark.parametrize("normalizer", [None, Normalizer(2, scale=torch.full((2,), 3.0)).double()])
def test_an_exactly_linear_system_is_predicted_without_error(normalizer):
    data = blown()
    errors = prediction_errors(knowing(normalizer), data, torch.tensor([0, 1]), PARTS, horizon=4)
    for model in ("koopman", "linear", "reconstruction"):
        assert max(errors[model]["whole"]) < 1e-9, model
    paths = data["state"].split([12, 15, 11, 20])[2:]
    for step in range(1, 5):
        # every start whose last latent action still sees its look-ahead
        gaps = torch.cat([path[step : step + len(path) - 5] - path[: len(path) - 5] for path in paths])
        assert errors["copy_last"]["whole"][step - 1] == pytest.approx(gaps.square().sum(-1).mean().sqrt().item())
        assert errors["copy_last"]["second"][step - 1] == pytest.approx(gaps[:, 1].square().mean().sqrt().item())


def test_the_error_of_a_wrong_operator_is_its_deviation():
    data, controller = blown(), knowing()
    controller.operator.weight.data.add_(0.1 * torch.eye(2, dtype=torch.float64))
    errors = prediction_errors(controller, data, torch.tensor([0]), PARTS, horizon=1)
    starts = torch.cat([path[:-2] for path in data["state"].split([12, 15, 11, 20])[1:]])
    assert errors["koopman"]["whole"] == pytest.approx([0.1 * starts.square().sum(-1).mean().sqrt().item()])


def test_the_linear_model_learns_from_its_half_alone():
    data = blown(drifts=[DRIFT, DRIFT, turn(-0.8, 0.9), turn(-0.8, 0.9)])
    errors = prediction_errors(knowing(), data, torch.tensor([0, 1]), PARTS, horizon=2)
    assert min(errors["linear"]["whole"]) > 0.1


def test_a_horizon_out_of_range_is_an_error():
    with pytest.raises(ValueError, match="shorter than a window"):
        prediction_errors(knowing(), blown(), torch.tensor([0]), PARTS, horizon=11)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_every_preset_can_be_analysed(preset):
    torch.manual_seed(0)
    data = blown((12, 31, 32, 33))
    data = data.float().set("has_action", data["has_action"])
    controller = make_koopman_inverse_dynamics(2, 2, preset=preset, state_normalizer=Normalizer.fit(data["state"]))
    before, recorded = {name: value.clone() for name, value in controller.state_dict().items()}, data.clone()
    result = analyse_latent(controller.eval(), data, data["episode"] == 3, PARTS)
    shortest = 12 - (controller.num_window_frames - 1 - controller.num_past)  # steps that all see their look-ahead
    assert result["multi_step"]["steps"] == shortest == len(result["multi_step"]["koopman"]["whole"])
    assert len(result["eigenvalues"]["real"]) == controller.operator.latent_dim
    after = controller.state_dict()
    assert all(torch.equal(value.nan_to_num(9), before[name].nan_to_num(9)) for name, value in after.items())
    assert (data == recorded).all()


def test_steps_are_inferred_once_each_whatever_the_labels():
    data, controller = blown(), knowing()
    hidden, _ = LabelBudget(count=1, seed=2).apply(data)
    steps = infer_steps(controller, hidden)
    lengths = [12, 15, 11, 20]
    usable = torch.cat([torch.arange(length) < length - 2 for length in lengths])
    torch.testing.assert_close(steps["latent_action"], data["action"][usable])  # here u is the wind itself
    assert torch.equal(steps["episode"], data["episode"][usable])
    assert torch.equal(steps["has_action"], hidden["has_action"][usable, 0])
    assert steps["action"].isnan().any(-1).equal(~steps["has_action"])


def independent(seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(1200, 3, generator=generator), torch.arange(1200) // 30


def test_a_probe_finds_what_lies_linearly_in_the_latent_and_nothing_else():
    latent, groups = independent(0)
    noise, _ = independent(1)
    linear = latent @ torch.tensor([[1.0, 2.0], [0.0, -1.0], [3.0, 0.5]]) + 4
    found = probe(latent, torch.cat([linear, noise[:, :1]], -1), groups, groups < 20)
    assert found[:2] == pytest.approx([1, 1], abs=1e-5) and abs(found[2]) < 0.05
    # what holds in one half and is the other way round in the other explains -3: 1 - (2 a)^2 / a^2
    sign = torch.where(groups < 20, 1.0, -1.0)[:, None]
    assert probe(latent, sign * (linear - 4), groups, groups < 20) == pytest.approx([-3, -3], abs=0.02)


def test_the_budget_is_in_the_fitted_half():
    episode = torch.arange(11).repeat_interleave(3)
    half = split_trajectories(episode, (episode == 4) | (episode == 9))
    assert len(half) == 5 == len(half.unique()) and {4, 9} <= set(half.tolist())
    assert torch.equal(half, split_trajectories(episode, (episode == 4) | (episode == 9)))
    with pytest.raises(ValueError, match="at least two, got 1"):
        split_trajectories(torch.zeros(3), torch.zeros(3, dtype=torch.bool))


def test_the_decoder_of_the_run_is_judged_beside_the_probe():
    data, controller = blown((20, 20, 20, 20)), knowing()
    labelled = data["episode"] == 1
    result = analyse_latent(controller, data, labelled, PARTS)[OUTSIDE_THE_BUDGET]
    assert result["probe_r2"] == pytest.approx([1, 1], abs=1e-6) and result["decoder_r2"] == pytest.approx([1, 1])
    assert (result["labels_read"], result["held_out_trajectories"]) == (4 * 18, 2)
    assert result["held_out_in_budget"] == 0
    nn.init.zeros_(controller.action_decoder.linear.weight)
    worse = analyse_latent(controller, data, data["episode"] >= 0, PARTS)[OUTSIDE_THE_BUDGET]
    assert max(worse["decoder_r2"]) < 0.1 and worse["held_out_in_budget"] == 2


def test_diverged_predictions_are_drawn(tmp_path):
    controller = knowing()
    controller.operator.weight.data.mul_(1e200)
    data = blown((20, 20, 20, 20))
    result = analyse_latent(controller, data, data["episode"] == 0, {"measured_xy": [0, 1]})
    assert result["multi_step"]["steps"] == 10
    assert not math.isfinite(result["multi_step"]["koopman"]["measured_xy"][-1])
    figure = draw_latent({"latent": result}, RunFacts(tmp_path, get_task("avoiding")))
    koopman, _, linear, _ = figure.axes[1].lines
    assert not math.isfinite(koopman.get_ydata()[-1]) and math.isfinite(linear.get_ydata()[-1])


def test_findings_without_experiments_name_the_labels_that_were_read():
    controller, data = knowing(), blown((20, 20, 20, 20))
    latent = analyse_latent(controller, data, data["episode"] == 0, {"measured_xy": [0, 1]})
    text = describe_inspection({"latent": latent}, get_task("avoiding"))
    assert text.startswith("10 steps ahead the latent dynamics miss the measured xy by")
    assert "Outside the budget, for evaluation only" in text and "100.0%" in text
    assert "have labels in the budget" not in text
    hard = latent | {OUTSIDE_THE_BUDGET: {"probe_r2": [0.3, 0.7], "decoder_r2": [0.9, 0.5]}}
    text = describe_inspection({"latent": hard}, get_task("avoiding"))
    assert "explains 70.0% of the hardest action, 'y', on" in text and "own decoder 50.0%" in text
    latent = analyse_latent(controller, data, data["episode"] >= 1, {"measured_xy": [0, 1]})
    assert describe_inspection({"latent": latent}, get_task("avoiding")).endswith(
        "(1 of these 2 have labels in the budget)"
    )


def test_inspect_the_latent_space_alone(copied_run):
    (copied_run / "inspect.json").write_text(
        json.dumps({"controller_alone": {"rate": 0.5}, "findings": "old", "latent": "old"})
    )
    assert koap("inspect", copied_run, "--latent-only", "--threads", "1") == 0
    written = json.loads((copied_run / "inspect.json").read_text())
    assert written["controller_alone"] == {"rate": 0.5}  # an earlier experiment is kept
    latent = written["latent"]
    assert list(latent["multi_step"]["koopman"]) == ["measured_xy"] and latent["multi_step"]["steps"] == 10
    assert len(latent[OUTSIDE_THE_BUDGET]["probe_r2"]) == 2
    assert latent[OUTSIDE_THE_BUDGET]["held_out_in_budget"] == 0  # 2 of 8 are labelled
    assert "for evaluation only" in written["findings"]
    assert (copied_run / "plots" / "latent.png").exists()
    assert not (copied_run / "plots" / "inspect.png").exists()


def test_labels_of_a_data_set_that_was_moved_are_in_the_budget_still(copied_run, demonstrations, tmp_path):
    here = inspect(copied_run, InspectConfig(latent_only=True, threads=1))
    shutil.copytree(demonstrations, tmp_path / "moved")
    moved = InspectConfig(latent_only=True, threads=1, dataset=str(tmp_path / "moved"))
    assert inspect(copied_run, moved) == here
    next((tmp_path / "moved").glob("*.pkl")).unlink()
    with pytest.raises(RunDirectoryError, match="is not the one that .* was trained on"):
        inspect(copied_run, moved)


def test_a_method_without_latent_actions_gets_a_note(demonstrations, tmp_path):
    assert koap("train", "--out", tmp_path / "run", "--dataset", demonstrations, *TINY, "--method", "linear") == 0
    assert koap("inspect", tmp_path / "run", "--latent-only", "--threads", "1") == 0
    written = json.loads((tmp_path / "run" / "inspect.json").read_text())
    assert written["latent"] == {"note": "method 'linear' has no latent actions to analyse"}
    assert written["findings"] == written["latent"]["note"]
    assert not (tmp_path / "run" / "plots" / "latent.png").exists()
