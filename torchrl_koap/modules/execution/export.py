# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies as files that run without this library: ``torch.export``, ONNX, AOTInductor.

What is exported is :meth:`~torchrl_koap.modules.PlanningPolicy.decode_ahead`: observations and start noise in, the next
actions out, gain and command limit included, the solver's loop unrolled inside. Whoever calls it keeps the last
observations and counts steps.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.followers import InverseDynamicsFollower
from torchrl_koap.modules.execution.policy import PlanningPolicy
from torchrl_koap.modules.inverse_dynamics import InverseDynamics

SUFFIXES = {"torch": ".pt2", "onnx": ".onnx", "aoti": ".aoti.pt2"}
PARTS = ("policy", "controller", "denoiser")


class ExportError(RuntimeError):
    """An export that is impossible here, or whose numbers are not those of the policy."""


class _WholePolicy(nn.Module):
    """Observations ``[B, history, obs]`` and noise to the next actions ``[B, interval, act]``."""

    def __init__(self, policy: PlanningPolicy):
        super().__init__()
        self.policy = policy

    def forward(self, observations: Tensor, noise: Tensor) -> Tensor:
        return self.policy.decode_ahead(observations, noise)


class _Controller(nn.Module):
    """Windows of states ``[B, T, d]`` to actions ``[B, T, act]``."""

    def __init__(self, controller: InverseDynamics):
        super().__init__()
        self.controller = controller

    def forward(self, states: Tensor) -> Tensor:
        out = self.controller(TensorDict({self.controller.in_key: states}, batch_size=states.shape[:1]))
        return out.get(self.controller.out_key)


@dataclass(frozen=True)
class Exportable:
    """A part of a policy as a plain module on tensors, an example of every input by name, and the output's name."""

    module: nn.Module
    inputs: dict[str, Tensor]
    output: str


def exportable(policy: PlanningPolicy, part: str = "policy", *, observation_dim: int) -> Exportable:
    """A part of a policy as a plain module.

    Args:
        policy (PlanningPolicy): the policy.
        part (str): ``"policy"``, its ``"controller"``, or the planner's ``"denoiser"``.

    Keyword Args:
        observation_dim (int): number of observation columns.

    Raises:
        ValueError: for another part, or the controller of a policy that decodes by no inverse dynamics.
    """
    lookup(PARTS, part, "part of a policy")
    planner = policy.planner
    like = next(planner.parameters())
    generator = torch.Generator().manual_seed(0)

    def example(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).to(like)

    if part == "policy":
        inputs = {
            "observations": 0.1 * example(1, policy.history, observation_dim),
            "noise": example(1, *planner.noise_shape),
        }
        return Exportable(_WholePolicy(policy), inputs, "actions")
    if part == "controller":
        follower = policy.follower
        if not isinstance(follower, InverseDynamicsFollower):
            raise ValueError("this policy has no inverse dynamics to export: its actions come from another model")
        width = planner.state_dim if follower.columns is None else len(follower.columns)
        inputs = {"states": example(1, policy.history + planner.horizon, width)}
        return Exportable(_Controller(follower.controller), inputs, "actions")
    condition = planner.encode_history(example(1, planner.history, planner.state_dim))
    inputs = {"sequence": example(1, *planner.noise_shape), "time": example(1).abs(), "condition": condition}
    return Exportable(planner.denoiser, inputs, "prediction")


def export_part(what: Exportable, file: str | Path, *, kind: str = "torch", tolerance: float = 1e-5) -> Callable:
    """Writes a part of a policy, of :func:`exportable`, and compares what is read back with the original.

    Keyword Args:
        kind (str): ``"torch"`` (``torch.export``), ``"onnx"`` (ONNX Runtime; extra ``onnx``) or ``"aoti"``
            (AOTInductor; needs a C++ compiler).
        tolerance (float): largest difference to the original, relative to the size of its output (at least 1).

    Returns:
        callable: what was read back; takes the inputs as tensors and returns the output.

    Raises:
        ValueError: for another kind.
        ExportError: if a package or compiler is missing, or the numbers differ.
    """
    write, read = lookup(_KINDS, kind, "export format")
    file, inputs = Path(file), tuple(what.inputs.values())
    what.module.eval()
    with torch.no_grad():
        expected = what.module(*inputs)
        write(what, file)
        loaded = read(what, file)
        found = loaded(*inputs)
    gap = float((found - expected).abs().max() / expected.abs().max().clamp_min(1))
    if not gap <= tolerance:
        raise ExportError(f"{file} differs from the policy by {gap:.1e}, at most {tolerance:.0e} is allowed")
    return loaded


def _write_torch(what: Exportable, file: Path) -> None:
    torch.export.save(torch.export.export(what.module, tuple(what.inputs.values())), file)


def _write_onnx(what: Exportable, file: Path) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            raise ExportError(f"{name} is not installed: pip install 'torchrl_koap[onnx]'")
    program = torch.onnx.export(
        what.module,
        tuple(what.inputs.values()),
        dynamo=True,
        input_names=list(what.inputs),
        output_names=[what.output],
        verbose=False,
    )
    program.save(str(file))


def _read_onnx(what: Exportable, file: Path) -> Callable:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    names = list(what.inputs)

    def run(*inputs: Tensor) -> Tensor:
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in zip(names, inputs, strict=True)}
        return torch.from_numpy(session.run(None, arrays)[0])

    return run


def _write_aoti(what: Exportable, file: Path) -> None:
    program = torch.export.export(what.module, tuple(what.inputs.values()))
    try:
        torch._inductor.aoti_compile_and_package(program, package_path=str(file))
    except Exception as error:  # the compiler is asked in many places
        if "compiler" in str(error).lower():
            raise ExportError(f"AOTInductor needs a C++ compiler such as g++: {str(error).splitlines()[0]}") from error
        raise


_KINDS = {
    "torch": (_write_torch, lambda what, file: torch.export.load(file).module()),
    "onnx": (_write_onnx, _read_onnx),
    "aoti": (_write_aoti, lambda what, file: torch._inductor.aoti_load_package(str(file))),
}
