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
        method: "koap", "koap_mpc" (plans followed by prediction), "linear" (ridge on raw frames), "dd" (supervised
            inverse dynamics), "dp" (Diffusion Policy), or another name in torchrl_koap.training.methods.METHODS, those
            that plugins register included (default: that of the task).
        preset: variant of KOAP: "default", "semi_supervised", "paper" or "released" (default: the
            task's for its own method, else the method's).
        koopman_coeff: weight of the Koopman term in the loss, for methods that have one (default: 1).
        action_coeff: weight of the action term, for methods whose action decoder is trained with the rest (default: 1).
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest); default: the method's.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: controller updates.
        batch_size: windows per planner update (default: 128, or the task's).
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner (default: 3e-3, or the task's).
        controller_learning_rate: peak learning rate of the controller.
        denoiser: "unet", "mlp", "film" (an mlp that the condition also scales and shifts), "transformer" or "released"
            (11.9 M parameters).
        denoiser_width: hidden width of "mlp" and "transformer" (default: 256 and 64).
        denoiser_depth: their number of residual layers (default: 3).
        condition_octaves: octaves of the Fourier features of what was observed (default: 4).
        dropout: share of the hidden units of "mlp" dropped in training (default: 0).
        planner_weight_decay: decoupled weight decay of the planner (default: 1e-4).
        first_steps_weight: weight of the first planned step in the planner's loss against the last one's (default: 1).
        precision: "float32", "bfloat16" for the matrix products of the planner's training, several times quicker where
            the processor has units for them and many times slower where not, or "auto", which looks (default: float32).
        candidates: plans sampled whenever one is due at evaluation, unless told otherwise there (default: 1).
        channels: widths of the U-Net's levels (default: the task's).
        schedule: "squared_cosine", "linear" or "flow".
        prediction: "sample", "epsilon" or "velocity".
        relative: plan displacements from the current state instead of states (default: the task's).
        forecast: plan deviations from a linear forecast, which carries over to goals not demonstrated (default: for a
            task without an environment).
        frame: object from which the planner sees everything, such as "target": tasks whose place on the table does not
            matter; "world" for none (default: the task's).
        plan_steps: frames of the plan that are modelled, counted from 1, such as 1 2 3 4 6 8 11 14; those in between
            lie on straight lines, and the last one is the horizon (default: all of 14).
        observed_frames: frames that the planner sees, 1 or 2 (default: the task's).
        relations: tell the planner where the tool is as seen from the objects (tasks with objects).
        controller_state: what the controller reads, "robot" (the robot's own columns) or "all" (KOAP's configurations).
        recovery_sigma: typical shift of the recovery augmentation in m or rad (default: the task's); 0 turns it off.
        recovery_response: how the augmentation leads back, "first_order" at once or "second_order" from rest, which
            robots that follow their commands late can do (default: the task's).
        gripper_recovery: share of the windows with open fingers that are shown with fingers closed on nothing, which
            open again; for tasks with a gripper (default: 0.1); 0 turns it off.
        neighbor_recovery: farthest share of the way to the nearest other window of a batch that windows are moved, and
            come back, for states without a column that is a position, such as embeddings (default: the task's, else
            none); 0 turns it off.
        scene_shift: typical displacement (m) of whole scenes, for tasks whose place on the table does not matter.
        scene_turn: typical angle (rad) by which such scenes are turned.
        exchange: exchange objects that are alike.
        solver: solver used at evaluation unless told otherwise.
        solver_steps: its number of steps.
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
    denoiser_depth: int | None = None
    condition_octaves: int | None = None
    dropout: float | None = None
    planner_weight_decay: float | None = None
    first_steps_weight: float | None = None
    precision: str | None = None
    candidates: int | None = None
    channels: tuple[int, ...] | None = None
    schedule: str = "squared_cosine"
    prediction: str = "sample"
    relative: bool | None = None
    forecast: bool | None = None
    frame: str | None = None
    plan_steps: tuple[int, ...] | None = None
    observed_frames: int | None = None
    relations: bool = True
    controller_state: str = "robot"
    recovery_sigma: float | None = None
    recovery_response: str | None = None
    gripper_recovery: float | None = None
    neighbor_recovery: float | None = None
    scene_shift: float = 0.05
    scene_turn: float = 0.3
    exchange: bool = True
    solver: str = "dpm++2m"
    solver_steps: int = 10
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
