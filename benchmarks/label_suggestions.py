# This source code is licensed under the MIT license found in the LICENSE file.
"""Compares action errors after labelling suggested demonstrations with those after labelling random ones.

    python benchmarks/label_suggestions.py --dataset DIR

The Koopman model is trained once, without labels. For every seed, one random trajectory is labelled first. Each
criterion then chooses further ones, and the decoder is fitted to the labels in closed form. Action errors are measured
on the trajectories that no criterion chose. "longest" ranks by length alone and so isolates the effect of more labels
per demonstration. The interval is that of the mean paired difference to random choices over the seeds (Student's t).
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch
from tables import t_interval
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import cut_windows, make_window_buffer, open_dataset
from torchrl_koap.evaluation.active_labelling import rank_trajectories, variance_reduction
from torchrl_koap.evaluation.latent_space import infer_steps
from torchrl_koap.modules import PRESETS, KoopmanInverseDynamics, Normalizer
from torchrl_koap.objectives import KOAPLoss
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.tasks import WINDOW, Task, get_task
from torchrl_koap.training.closed_form import action_facts, fit_closed_form
from torchrl_koap.training.loop import train_phase
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller
from torchrl_koap.training.policy_facts import controller_data

CHOICES = ("a_optimal", "uncertainty", "random", "longest")


def within(data: TensorDictBase, episodes: list[int]) -> TensorDictBase:
    """Returns the data with labels for the given trajectories only; all other actions are NaN."""
    has_action = torch.isin(data["episode"], torch.tensor(episodes))[:, None]
    hidden = torch.where(has_action, data["action"], torch.nan)
    return data.clone().update({"has_action": has_action, "action": hidden})


def train_unlabelled(data: TensorDictBase, task: Task, preset: str, updates: int) -> KoopmanInverseDynamics:
    """Trains the Koopman model of `koap train` on states alone."""
    torch.manual_seed(0)
    # the labels of trajectory 0 set only the action normaliser, which is replaced before every fit
    controller = build_controller(task, get_method("koap"), ControllerConfig(preset, 0, "robot"), within(data, [0]))
    window = max(WINDOW, controller.num_window_frames)
    history = controller.num_past
    controller.prepare(cut_windows(data, window, select=["state"], pad_before=history)["state"])
    keys = ["state", "action", "has_action"]
    buffer = make_window_buffer(within(data, []), window, 256, select=keys, pad_before=history)
    loss = KOAPLoss(controller, action_coeff=0.0)
    train_phase("controller", loss, buffer.sample, num_steps=updates, learning_rate=1e-3, weight_decay=1e-3)
    return controller.eval()


def error_of(
    controller: KoopmanInverseDynamics, task: Task, mode: str, labelled: TensorDictBase, test: TensorDictBase
) -> float:
    """Returns the action error on steps ``test`` (:func:`infer_steps`) of a decoder fitted to labelled data."""
    normalizer = Normalizer.fit(labelled["action"], mode=mode, mask=labelled["has_action"])
    controller.action_normalizer.load_state_dict(normalizer.state_dict())
    fit_closed_form(controller, labelled, **action_facts(task, task.controller_columns("robot")))
    with torch.no_grad():
        decoded = controller.raw_action(controller.decode(test["latent_action"]))
        return 1e3 * (decoded - test["action"]).square().mean().sqrt().item()


def uncertainty(latent: Tensor, covariance: Tensor, moment: Tensor) -> float:
    """Returns the mean leverage of a demonstration's steps, which grows with the decoder's uncertainty."""
    return ((latent @ covariance) * latent).sum(-1).mean().item()


def chosen_by(criterion: str, steps: TensorDictBase, first: int, count: int, seed: int) -> list[int]:
    """Returns the first trajectory and those that a criterion adds."""
    labelled = steps["episode"] == first
    if criterion == "random":
        names = steps["episode"][~labelled].unique()
        drawn = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed))[: count - 1]
        return [first, *names[drawn].tolist()]
    if criterion == "longest":
        names, lengths = steps["episode"][~labelled].unique(return_counts=True)
        return [first, *names[lengths.argsort(descending=True)][: count - 1].tolist()]
    ranked = rank_trajectories(
        steps["latent_action"],
        steps["episode"],
        labelled,
        penalty=PRESETS["default"]["penalty"],
        count=count - 1,
        score=uncertainty if criterion == "uncertainty" else variance_reduction,
    )
    return [first, *(choice.episode for choice in ranked)]


def row(criterion: str, budget: int, labels: list[int], errors: list[float], random: list[float]) -> str:
    """Formats one line of the table."""
    mean, spread = statistics.fmean(errors), f"({min(errors):.3f}-{max(errors):.3f})"
    text = f"{budget:>6}  {criterion:<9} {statistics.fmean(labels):>6.0f}  {mean:6.3f} {spread}"
    if criterion == "random" or budget == 1:
        return text
    differences = [error - other for error, other in zip(errors, random, strict=True)]
    return text + "  {:+.3f} ({:+.3f} to {:+.3f})".format(*t_interval(differences))


def main() -> None:
    """Trains once, chooses labels and fits for every seed, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="scripted", help="folder of `koap demos`, or 'scripted': record 96")
    parser.add_argument("--task", default="avoiding")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--updates", type=int, default=500)
    parser.add_argument("--budgets", type=int, nargs="+", default=[1, 2, 3, 5, 8], help="labelled trajectories")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_up_torch(arguments.threads, "cpu")
    task = get_task(arguments.task)
    data = open_dataset(arguments.dataset, task=task)[0]
    data = controller_data(task, ControllerConfig(columns="robot"), data)
    began = time.perf_counter()
    controller = train_unlabelled(data, task, arguments.preset, arguments.updates)
    steps = infer_steps(controller, data)
    print(f"{len(steps)} steps, trained in {time.perf_counter() - began:.0f} s")

    mode = PRESETS[arguments.preset]["normalization"]["action"]
    errors: dict[tuple[str, int], list[float]] = {}
    labels: dict[tuple[str, int], list[int]] = {}
    names = steps["episode"].unique()
    for seed in range(arguments.seeds):
        first = names[torch.randint(len(names), (), generator=torch.Generator().manual_seed(seed))].item()
        most = max(arguments.budgets)
        sets = {criterion: chosen_by(criterion, steps, first, most, seed) for criterion in CHOICES}
        test = steps[~torch.isin(steps["episode"], torch.tensor(sum(sets.values(), [])))]
        for criterion, episodes in sets.items():
            for budget in arguments.budgets:
                error = error_of(controller, task, mode, within(data, episodes[:budget]), test)
                errors.setdefault((criterion, budget), []).append(error)
                number = int(torch.isin(steps["episode"], torch.tensor(episodes[:budget])).sum())
                labels.setdefault((criterion, budget), []).append(number)
    print(f"{'chosen':>6}  {'criterion':<9} {'labels':>6}  {'error mm (range)':<22}  difference to random (95 %)")
    for budget in arguments.budgets:
        for criterion in CHOICES:
            cell = criterion, budget
            print(row(criterion, budget, labels[cell], errors[cell], errors["random", budget]))
    print(f"{arguments.seeds} seeds, {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
