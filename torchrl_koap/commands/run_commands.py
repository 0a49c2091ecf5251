# This source code is licensed under the MIT license found in the LICENSE file.
"""The commands that train, evaluate, export or compare runs."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.options import Command, Options
from torchrl_koap.evaluation import EvalConfig, InspectConfig, SuggestConfig, evaluate, inspect, load_policy, suggest
from torchrl_koap.evaluation.latency import LatencyConfig, measure_control_loop
from torchrl_koap.files import some
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.export import SUFFIXES, export_policy, exportable
from torchrl_koap.reports.pictures import draw_pictures
from torchrl_koap.reports.rows import as_text, evaluation_rows, training_rows
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.runs.config_files import to_json
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.runs.plugins import Plugins
from torchrl_koap.runs.progress import check_logger, log_scores, open_logger
from torchrl_koap.runs.run_directory import RunDirectory, writable_folder
from torchrl_koap.studies import Machines, Study, run_study
from torchrl_koap.studies.table import not_done, result_rows
from torchrl_koap.training import TrainConfig, Trained, train
from torchrl_koap.training.lerobot_folder import write_lerobot_folder


@dataclass(kw_only=True)
class Train(Command):
    """Train planner and controller from few action labels.

    Example: `koap train --dataset arm --out runs/arm --labels 5`

    Attributes:
        config: all options.
    """

    config: Options[TrainConfig]

    def __call__(self) -> dict[str, str]:
        """Trains."""
        out = str(self.config.out)
        try:
            train(self.config, command=shlex.join(["koap", *sys.argv[1:]]))
        except KeyboardInterrupt as interrupt:
            interrupt.args = (_how_to_resume(self.config.out),)
            raise
        return {**as_text(training_rows(RunFacts.read(out))), "run": out, "next": f"koap eval {shlex.quote(out)}"}


def _how_to_resume(out: Path) -> str:
    """Returns what to do after a training was interrupted."""
    if not (out / "config.json").exists():
        return "nothing is trained yet: train again"
    kept = any((out / "checkpoints").glob("*.safetensors"))
    effect = "resumes at its last checkpoint" if kept else "starts again, as there is no checkpoint yet"
    return f"`koap train --out {shlex.quote(str(out))} --resume` {effect}"


@contextlib.contextmanager
def _folder_of(run: str, config: EvalConfig, command: str) -> Iterator[Path]:
    """Yields the folder that a command writes to; if it is a run, no other command can work there meanwhile."""
    folder = Path(run) if config.out is None else config.out
    is_run = (folder / "config.json").exists()
    with RunDirectory(folder).locked(command) if is_run else contextlib.nullcontext():
        yield folder


@dataclass(kw_only=True)
class Eval(Command):
    """Evaluate a run by rollouts or on recorded data; write its report.

    Options from `--strategy` to `--limits` default to those of the training.

    Example: `koap eval runs/arm`

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME, a trained policy of the repository.
        config: all options of the rollouts.
        report: draw the pictures and write the report; without, an earlier report is deleted.
        animate: make an animation of the rollouts for the report.
        logger: where scores go in addition to the run directory: wandb (offline unless WANDB_MODE is set) or
            tensorboard; each needs its extra.
    """

    run: tyro.conf.Positional[str]
    config: Options[EvalConfig]
    report: bool = True
    animate: bool = True
    logger: str = "csv"

    def __call__(self) -> dict[str, str]:
        """Evaluates and reports."""
        check_logger(self.logger)
        with _folder_of(self.run, self.config, "koap eval") as folder:
            result = evaluate(self.run, self.config)
            report = {}
            if self.report:
                report["report"] = str(write_report(folder, animation=self.animate))
            else:
                (folder / "index.html").unlink(missing_ok=True)  # it tells the numbers of an earlier evaluation
            with open_logger(self.logger, folder, {"run": self.run} | to_json(self.config)) as logger:
                if logger is not None:
                    rates = {f"{name}_rate": values["rate"] for name, values in result.get("rates", {}).items()}
                    log_scores(logger, result | rates)
            faults = {f"FAULT {number}": fault for number, fault in enumerate(result.get("faults", ()), 1)}
            return as_text(evaluation_rows(RunFacts.read(folder))) | faults | report


@dataclass(kw_only=True)
class Inspect(Command):
    """Find out which part of a run fails and what latent actions hold.

    Options from `--strategy` to `--limits` default to those of the training.

    Example: `koap inspect runs/arm`

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        config: all options.
    """

    run: tyro.conf.Positional[str]
    config: Options[InspectConfig]

    def __call__(self) -> dict[str, Any]:
        """Inspects and draws."""
        with _folder_of(self.run, self.config, "koap inspect") as folder:
            result = inspect(self.run, self.config)
            draw_pictures(folder, names=("inspect.png", "latent.png"))
            if (folder / "index.html").exists():
                write_report(folder, draw=False)
            # findings summarise the latent space; a policy that follows no plans has no distances to them
            shown = {name: value for name, value in result.items() if name != "latent" and value != {}}
            return shown | {"all numbers": str(folder / "inspect.json")}


@dataclass(kw_only=True)
class Suggest(Command):
    """Say which unlabelled demonstrations to label next.

    No label outside the budget of the run is read.

    Example: `koap suggest runs/arm`

    Attributes:
        run: run directory of `koap train`.
        config: all options.
    """

    run: tyro.conf.Positional[Path]
    config: Options[SuggestConfig]

    def __call__(self) -> dict[str, Any]:
        """Ranks the unlabelled demonstrations and writes ``suggestions.json``."""
        found = suggest(self.run, self.config)
        if self.run.is_dir():  # nothing is written into pretrained:NAME
            RunDirectory(self.run).write_json("suggestions.json", found)
        shown = ("source", "steps", "score")
        rows = {
            f"episode {row['episode']}": {name: row[name] for name in shown if name in row}
            for row in found["suggestions"]
        }
        return rows | {"next": found["next"]}


@dataclass(kw_only=True)
class Latency(Command):
    """Count the late steps of a control loop in real time.

    Example: `koap latency runs/arm`

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        config: length and rate of the loop.
    """

    run: tyro.conf.Positional[str]
    config: Options[LatencyConfig]

    def __call__(self) -> dict[str, str]:
        """Measures."""
        found = measure_control_loop(self.run, self.config)
        median, most, longest = (f"{found[name]:.3g} ms" for name in ("p50", "p99", "max"))
        return {
            "late steps": f"{found['late_steps']} of {found['steps']:,}; a step may take {found['step_ms']:.4g} ms",
            "time per step": f"median {median}, 99 % below {most}, longest {longest}",
        }


@dataclass(kw_only=True)
class Export(Command):
    """Write a policy for torch.export, ONNX or LeRobot.

    It is compared with the original (1e-5); policy.json describes how to call it.

    Example: `koap export runs/arm --format onnx`

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        out: folder to write (default: RUN/exported).
        format: "torch" (torch.export), "onnx" (ONNX Runtime) or "lerobot" (a folder for lerobot-eval and
            lerobot-record).
        plugins: modules that register task or method, or define a camera's network, at their present paths.
    """

    run: tyro.conf.Positional[str]
    out: Path | None = None
    format: str = "torch"
    plugins: Plugins = ()

    def __call__(self) -> dict[str, Any]:
        """Exports and compares."""
        suffix = lookup(SUFFIXES | {"lerobot": None}, self.format, "export format")
        set_up_torch(1, "cpu")
        trained = Trained.load(self.run, plugins=self.plugins)
        out = writable_folder(self.run) / "exported" if self.out is None else self.out
        RunDirectory(out).refuse_data()
        if suffix is None:
            return write_lerobot_folder(trained, out)
        out.mkdir(parents=True, exist_ok=True)
        columns = {
            "observations": dict(zip(trained.task.observation_names, trained.task.known_units, strict=True)),
            "actions": dict(zip(trained.task.action_names, trained.task.action_units, strict=True)),
        }
        kinds, seen = [action.kind for action in trained.task.actions.values()], ", ".join(trained.cameras)
        note = f" Columns of {seen} are embeddings: the file takes no frames." if seen else ""
        what = exportable(load_policy(trained), columns=columns, kinds=kinds, note=note)
        file = out / f"policy{suffix}"
        export_policy(what, file, kind=self.format)
        result: dict[str, Any] = {"file": str(file), "kilobytes": round(file.stat().st_size / 1e3)}
        result |= {f"{name} in": list(value.shape) for name, value in what.inputs.items()}
        RunDirectory(out).write_json("policy.json", {"task": trained.task.name, "file": file.name, **what.facts})
        return result | {"note": what.facts["note"]}


@dataclass(kw_only=True)
class Curve(Command):
    """Measure success against the number of labels.

    A study has tasks x methods x shares of labels x seeds.

    Example: `koap curve --tasks avoiding --labels 0.02 0.1 --out curve`

    Attributes:
        config: all options.
        machines: where the cells run.
    """

    config: Options[Study]
    machines: Options[Machines] = field(default_factory=Machines)

    def __call__(self) -> dict[str, Any]:
        """Runs the missing cells of the study and writes its report."""
        result = run_study(self.config, self.machines)
        cells = ", ".join(f"{count} {status}" for status, count in result.counts.items())
        failed = {"failed": some(not_done(result.rows))} if result.counts["failed"] else {}
        return {**result_rows(result.rows), "trainings": cells, **failed, "report": str(result.report)}


@dataclass(kw_only=True)
class Bench(Curve):
    """Reproduce a table of the paper.

    Short for `koap curve --preset table1` or `table2`.

    Example: `koap bench --table 1 --out bench`

    Attributes:
        table: 1 (methods) or 2 (variants).
    """

    table: int

    def __call__(self) -> dict[str, Any]:
        """Runs the missing cells of the table and writes its report."""
        if self.table not in (1, 2):
            raise ValueError(f"table must be 1 or 2, got {self.table}")
        return Curve(config=replace(self.config, preset=f"table{self.table}"), machines=self.machines)()
