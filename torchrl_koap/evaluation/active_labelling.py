# This source code is licensed under the MIT license found in the LICENSE file.
r"""Active labelling: which demonstrations to label next, chosen from the latent actions alone.

The covariance :math:`C = (\sum u u^T + \lambda)^{-1}` of a linear decoder under a ridge penalty, over the labelled
steps, does not depend on the labels' values. Therefore several demonstrations can be chosen before any is labelled.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_koap.data.trajectories import labelled_episodes
from torchrl_koap.evaluation.latent_space import infer_steps
from torchrl_koap.files import option_words, some
from torchrl_koap.keys import EPISODE, HAS_ACTION
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.runs.config import given_options
from torchrl_koap.runs.device import set_up_torch, torch_as_before
from torchrl_koap.runs.plugins import Plugins
from torchrl_koap.training.trained import Trained

_MOST_STEPS = 200_000  # most steps that are read; adjacent ones are similar
_DEFAULT_COUNT = 5  # trajectories to choose
_MEAN_SPREAD = 30.0  # prior deviation of the fitted mean over that of the latent part: hardly penalised


@dataclass(frozen=True)
class Suggestion:
    """A demonstration to label, and its score when it is chosen, in units of the noise variance."""

    episode: int
    score: float


def variance_reduction(latent: Tensor, covariance: Tensor, moment: Tensor) -> float:
    """Returns how much the mean leverage over all steps falls if the steps ``[T, m]`` are labelled (A-optimal).

    ``covariance [m, m]`` is the decoder's without the noise variance, ``moment [m, m]`` the second moment of the latent
    actions of all steps.
    """
    part = _explained_part(latent, covariance)
    return ((part @ moment) * part).sum().item()


def _explained_part(latent: Tensor, covariance: Tensor) -> Tensor:
    """Returns ``P [T, m]``: labelling steps ``latent [T, m]`` subtracts ``P^T P`` from the covariance (Woodbury)."""
    projected = latent @ covariance
    inner = torch.eye(len(latent), dtype=latent.dtype, device=latent.device) + projected @ latent.mT
    return torch.linalg.solve_triangular(torch.linalg.cholesky(inner), projected, upper=False)


@torch.no_grad()
def rank_trajectories(
    latent: Tensor,
    episode: Tensor,
    labelled: Tensor,
    *,
    penalty: float,
    count: int | None = None,
    bias: bool = False,
    score: Callable[[Tensor, Tensor, Tensor], float] = variance_reduction,
) -> list[Suggestion]:
    r"""Chooses trajectories to label, one by one, each as if those before it were labelled already.

    Each choice is the trajectory whose labels lower the mean predictive variance over *all* steps the most (greedy
    Bayesian A-optimal design, weighted by the second moment of the latent actions). It prefers long demonstrations that
    resemble many others.

    Args:
        latent (Tensor): latent actions ``[N, m]``.
        episode (Tensor): trajectory of every step ``[N]``.
        labelled (Tensor): labelled steps, bool ``[N]``. Trajectories with unlabelled steps can be chosen; only those
            steps count for the choice.

    Keyword Args:
        penalty (float): ridge penalty relative to the mean square norm of the labelled latent actions (of all, if none
            is labelled), as in :class:`~torchrl_koap.modules.RidgeFit`.
        count (int, optional): number of trajectories. Default: 5, or all that are left.
        bias (bool): whether the decoder has a fitted mean.
        score (callable): score, the highest of which is chosen; arguments as for :func:`variance_reduction`.

    Returns:
        list of Suggestion: in the order of choice.

    Raises:
        ValueError: for shapes that disagree, latent actions that are not finite, a penalty that is not positive, a
            count out of range, or if every step is labelled.

    Examples:
        >>> import torch
        >>> from torchrl_koap.evaluation.active_labelling import rank_trajectories
        >>> latent = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # the last direction is unknown as yet
        >>> known = torch.tensor([True, False, False])
        >>> [choice.episode for choice in rank_trajectories(latent, torch.arange(3), known, penalty=0.1, count=2)]
        [2, 1]
    """
    if latent.ndim != 2 or episode.shape != latent.shape[:1] or labelled.shape != latent.shape[:1]:
        raise ValueError(
            "wanted latent [N, m], episode [N] and labelled [N],"
            f" got {list(latent.shape)}, {list(episode.shape)} and {list(labelled.shape)}"
        )
    if labelled.dtype != torch.bool:
        raise ValueError(f"labelled must be bool, got {labelled.dtype}")
    if not 0 < penalty < float("inf"):
        raise ValueError(f"penalty must be positive and finite, got {penalty}")
    if not latent.isfinite().all():
        raise ValueError("latent actions must be finite")
    names = episode[~labelled].unique().tolist()
    if not names:
        raise ValueError("nothing is left to suggest: every step is labelled")
    count = min(_DEFAULT_COUNT, len(names)) if count is None else count
    if not 1 <= count <= len(names):
        raise ValueError(f"count must be in 1..{len(names)}, the trajectories that are not labelled yet, got {count}")
    rows, scale = _rows(latent.double(), labelled, penalty, bias)
    known = rows[labelled]
    precision = known.mT @ known + scale * torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    covariance = torch.cholesky_inverse(torch.linalg.cholesky(precision))
    moment = rows.mT @ rows / len(rows)
    order = episode[~labelled].argsort(stable=True)
    lengths = episode[~labelled].unique(return_counts=True)[1].tolist()
    left = dict(zip(names, rows[~labelled][order].split(lengths), strict=True))
    chosen = []
    for _ in range(count):
        scores = {name: score(part, covariance, moment) for name, part in left.items()}
        best = max(scores, key=scores.__getitem__)
        part = _explained_part(left.pop(best), covariance)
        covariance = covariance - part.mT @ part
        chosen.append(Suggestion(best, scores[best]))
    return chosen


def _rows(latent: Tensor, labelled: Tensor, penalty: float, bias: bool) -> tuple[Tensor, Tensor]:
    """Returns latent actions, with a column for a fitted mean, and the ridge penalty in their squared units."""
    reference = latent[labelled] if labelled.any() else latent
    if bias:
        latent, reference = latent - reference.mean(0), reference - reference.mean(0)
    unit = reference.square().sum(-1).mean()
    unit = torch.where(unit > 0, unit, torch.ones_like(unit))  # all (centred) latent actions are 0: any scale will do
    if bias:
        latent = torch.cat([latent, (_MEAN_SPREAD * unit.sqrt()).expand(len(latent), 1)], -1)
    return latent, penalty * unit


@dataclass
class SuggestConfig:
    """Which unlabelled demonstrations of a trained run to label next; no label outside the budget is read.

    Attributes:
        count: demonstrations to suggest (default: 5, or all that are left).
        dataset: where the data set of the training is now (default: where it was).
        plugins: modules that register tasks or methods, besides those that the run was trained with.
    """

    count: int | None = None
    dataset: str | None = None
    plugins: Plugins = ()


@torch_as_before()
def suggest(run: str | Path, config: SuggestConfig | None = None) -> dict[str, Any]:
    """Ranks the unlabelled demonstrations of a run.

    Args:
        run (str or Path): a run directory.
        config (SuggestConfig, optional): the options.

    Returns:
        dict: the contents of ``suggestions.json``: ``penalty`` of the run's decoder; ``labelled_steps`` and
        ``labelled_episodes`` so far; ``suggestions``, best first, with ``rank``, ``episode``, ``steps`` to label,
        ``score`` and, where known, ``source``; ``next``, a command line that trains with them.

    Raises:
        ValueError: for a count out of range, or a run without latent actions or a decoder in closed form.
        RunDirectoryError: if the folder is no finished run, or its demonstrations are missing or changed.

    Examples:
        >>> from torchrl_koap.evaluation import SuggestConfig, suggest
        >>> suggest("runs/koap", SuggestConfig(count=3))["suggestions"]  # doctest: +SKIP
    """
    config = given_options(config, SuggestConfig)
    set_up_torch(1, "cpu")
    trained = Trained.load(run, plugins=config.plugins)
    controller = trained.controller
    if not isinstance(controller, KoopmanInverseDynamics):
        raise ValueError(
            f"{trained.folder} was trained with method {trained.config.method!r}: suggestions need latent actions,"
            " method 'koap'"
        )
    penalty = trained.results.get("decoder_fit", {}).get("penalty")
    if penalty is None:
        raise ValueError(
            f"the decoder of {trained.folder} was not fitted in closed form, so its uncertainty is unknown:"
            " train with `--method koap`"
        )
    recorded = trained.data(config.dataset)
    data, report = trained.hide_labels(recorded)
    each = -(-len(data) // _MOST_STEPS)  # number of steps that each inferred step represents
    steps = infer_steps(controller, trained.seen(data), every=each)
    ranked = rank_trajectories(
        steps["latent_action"],
        steps[EPISODE],
        steps[HAS_ACTION],
        penalty=penalty / each,
        count=config.count,
        bias=bool(controller.action_decoder.linear.bias.any()),
    )
    choices = [replace(choice, score=choice.score / each) for choice in ranked]
    unlabelled = data[EPISODE][~data[HAS_ACTION].squeeze(-1)]
    names = trained.names(data, config.dataset)
    rows = [
        {"rank": rank, "steps": int((unlabelled == choice.episode).sum()), **asdict(choice)}
        | ({"source": names[choice.episode]} if names else {})
        for rank, choice in enumerate(choices, 1)
    ]
    labelled = labelled_episodes(data).tolist()
    every = list(dict.fromkeys([*labelled, *(choice.episode for choice in choices)]))
    more = recorded[EPISODE][(recorded[HAS_ACTION] & ~data[HAS_ACTION]).squeeze(-1)].unique().tolist()
    without = [choice.episode for choice in choices if choice.episode not in more]  # no recorded action is hidden
    converted = f"convert them again (--name {shlex.quote(trained.task.name)} --out DATA)"
    which = some([names[episode] for episode in without] if names else without)
    counted = "" if names else " (counted from 0; files in the order of their names, run_10 before run_2)"
    first = f"add actions to recordings {which}{counted} and {converted}, then " if without else ""
    again = {
        "config": trained.folder / "config.json",
        "dataset": "DATA" if without else config.dataset,
        "plugins": config.plugins,
        "labels.unit": None if trained.config.labels.unit == "trajectory" else "trajectory",
        # a share may be too few
        "labels.trajectories": None if trained.config.labels.trajectories == 1 else 1,
        "planner.source": trained.folder,  # the planner uses no labels
        "labels.episodes": every,
    }
    return {
        "penalty": penalty,
        "labelled_steps": report.labelled_transitions,
        "labelled_episodes": labelled,
        "suggestions": rows,
        "next": f"{first}{shlex.join(['koap', 'train', *option_words(again)])} --out NEW",
    }
