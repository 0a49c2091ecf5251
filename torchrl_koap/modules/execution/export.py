# This source code is licensed under the MIT license found in the LICENSE file.
"""Exports policies to files that run without this library: ``torch.export`` or ONNX.

A file holds :meth:`~torchrl_koap.modules.PlanningPolicy.decode_ahead`, which maps observations and start noise to the
next actions. Gain and command limits are included; the solver's loop is unrolled. The caller stores the last
observations and counts steps. Every file describes its inputs and outputs (:attr:`Exportable.facts`).
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.policy import PlanningPolicy

SUFFIXES = {"torch": ".pt2", "onnx": ".onnx"}
FACTS = "facts.json"  # name inside a file of torch.export
_BATCHES = (1, 3)  # batch sizes that a written file is tested with
_OUTPUTS = ("actions", "limited")
_MEANINGS = {
    "observations": "raw units, oldest frame first, the present one last; at the start the first one is repeated",
    "noise": "standard normal numbers, drawn anew for every call",
    "actions": "raw units, the next control step first",
    "limited": "which of these actions were outside their range and were clipped to it",
}
_OPEN_LOOP = (
    "Exported chunks are open loop between plans: all actions of a call depend only on its observations. Execute one"
    " per control step, then call again. Strategy 'feedback' observes at every step; its results do not hold for this"
    " file."
)

Outputs = tuple[Tensor, ...]


class ExportError(RuntimeError):
    """An export is impossible on this machine, or differs from the policy."""


class _Stateless(nn.Module):
    """Maps observations ``[B, history, obs]`` and noise to the next actions ``[B, interval, act]`` and ``limited``."""

    def __init__(self, policy: PlanningPolicy):
        super().__init__()
        self.policy = policy

    def forward(self, observations: Tensor, noise: Tensor) -> Outputs:
        actions, held = self.policy.decode_ahead(self.policy.from_robot(observations).to(noise), noise)
        return self.policy.to_robot(actions), held


@dataclass(frozen=True)
class Exportable:
    """A policy as a plain module on tensors, of any batch size."""

    module: nn.Module  # maps the inputs, in their order, to a tuple of tensors
    inputs: dict[str, Tensor]  # an example of every input by name, batch 1
    facts: dict[str, Any]  # shapes, columns, order of frames, noise, control rate and steps per plan, for the caller

    def batch(self, size: int) -> tuple[Tensor, ...]:
        """Returns example inputs of several robots, all different."""
        return tuple(torch.cat([value + 0.1 * index for index in range(size)]) for value in self.inputs.values())


def exportable(
    policy: PlanningPolicy, *, columns: Mapping[str, Mapping[str, str]], kinds: Sequence[str] = (), note: str = ""
) -> Exportable:
    """Returns a policy as a plain module; its facts also hold the ``kinds`` of the actions and the ``note``.

    ``columns`` maps names to units, for the columns of ``"observations"`` and of ``"actions"``.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = (1, policy.history, len(columns["observations"])), (1, *policy.noise_shape)
    like = next(policy.parameters(), torch.empty(0))
    seen, noise = (torch.randn(*size, generator=generator).to(like) for size in sizes)
    seen = 0.1 * seen
    if policy.origins is not None:
        seen = seen.double() + policy.origins[0].to(seen.device)
    module, inputs = _Stateless(policy).eval(), {"observations": seen, "noise": noise}
    with torch.no_grad():
        found = dict(zip(_OUTPUTS, module(*inputs.values()), strict=True))
    outputs = _tensors(found, columns)
    outputs["actions"] |= {"kinds": list(kinds)} if kinds else {}
    facts = {
        "inputs": _tensors(inputs, columns),
        "outputs": outputs,
        "control_hz": policy.control_hz,
        "steps_per_plan": policy.execution.replan_interval,
        "note": _OPEN_LOOP + note,
    }
    return Exportable(module, inputs, facts)


