# This source code is licensed under the MIT license found in the LICENSE file.
"""What a training is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_koap.runs.plugins import Plugins
from torchrl_koap.runs.pretrained import find_run


@dataclass
class TrainConfig:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        out: run directory to write.
        task: name of the task (default: that of the data set, if it says so; else "avoiding").
        dataset: "scripted", or a folder: written by `koap demos`, `koap convert` or save_demonstrations, of D3IL raw
            pickles, or a LeRobot data set.
        label_fraction: share of the trajectories, windows or transitions that keep their actions (default: 0.02; all
            labels that there are, where data lack some or the task has no environment).
        label_count: number of them instead of a share.
        label_episodes: these trajectories instead of a random choice, as `koap suggest` names them.
        label_unit: "trajectory", "window" (the unit of the first public code) or "transition".
        seed: seed of label choice, initialisation and batches.
        observation_fraction: share of the trajectories that are used at all; those with labels come first.
        validation_fraction: share of the trajectories that the planner never sees, those without labels first, for
            `koap eval` to judge its plans by (default: 0.1 for a task without an environment, else none).
        method: "koap", "mpc" (model predictive control), "linear" (ridge on raw frames), "dd" (supervised
            inverse dynamics), "dp" (Diffusion Policy), or another name in torchrl_koap.training.methods.METHODS, those
            that plugins register included (default: that of the task).
        preset: variant of KOAP: "default", "absolute", "semi_supervised" or "paper" (default: the
            task's for its own method, else the method's).
        koopman_coeff: weight of the Koopman term in the loss, for methods that have one (default: 1).
        action_coeff: weight of the action term, for methods whose action decoder is trained with the rest (default: 1).
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest); default: the method's.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: controller updates.
        batch_size: windows per planner update (default: the denoiser's, 128 for "unet" and 512 for "mlp").
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner (default: the denoiser's, 3e-3 and 1e-3).
        controller_learning_rate: peak learning rate of the controller.
        denoiser: "unet" or "mlp" (default: the task's, else "unet").
        denoiser_width: hidden width of "mlp" (default: 512).
        precision: "float32", "bfloat16" for the matrix products of the planner's training, several times quicker where
            the processor has units for them and many times slower where not, or "auto", which looks (default: float32).
        candidates: plans sampled whenever one is due at evaluation, unless told otherwise there (default: 1).
        channels: widths of the U-Net's levels (default: the task's).
        observed_frames: frames that the planner sees, 1 or 2 (default: the task's).
        controller_state: what the controller reads, "robot" (the robot's own columns) or "all" (KOAP's configurations).
        planner_from: run directory whose planner is taken over instead of training one, or pretrained:NAME.
        episodes: number of scripted demonstrations (default: that of the task).
        threads: torch threads.
        device: "cpu" or "cuda".
        checkpoint_every: updates between two checkpoints, from which --resume goes on.
        resume: go on with an interrupted run; options left at their defaults are those it was started with.
        force_data: resume although the demonstrations, or the version of this package, are others than at the start.
        logger: "csv" (metrics.csv alone), or as well "wandb" (offline unless WANDB_MODE says otherwise) or
            "tensorboard".
        analysis: measure the action error on unlabelled demonstrations (reads labels outside the budget, afterwards).
        plugins: modules that register tasks, methods or pictures; imported before anything else, and again by whatever
            reads the run.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training import TrainConfig, train
        >>> config = TrainConfig(out=Path("runs/koap"), task="avoiding", label_fraction=0.05)
        >>> train(config)  # doctest: +SKIP
    """

    out: Path
    task: str | None = None
    dataset: str = "scripted"
    label_fraction: float | None = None
    label_count: int | None = None
    label_episodes: tuple[int, ...] | None = None
    label_unit: str = "trajectory"
    observation_fraction: float = 1.0
    validation_fraction: float | None = None
    seed: int = 0
    method: str | None = None
    preset: str | None = None
    koopman_coeff: float | None = None
    action_coeff: float | None = None
    decoder: str | None = None
    steps: int | None = None
    controller_steps: int = 500
    batch_size: int | None = None
    controller_batch_size: int = 256
    planner_learning_rate: float | None = None
    controller_learning_rate: float = 1e-3
    denoiser: str | None = None
    denoiser_width: int | None = None
    precision: str | None = None
    candidates: int | None = None
    channels: tuple[int, ...] | None = None
    observed_frames: int | None = None
    controller_state: str = "robot"
    planner_from: Path | None = None
    episodes: int | None = None
    threads: int = 1
    device: str = "cpu"
    checkpoint_every: int = 500
    resume: bool = False
    force_data: bool = False
    logger: str = "csv"
    analysis: bool = True
    plugins: Plugins = ()

    def __post_init__(self):
        self.out = Path(self.out)  # so that a string will do in Python
        self.planner_from = None if self.planner_from is None else find_run(self.planner_from)
