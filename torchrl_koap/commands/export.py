# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap export``: a trained policy as files that run without this library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.command import Command
from torchrl_koap.evaluation import load_policy
from torchrl_koap.evaluation.latency import time_calls
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import InverseDynamicsFollower
from torchrl_koap.modules.execution.export import PARTS, SUFFIXES, export_part, exportable
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.runs.pretrained import writable_folder
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.training import Trained


@dataclass(kw_only=True)
class Export(Command):
    """Write the whole policy, its controller and its denoiser, and compare each with the original (1e-5).

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        out: folder to write (default: RUN/exported).
        format: "torch" (torch.export), "onnx" (ONNX Runtime) or "aoti" (AOTInductor, needs a C++ compiler).
        threads: torch threads.
        latency: time the exported parts against eager ones.
    """

    run: tyro.conf.Positional[str]
    out: Path | None = None
    format: str = "torch"
    threads: int = 1
    latency: bool = True

    def __call__(self) -> dict[str, Any]:
        """Exports, compares, times."""
        suffix = lookup(SUFFIXES, self.format, "export format")
        set_up_torch(self.threads, "cpu")
        trained = Trained.load(self.run)
        policy = load_policy(trained)
        out = writable_folder(self.run) / "exported" if self.out is None else self.out
        out.mkdir(parents=True, exist_ok=True)
        parts = [part for part in PARTS if part != "controller" or isinstance(policy.follower, InverseDynamicsFollower)]
        result: dict[str, Any] = {}
        with progress_bar(len(parts), "export", unit="part") as bar:
            for part in parts:
                what = exportable(policy, part, observation_dim=trained.task.observation_dim)
                file = out / f"{part}{suffix}"
                loaded = export_part(what, file, kind=self.format)
                result[part] = {"file": str(file), "kilobytes": round(file.stat().st_size / 1e3)}
                result[part] |= {f"{name} in": list(value.shape) for name, value in what.inputs.items()}
                if self.latency:
                    times = time_calls({"eager": what.module, self.format: loaded}, tuple(what.inputs.values()))
                    result[f"{part} ms"] = times
                bar.update()
        return result
