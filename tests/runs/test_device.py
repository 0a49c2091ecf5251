# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests devices and precision: bfloat16 only with hardware units unless requested by name, and GPUs."""

import warnings
from itertools import cycle

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.modules.planning.noise_schedule import NUM_TRAIN_STEPS
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.device import default_threads, find_precision, has_bfloat16_units, set_up_torch, torch_as_before
from torchrl_koap.training.loop import SETTLED, train_phase


@pytest.fixture(params=["amx_bf16", "avx512_bf16", None])
def units(request, monkeypatch):
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: {"avx2": True} | {name: True for name in [request.param] if name}
    )
    return request.param


def test_auto_is_what_the_processor_has_units_for(units):
    assert has_bfloat16_units() == (units is not None)
    assert find_precision("auto") == ("float32" if units is None else "bfloat16")


def test_bfloat16_by_name_is_obeyed_and_warns_where_it_is_emulated(units):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert find_precision("bfloat16") == "bfloat16"
    assert len(caught) == (units is None)
    assert units is not None or "'auto'" in str(caught[0].message)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_said():
    with pytest.raises(ValueError, match="'cuda:1' was asked for, but torch finds no CUDA here"):
        set_up_torch(1, "cuda:1")


@pytest.mark.parametrize("told", [None, "1"])
def test_threads_are_those_of_the_environment(told, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if told:
        monkeypatch.setenv("OMP_NUM_THREADS", told)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    assert default_threads() == (7 if told else 1)


def test_no_number_of_threads_leaves_torch_alone():
    before = torch.get_num_threads()
    set_up_torch(None, "cpu")
    assert torch.get_num_threads() == before


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("replay", [False, True])
def test_training_on_a_gpu_equals_training_on_the_cpu(replay):
    def losses(device):
        torch.manual_seed(0)
        planner, logged = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=64), state_dim=2), []
        entries = {"state": torch.randn(8, 32, 16, 2).cumsum(2), "planner_noise": torch.randn(8, 32, 14, 2)}
        entries["planner_time"] = torch.randint(NUM_TRAIN_STEPS, (8, 32)).float()
        planner.fit_normalizers(entries["state"])
        loss, batches = PlannerLoss(planner.to(device)), cycle(TensorDict(entries, [8, 32]).to(device))
        train_phase(
            "planner",
            loss,
            lambda: next(batches),
            num_steps=SETTLED + 50,
            learning_rate=1e-3,
            target_update=SoftUpdate(loss, eps=0.9),
            replay=replay,
            log_every=1,
            progress=lambda done, values: logged.append(values["loss_planner"]),
        )
        return torch.tensor(logged), loss.target_network_params.flatten_keys().cpu()

    (expected, average), (found, found_average) = losses("cpu"), losses("cuda")
    assert expected[-1] < 0.9 * expected[0]
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5)
    for name, value in average.items():
        torch.testing.assert_close(found_average[name], value, rtol=1e-2, atol=1e-3)


def test_threads_and_random_numbers_are_given_back():
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    with pytest.raises(KeyboardInterrupt), torch_as_before():  # a cell that is stopped
        torch.set_num_threads(threads + 1)
        torch.manual_seed(torch.initial_seed() + 1)
        raise KeyboardInterrupt
    assert torch.get_num_threads() == threads and torch.equal(torch.get_rng_state(), state)