def _tensors(tensors: Mapping[str, Tensor], columns: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tensors.items():
        shape, kind = ["batch", *value.shape[1:]], str(value.dtype).removeprefix("torch.")
        found[name] = {"shape": shape, "type": kind, "meaning": _MEANINGS[name]}
        if name in columns:
            found[name] |= {"columns": list(columns[name]), "units": list(columns[name].values())}
    return found


def export_policy(
    what: Exportable, file: str | Path, *, kind: str = "torch", tolerance: float = 1e-5
) -> Callable[..., Outputs]:
    """Writes a policy of :func:`exportable`, compares the file with the original and returns the loaded program.

    The file's batch size is dynamic; it is tested with one robot and with three. The file holds the facts: read them by
    ``torch.export.load(file, extra_files={"facts.json": ""})``, or from an ONNX model's metadata (JSON per entry).

    Kinds are ``"torch"`` (``torch.export``) and ``"onnx"`` (ONNX Runtime; extra ``onnx``). The tolerance is relative to
    the largest number of the original's output. Raises an ExportError if a package is missing, or if the numbers
    differ; the file is then removed.
    """
    write, read = lookup(_KINDS, kind, "export format")
    file = Path(file)
    with torch.no_grad():
        with _frozen(what.module), warnings.catch_warnings(action="ignore"):  # exporters warn of their own internals
            write(what, file)
        loaded = read(what, file)
        gaps = [relative_gap(loaded(*batch), what.module(*batch)) for batch in map(what.batch, _BATCHES)]
    for gap in gaps:
        if not gap <= tolerance:  # NaN, too
            file.unlink()
            raise ExportError(f"{file} differs from the policy by {gap:.1e}, at most {tolerance:.0e} is allowed")
    return loaded


@contextlib.contextmanager
def _frozen(module: nn.Module) -> Iterator[None]:
    """Takes no gradients by the parameters inside the block: a file that does is called under ``torch.no_grad()``."""
    learned = [parameter for parameter in module.parameters() if parameter.requires_grad]
    module.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_()


def relative_gap(found: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
    """Returns the largest difference of the first outputs, relative to the largest number expected."""
    gap, size = (found[0] - expected[0]).abs().max(), expected[0].abs().max()
    return float(gap / size) if size > 0 else float(gap)


def _program(what: Exportable) -> torch.export.ExportedProgram:
    dynamic = ({0: torch.export.Dim("batch")},) * len(what.inputs)
    return torch.export.export(what.module, what.batch(2), dynamic_shapes=dynamic)


def _write_torch(what: Exportable, file: Path) -> None:
    torch.export.save(_program(what), file, extra_files={FACTS: json.dumps(what.facts)})


def _write_onnx(what: Exportable, file: Path) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            raise ExportError(f"{name} is not installed: pip install 'torchrl_koap[onnx]'")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns of packages that no policy needs
    program = torch.onnx.export(
        _program(what),
        input_names=list(what.inputs),
        output_names=list(_OUTPUTS),
        dynamic_shapes=({0: "batch"},) * len(what.inputs),
        dynamo=True,
        verbose=False,
    )
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in what.facts.items()}
    program.model.metadata_props.update(texts)  # it stores only strings
    program.save(str(file))


def _read_onnx(what: Exportable, file: Path) -> Callable[..., Outputs]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except onnxruntime.capi.onnxruntime_pybind11_state.NotImplemented as error:
        raise ExportError(
            f"ONNX Runtime cannot run this policy; in float64, convert it by .float(): {error}"
        ) from error
    names = list(what.inputs)

    def run(*inputs: Tensor) -> Outputs:
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in zip(names, inputs, strict=True)}
        return tuple(map(torch.from_numpy, session.run(None, arrays)))

    return run


_KINDS = {
    "torch": (_write_torch, lambda what, file: torch.export.load(file).module()),
    "onnx": (_write_onnx, _read_onnx),
}
