# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that exported policies return the numbers of the policy."""

import importlib.util
import json
import logging
import warnings

import numpy as np
import pytest
import torch
from small_networks import chunk_policy, small_planner

from torchrl_koap.modules import Execution, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.modules.execution import export
from torchrl_koap.modules.execution.export import FACTS, Exportable, ExportError, export_policy, exportable

needs_onnx = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="ONNX is not installed (extra 'onnx')",
)
COLUMNS = {"observations": {"cx": "m", "cy": "m", "x": "m", "y": "m"}, "actions": {"dx": "m", "dy": "m", "grip": ""}}


def policy(ranges=None, **execution):
    return make_policy(
        small_planner(),
        make_koopman_inverse_dynamics(2, 3),
        state_of=(2, 3),
        changes=(0, 1),
        commanded={"commands": [0, 1], "states": [0, 1]},
        ranges=ranges,
        control_hz=30.0,
        execution=Execution(**execution),
    )


def chunks():
    return chunk_policy((2, 3), actions=3)


def test_the_stateless_policy_is_the_open_loop_one():
    whole = policy()
    what = exportable(whole, columns=COLUMNS)
    with torch.no_grad():
        actions, limited = what.module(*what.inputs.values())
        observed = what.inputs["observations"]
        assert {name: list(value.shape) for name, value in what.inputs.items()} == {
            "observations": [1, 5, 4],
            "noise": [1, 14, 2],
        }
        plan = whole.plan(observed, what.inputs["noise"])
    assert actions.shape == (1, 4, 3) and not limited.any()
    torch.testing.assert_close(actions[:, 0], whole.act(observed, plan, 0))


class StandStill(torch.nn.Module):
    """A planner without parameters."""

    history, horizon, noise_shape, noise_key = 2, 14, (14, 2), None

    def sample(self, history, noise):
        return history[..., -1:, :].expand(*history.shape[:-2], 14, -1)


