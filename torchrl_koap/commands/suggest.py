# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap suggest``: which demonstrations a person should label next."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.data import LabelBudget, controller_view
from torchrl_koap.evaluation.active_labelling import CRITERIA, rank_trajectories
from torchrl_koap.evaluation.latent_space import infer_steps
from torchrl_koap.evaluation.run import columns_of, load_run
from torchrl_koap.keys import EPISODE, HAS_ACTION
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.tasks import HISTORY, WINDOW
from torchrl_koap.training.builders import load_demonstrations, set_up_torch
from torchrl_koap.training.run_directory import RunDirectory


@dataclass
class Suggest:
    """Say which unlabelled demonstrations of a trained run to label next; no label outside the budget is read.

    Attributes:
        run: run directory of `koap train`.
        count: demonstrations to suggest.
        criterion: "gain" (lowers the decoder's mean uncertainty the most), "variance" (the decoder is least certain
            about it) or "random".
        seed: seed of "random".
        threads: torch threads.
    """

    run: tyro.conf.Positional[Path]
    count: int = 5
    criterion: str = "gain"
    seed: int = 0
    threads: int = 1


@dataclass(frozen=True)
class SuggestedLabels:
    """What ``suggestions.json`` holds; printed as a table.

    Args:
        criterion (str): how they were chosen.
        penalty (float): ridge of the run's decoder.
        labelled_steps (int): labels of the run that the choice builds on.
        labelled_episodes (list of int): trajectories with a label in the run.
        suggestions (list of dict): ``rank``, ``episode``, ``steps`` to label and ``score``, best first.
    """

    criterion: str
    penalty: float
    labelled_steps: int
    labelled_episodes: list[int]
    suggestions: list[dict[str, Any]]

    def __str__(self) -> str:
        lines = [f"{'rank':>4}  {'episode':>7}  {'steps':>5}  {self.criterion:>10}"]
        for row in self.suggestions:
            score = "-" if row["score"] is None else f"{row['score']:.4g}"
            lines.append(f"{row['rank']:>4}  {row['episode']:>7}  {row['steps']:>5}  {score:>10}")
        every = [*self.labelled_episodes, *(row["episode"] for row in self.suggestions)]
        lines.append(f"with these labelled: koap train --label-episodes {' '.join(map(str, every))} ...")
        return "\n".join(lines)


def budget_of(run: RunDirectory) -> LabelBudget:
    """The label budget that a run was trained with."""
    episodes = run.read_json("config.json").get("label_episodes")
    if episodes is not None:
        return LabelBudget.of_episodes(episodes)
    names = ("label_count", "label_fraction", "label_unit", "seed")
    count, fraction, unit, seed = (run.read_entry("config.json", name) for name in names)
    return LabelBudget(fraction if count is None else count, unit=unit, seed=seed, window=WINDOW, history=HISTORY)


def run_suggest(options: Suggest) -> SuggestedLabels:
    """Ranks the unlabelled demonstrations of a run; writes ``suggestions.json``.

    Raises:
        ValueError: for an unknown criterion, a count out of range, a run without latent actions or whose decoder was
            not fitted in closed form, or demonstrations that are not those of the training any more.
        RunDirectoryError: if the folder is no finished run.
    """
    lookup(CRITERIA, options.criterion, "criterion")
    set_up_torch(options.threads, "cpu")
    run = RunDirectory(options.run)
    task, _, controller = load_run(run)
    if not isinstance(controller, KoopmanInverseDynamics):
        method = run.read_entry("config.json", "method")
        raise ValueError(
            f"{run.path} was trained with method {method!r}: suggestions need latent actions, method 'koap'"
        )
    penalty = run.read_entry("summary.json", "decoder_fit").get("penalty")
    if penalty is None:
        raise ValueError(
            f"the decoder of {run.path} was not fitted in closed form and knows no uncertainty:"
            " train with `--decoder ridge`"
        )
    dataset, episodes = (run.read_entry("config.json", name) for name in ("dataset", "episodes"))
    data = load_demonstrations(dataset, task, episodes=episodes)
    # from here on everything outside the budget is NaN
    data, report = budget_of(run).apply(data, command=task.command_columns)
    recorded = run.read_entry("summary.json", "labels")  # runs of older versions name fewer facts
    if {name: report.as_dict().get(name) for name in recorded} != recorded:
        raise ValueError(f"the demonstrations of {dataset!r} are not those that {run.path} was trained on")
    steps = infer_steps(controller, controller_view(data, columns_of(run, task)))
    choices = rank_trajectories(
        steps["latent_action"],
        steps[EPISODE],
        steps[HAS_ACTION],
        penalty=penalty,
        criterion=options.criterion,
        count=options.count,
        bias=bool(controller.action_decoder.mean_leverage),
        seed=options.seed,
    )
    unlabelled = data[EPISODE][~data[HAS_ACTION].squeeze(-1)]
    rows = [
        {
            "rank": rank,
            "episode": choice.episode,
            "steps": int((unlabelled == choice.episode).sum()),
            "score": choice.score,
        }
        for rank, choice in enumerate(choices, 1)
    ]
    labelled = data[EPISODE][data[HAS_ACTION].squeeze(-1)].unique().tolist()
    result = SuggestedLabels(options.criterion, penalty, report.labelled_transitions, labelled, rows)
    run.write_json("suggestions.json", asdict(result))
    return result
