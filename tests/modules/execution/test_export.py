# This source code is licensed under the MIT license found in the LICENSE file.
"""Exported policies give the numbers of the policy."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from torchrl_koap.modules import (
    DiffusionPolicy,
    Execution,
    StatePlanner,
    TemporalUnet,
    make_koopman_inverse_dynamics,
    make_policy,
)
from torchrl_koap.modules.execution.export import SUFFIXES, ExportError, export_part, exportable


def policy(**execution):
    torch.manual_seed(0)
    planner = StatePlanner(TemporalUnet(2, 4, channels=(8, 16)), state_dim=2, num_steps=2)
    controller = make_koopman_inverse_dynamics(2, 3)
    columns = {"commands": [0, 1], "states": [0, 1]}
    return make_policy(
        planner,
        controller,
        state_of=(2, 3),
        changes=(0, 1),
        commanded=columns,
        execution=Execution(**execution),
    )


def chunks():
    torch.manual_seed(0)
    diffusion = DiffusionPolicy(TemporalUnet(3, 4, channels=(8, 16)), state_dim=2, action_dim=3, num_steps=2)
    return make_policy(diffusion, state_of=(2, 3))


def test_the_stateless_policy_is_the_open_loop_one():
    whole = policy()
    what = exportable(whole, observation_dim=4)
    with torch.no_grad():
        actions = what.module(*what.inputs.values())
        observed = what.inputs["observations"]
        assert {name: list(value.shape) for name, value in what.inputs.items()} == {
            "observations": [1, 5, 4],
            "noise": [1, 14, 2],
        }
        plan = whole.plan(observed, what.inputs["noise"])
    assert actions.shape == (1, 4, 3)
    torch.testing.assert_close(actions[:, 0], whole.act(observed, plan, 0))


def test_gain_and_command_limit_are_exported(tmp_path):
    what = exportable(policy(gain=1.5, lead=0.01), observation_dim=4)
    loaded = export_part(what, tmp_path / "policy.pt2")
    observed, noise = what.inputs["observations"] + 0.2, what.inputs["noise"]
    now = observed[0, -1]
    ahead = now[:2] - now[2:] + loaded(observed, noise)[0, :, :2]
    assert (ahead.abs() <= 0.01 + 1e-6).all() and (ahead.abs() > 0.0099).any()


@pytest.mark.parametrize("part", ["policy", "controller", "denoiser"])
def test_every_part_comes_back_from_its_file(part, tmp_path):
    what = exportable(policy(), part, observation_dim=4)
    loaded = export_part(what, tmp_path / f"{part}.pt2")
    other = [value + 0.1 for value in what.inputs.values()]
    with torch.no_grad():
        torch.testing.assert_close(loaded(*other), what.module(*other), atol=1e-5, rtol=1e-5)


def test_a_diffusion_policy_is_exported_too(tmp_path):
    what = exportable(chunks(), observation_dim=4)
    assert export_part(what, tmp_path / "policy.pt2")(*what.inputs.values()).shape == (1, 4, 3)
    with pytest.raises(ValueError, match="has no inverse dynamics to export"):
        exportable(chunks(), "controller", observation_dim=4)


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="ONNX is not installed (extra 'onnx')",
)
def test_onnx(tmp_path):
    what = exportable(policy(), "controller", observation_dim=4)
    loaded = export_part(what, tmp_path / "controller.onnx", kind="onnx")
    with torch.no_grad():
        torch.testing.assert_close(loaded(*what.inputs.values()), what.module(*what.inputs.values()))


@pytest.mark.slow
@pytest.mark.timeout(1800)  # minutes of g++
def test_aotinductor(tmp_path):
    what = exportable(policy(), observation_dim=4)
    export_part(what, tmp_path / "policy.aoti.pt2", kind="aoti")


def test_faults(tmp_path):
    what = exportable(policy(), "controller", observation_dim=4)
    with pytest.raises(ValueError, match="unknown export format 'onxx'; did you mean 'onnx'"):
        export_part(what, tmp_path / "x", kind="onxx")
    with pytest.raises(ValueError, match="unknown part of a policy 'denoisr'; did you mean 'denoiser'"):
        exportable(policy(), "denoisr", observation_dim=4)
    with pytest.raises(ExportError, match="differs from the policy by"):
        export_part(what, tmp_path / "x.pt2", tolerance=-1.0)
    assert set(SUFFIXES) == {"torch", "onnx", "aoti"}