def test_a_planner_without_parameters_is_exported(tmp_path):
    own = make_policy(StandStill(), make_koopman_inverse_dynamics(2, 3), state_of=(2, 3))
    what = exportable(own, columns=COLUMNS)
    inputs = what.batch(3)
    actions, _ = export_policy(what, tmp_path / "policy.pt2")(*inputs)
    with torch.no_grad():
        torch.testing.assert_close(actions, own.decode_ahead(*inputs)[0], atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    what, path = exportable(policy(candidates=3), columns=COLUMNS), tmp_path_factory.mktemp("exported") / "policy.pt2"
    return what, path, export_policy(what, path)


def test_a_policy_comes_back_from_its_file(exported):
    what, path, loaded = exported
    other = [value + 0.1 for value in what.batch(7)]  # the batch is dynamic
    with torch.no_grad():
        expected = what.module(*other)
    torch.testing.assert_close(loaded(*other), expected, atol=1e-5, rtol=1e-5)
    assert not torch.export.load(path).module()(*other)[0].requires_grad  # .numpy() needs no torch.no_grad()
    assert what.module(*other)[0].requires_grad


def test_an_origin_is_exported(tmp_path):
    origins = (4e6, 0.0, 4e6, 0.0), (0.0, 4e6, 0.0)
    far = make_policy(policy().planner, policy().follower.controller, state_of=(2, 3), control_hz=30.0, origins=origins)
    what = exportable(far, columns=COLUMNS)
    observed, noise = what.inputs["observations"], what.inputs["noise"]
    assert what.facts["inputs"]["observations"]["type"] == "float64" and observed.abs().max() > 1e6
    actions, _ = export_policy(what, tmp_path / "policy.pt2")(observed, noise)
    near = (observed - torch.tensor(origins[0], dtype=torch.float64)).float()
    expected, _ = far.decode_ahead(near, noise)
    torch.testing.assert_close(
        actions - torch.tensor(origins[1], dtype=torch.float64), expected.double(), atol=1e-5, rtol=0
    )


def test_a_diffusion_policy_is_exported_too(tmp_path):
    what = exportable(chunks(), columns=COLUMNS)
    assert export_policy(what, tmp_path / "policy.pt2")(*what.inputs.values())[0].shape == (1, 4, 3)


@needs_onnx
def test_onnx_is_called_as_its_metadata_say(tmp_path):
    import onnxruntime

    frames, noise = torch.randn(5, 5, 4), torch.randn(5, 3, 14, 2)
    with torch.no_grad():
        usual = 0.99 * float(policy(candidates=3).decode_ahead(frames, noise)[0][..., 0].abs().median())
        whole = policy(ranges=[(-usual / 2, usual / 2), None, None], replan_interval=3, candidates=3)  # widened by half
        expected, held = whole.decode_ahead(frames, noise)
    with warnings.catch_warnings(action="error"):
        export_policy(exportable(whole, columns=COLUMNS), tmp_path / "policy.onnx", kind="onnx")
    assert not logging.getLogger("torch.onnx._internal").isEnabledFor(logging.WARNING)  # "torchvision is not installed"
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    inputs, outputs = json.loads(facts["inputs"]), json.loads(facts["outputs"])
    assert [entry.name for entry in session.get_inputs()] == list(inputs)
    assert [entry.name for entry in session.get_outputs()] == list(outputs)
    assert [entry.shape for entry in session.get_inputs()] == [entry["shape"] for entry in inputs.values()]
    actions, limited = session.run(None, {"observations": frames.numpy(), "noise": noise.numpy()})
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    np.testing.assert_array_equal(limited, held)
    assert actions.shape == (5, int(facts["steps_per_plan"]), 3) and limited.any() and not limited.all()
    assert np.abs(actions[..., 0]).max() == pytest.approx(usual) and float(facts["control_hz"]) == 30.0


class Convolved(torch.nn.Conv1d):
    def forward(self, observations, noise):
        return (super().forward(observations) + noise,)


@needs_onnx
def test_a_float64_policy_that_onnx_cannot_run_is_told(tmp_path):
    example = torch.zeros(1, 2, 3, dtype=torch.float64)
    what = Exportable(Convolved(2, 2, 1).double(), {"observations": example, "noise": example}, {})
    with pytest.raises(ExportError, match=r"cannot run this policy; in float64, convert it by .float\(\): .*Conv"):
        export_policy(what, tmp_path / "policy.onnx", kind="onnx")


def test_facts_are_in_the_file_of_torch_export(exported):
    found = {FACTS: ""}
    torch.export.load(exported[1], extra_files=found)
    facts = json.loads(found[FACTS])
    assert facts["inputs"]["observations"] == {
        "shape": ["batch", 5, 4],
        "type": "float32",
        "meaning": "raw units, oldest frame first, the present one last; at the start the first one is repeated",
        "columns": ["cx", "cy", "x", "y"],
        "units": ["m"] * 4,
    }
    assert facts["outputs"]["actions"]["columns"] == ["dx", "dy", "grip"]
    assert facts["steps_per_plan"] == 4 and "open loop between plans" in facts["note"]


@pytest.mark.parametrize("off", [2e-5, float("nan")])
def test_a_file_that_differs_in_one_number_for_several_robots_is_refused(off, tmp_path, monkeypatch):
    what = exportable(policy(), columns=COLUMNS)
    assert not torch.equal(*what.batch(2)[0])  # of different robots

    def read(_, file):
        def run(*inputs):
            actions, limited = what.module(*inputs)
            if len(actions) > 1:
                actions[-1, -1, -1] += off * actions.abs().max()
            return actions, limited

        return run

    monkeypatch.setitem(export._KINDS, "torch", (lambda _, file: file.touch(), read))
    with pytest.raises(ExportError, match=f"differs from the policy by {off:.1e}, at most 1e-05 is allowed"):
        export_policy(what, tmp_path / "x.pt2")
    assert not list(tmp_path.iterdir())
    assert export.relative_gap([torch.zeros(2)], [torch.zeros(2)]) == 0.0


def test_faults(tmp_path):
    what = exportable(policy(), columns=COLUMNS)
    with pytest.raises(ValueError, match="unknown export format 'onxx'; did you mean 'onnx'"):
        export_policy(what, tmp_path / "x", kind="onxx")
    with pytest.raises(ExportError, match="differs from the policy by"):
        export_policy(what, tmp_path / "x.pt2", tolerance=-1.0)
