# This source code is licensed under the MIT license found in the LICENSE file.
"""Options of ``koap train`` and the ``config.json`` that a run keeps of them."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from torchrl_koap.data import LabelBudget
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.tasks import HISTORY, HORIZON, WINDOW, Task
from torchrl_koap.training.methods import Method, get_method
from torchrl_koap.training.released_settings import POLICY, get_released
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError


@dataclass
class Train:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        out: run directory to write.
        task: name of the task.
        dataset: "scripted", or a folder: of D3IL raw pickles, a LeRobot data set, or written by `koap demos`.
        label_fraction: share of the trajectories, windows or transitions that keep their actions.
        label_count: number of them instead of a share.
        label_episodes: these trajectories instead of a random choice, as `koap suggest` names them.
        label_unit: "trajectory", "window" (the paper's levels) or "transition".
        seed: seed of label choice, initialisation and batches.
        observation_fraction: share of the trajectories that are used at all; those with labels come first.
        method: "koap", "linear" (ridge on raw frames), "dd" (supervised inverse dynamics), "dp" (Diffusion Policy), or
            another name in torchrl_koap.training.methods.METHODS.
        released_settings: the unequal network, learning rate and updates that the first public code has for the method.
        epochs: with released settings, epochs instead of the first code's.
        preset: variant of KOAP: "default", "paper" or "released" (default: the method's own).
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest); default: the method's.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: controller updates.
        batch_size: windows per planner update.
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner.
        controller_learning_rate: peak learning rate of the controller.
        denoiser: "unet", "mlp", "film" (an mlp that the condition also scales and shifts), "transformer" or "released"
            (11.9 M parameters).
        channels: widths of the U-Net's levels (default: the task's).
        denoiser_width: hidden width of "mlp" and "transformer" (default: 256 and 64).
        denoiser_depth: their number of residual layers (default: 3).
        condition_octaves: octaves of the Fourier features of what was observed (default: 4).
        dropout: share of the hidden units of "mlp" dropped in training (default: 0).
        planner_weight_decay: decoupled weight decay of the planner (default: 1e-4).
        first_steps_weight: weight of the first planned step in the planner's loss against the last one's (default: 1).
        precision: "float32", or "bfloat16" for the matrix products of the planner's training: several times quicker
            where the processor has them (default: float32).
        schedule: "squared_cosine", "linear" or "flow".
        prediction: "sample", "epsilon" or "velocity".
        relative: plan displacements from the current state instead of states (default: the task's).
        relations: tell the planner where the tool is as seen from the objects (tasks with objects).
        controller_state: what the controller reads, "robot" (the robot's own columns) or "all" (KOAP's configurations).
        recovery_sigma: typical shift of the recovery augmentation in m or rad (default: the task's); 0 turns it off.
        scene_shift: typical displacement (m) of whole scenes, for tasks whose place on the table does not matter.
        scene_turn: typical angle (rad) by which such scenes are turned.
        exchange: exchange objects that are alike.
        solver: solver used at evaluation unless told otherwise.
        solver_steps: its number of steps.
        candidates: plans sampled whenever one is due at evaluation, unless told otherwise there (default: 1).
        planner_from: run directory whose planner is taken over instead of training one.
        episodes: number of scripted demonstrations (default: that of the task).
        threads: torch threads.
        device: "cpu" or "cuda".
        checkpoint_every: updates between two checkpoints, from which --resume goes on.
        resume: go on with an interrupted run; options left at their defaults are those it was started with.
        logger: "csv" (metrics.csv alone) or "wandb" as well (offline unless WANDB_MODE says otherwise).
        analysis: measure the action error on unlabelled demonstrations (reads labels outside the budget, afterwards).
    """

    out: Path
    task: str = "avoiding"
    dataset: str = "scripted"
    label_fraction: float = 0.02
    label_count: int | None = None
    label_episodes: tuple[int, ...] | None = None
    label_unit: str = "trajectory"
    observation_fraction: float = 1.0
    seed: int = 0
    method: str = "koap"
    released_settings: bool = False
    epochs: int | None = None
    preset: str | None = None
    decoder: str | None = None
    steps: int | None = None
    controller_steps: int = 500
    batch_size: int = 128
    controller_batch_size: int = 256
    planner_learning_rate: float = 3e-3
    controller_learning_rate: float = 1e-3
    denoiser: str = "unet"
    channels: tuple[int, ...] | None = None
    denoiser_width: int | None = None
    denoiser_depth: int | None = None
    condition_octaves: int | None = None
    dropout: float | None = None
    planner_weight_decay: float | None = None
    first_steps_weight: float | None = None
    precision: str | None = None
    schedule: str = "squared_cosine"
    prediction: str = "sample"
    relative: bool | None = None
    relations: bool = True
    controller_state: str = "robot"
    recovery_sigma: float | None = None
    scene_shift: float = 0.05
    scene_turn: float = 0.3
    exchange: bool = True
    solver: str = "dpm++2m"
    solver_steps: int = 10
    candidates: int | None = None
    planner_from: Path | None = None
    episodes: int | None = None
    threads: int = 1
    device: str = "cpu"
    checkpoint_every: int = 500
    resume: bool = False
    logger: str = "csv"
    analysis: bool = True


# options with which a run may be resumed differently; with other threads sums are rounded differently
FREE = ("out", "threads", "checkpoint_every", "resume")


def budget_of(options: Train) -> LabelBudget:
    """The label budget that the options describe.

    Raises:
        ValueError: if it is out of range, or episodes are given together with another choice.
    """
    if options.label_episodes is not None:
        if options.label_count is not None or options.label_unit != "trajectory":
            raise ValueError("label_episodes are trajectories of their own choice: no label_count or label_unit")
        return LabelBudget.of_episodes(options.label_episodes)
    amount = options.label_fraction if options.label_count is None else options.label_count
    return LabelBudget(amount, unit=options.label_unit, seed=options.seed, window=WINDOW, history=HISTORY)


def method_of(options: Train) -> Method:
    """The method that the options name.

    Raises:
        ValueError: if there is none, or not with that decoder or released settings.
    """
    if options.released_settings:
        if options.decoder is not None or options.preset is not None:
            raise ValueError("released settings come with their own decoder and preset: no --decoder, no --preset")
        if options.epochs is not None and options.epochs < 1:
            raise ValueError(f"epochs must be >= 1, got {options.epochs}")
        return get_released(options.method).method
    if options.epochs is not None:
        raise ValueError("epochs are counted with --released-settings only; otherwise there are --controller-steps")
    method = get_method(options.method, options.decoder)
    if (
        options.preset is not None
        and lookup(PRESETS, options.preset, "preset")
        and (options.preset not in method.presets)
    ):
        raise ValueError(f"method {options.method!r} has no preset {options.preset!r}, it has {list(method.presets)}")
    return method


def started_with(run: RunDirectory, options: Train) -> Train:
    """The options of a resumed run: what was not asked for otherwise is as it was."""
    if not (options.resume and (run.path / "config.json").exists()):
        return options
    earlier = run.read_json("config.json")
    left = [field.name for field in fields(options) if getattr(options, field.name) == field.default]
    kept = {name: earlier[name] for name in left if name in earlier}
    for name in ("channels", "label_episodes"):
        if kept.get(name) is not None:
            kept[name] = tuple(kept[name])
    if kept.get("planner_from") is not None:
        kept["planner_from"] = Path(kept["planner_from"])
    return replace(options, **kept)


def with_task_defaults(options: Train, task: Task) -> Train:
    """Fills in what was left to the task."""
    defaults = {
        "steps": task.planner_steps,
        "recovery_sigma": task.recovery_sigma,
        "episodes": task.demonstrations,
        "relative": task.relative,
        "channels": task.channels,
    }
    left = {name: value for name, value in defaults.items() if getattr(options, name) is None}
    return replace(options, **left)


def configure(run: RunDirectory, options: Train) -> dict[str, Any]:
    """Everything that ``config.json`` holds; compared with what is there already."""
    config = asdict(options)
    config |= {name: str(config[name]) for name in ("out", "planner_from") if config[name] is not None}
    config["planner"] = {
        "denoiser": options.denoiser,
        "channels": list(options.channels),
        "schedule": options.schedule,
        "prediction": options.prediction,
        "history": HISTORY,
        "horizon": HORIZON,
        "relative": options.relative,
        "relations": options.relations,
        "solver": options.solver,
        "solver_steps": options.solver_steps,
        "clip": 1.2 if options.prediction == "sample" else 1.0,
    }
    sizes = {
        "width": options.denoiser_width,
        "depth": options.denoiser_depth,
        "frequencies": options.condition_octaves,
        "dropout": options.dropout,
    }
    # what was left out is left out here too, so that a run of before can be resumed
    config["planner"] |= {name: value for name, value in sizes.items() if value is not None}
    if options.planner_from is not None:
        config["planner"] = RunDirectory(options.planner_from).read_entry("config.json", "planner")
    method = method_of(options)
    if method.acts and options.released_settings:
        config["planner"] |= POLICY
    config["controller"] = {
        "method": options.method,
        "decoder": options.decoder,
        "released": options.released_settings,
        "preset": "released" if options.released_settings else options.preset or method.presets[0],
        "state": "all" if method.acts else options.controller_state,
    }
    for name in ("channels", "label_episodes"):
        if config[name] is not None:
            config[name] = list(config[name])
    config["command"] = "koap " + " ".join(sys.argv[1:])
    config["versions"] = {"python": platform.python_version()} | {
        name: importlib.metadata.version(name) for name in ("torchrl_koap", "torch", "torchrl", "tensordict", "mujoco")
    }
    if (run.path / "config.json").exists():
        if not options.resume:
            raise RunDirectoryError(f"{run.path} holds a run already; choose another --out, or --resume it")
        earlier = run.read_json("config.json")
        free = {*FREE, "command", "versions"}
        # a folder that is gone was moved, probably together with this run: there is nothing to compare with
        paths = {name: earlier.get(name) for name in ("dataset", "planner_from")}
        free |= {name for name, path in paths.items() if path not in (None, "scripted") and not Path(path).exists()}
        changed = [key for key in config if key not in free and config[key] != earlier.get(key)]
        if changed:
            raise RunDirectoryError(
                f"{run.path} was started with another {', '.join(changed)}; it cannot be resumed so"
            )
    return config
