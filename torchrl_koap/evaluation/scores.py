# This source code is licensed under the MIT license found in the LICENSE file.
"""Computes the numbers that D3IL reports per task from rollouts, each with its interval.

Success rates get Wilson intervals. Entropies get percentile intervals of a bootstrap over independent units: episodes
if all start alike, otherwise contexts with all their rollouts.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from tensordict import TensorDict

from torchrl_koap.evaluation.statistics import bootstrap_interval, conditional_entropy, mode_entropy, rate
from torchrl_koap.keys import COLLISION, FAILED, MODE, SUCCESS
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Modes, Task


def outcome_of(episode: TensorDict) -> str:
    """Returns ``"success"``, ``"collision"``, ``"error"`` or ``"timeout"``, from the last frame of an episode."""
    last = episode[-1]["next"]
    ends = {"error": FAILED, "success": SUCCESS, "collision": COLLISION}
    return next((name for name, key in ends.items() if key in last.keys() and last[key].item()), "timeout")


def score(
    episodes: Sequence[TensorDict], seeds: Sequence[int], modes: Modes, *, contexts: Sequence[int] | None = None
) -> dict[str, Any]:
    """Returns success (``rates``) with its 95 % interval, entropy of the modes of successes, and a row per episode.

    Modes and collisions are reported if there are any. ``episodes`` come from
    :func:`~torchrl_koap.evaluation.rollouts.roll_out`, ``seeds`` are theirs.

    ``contexts`` holds the number of the context of every episode. With it, ``mode_entropy`` is the mean over contexts
    (None below two rollouts per context) and ``pooled_mode_entropy`` that of all successful episodes together.
    """
    rows: list[dict[str, Any]] = [
        {"seed": seed, "outcome": outcome_of(episode), "steps": len(episode)}
        for seed, episode in zip(seeds, episodes, strict=True)
    ]
    success = rate([row["outcome"] == "success" for row in rows])
    result: dict[str, Any] = {"episodes": len(rows), "rates": {"success": success}}
    if contexts is not None:
        for row, context in zip(rows, contexts, strict=True):
            row["context"] = int(context)
        result["contexts"] = len({row["context"] for row in rows})
    if modes.number > 1:
        for row, episode in zip(rows, episodes, strict=True):
            row["mode"] = int(modes.index_of(episode[-1]["next", MODE]))
        result |= _mode_scores(rows, modes, result.get("contexts"))
    if any(COLLISION in episode["next"].keys() for episode in episodes):
        result["collisions"] = sum(row["outcome"] == "collision" for row in rows)
    return result | {"mean_steps": statistics.fmean(row["steps"] for row in rows), "episode": rows}


def _mode_scores(rows: Sequence[dict[str, Any]], modes: Modes, contexts: int | None) -> dict[str, float | None]:
    won = [row for row in rows if row["outcome"] == "success" and row["mode"] >= 0]
    taken = [row["mode"] for row in won]
    found: dict[str, float | None] = {"mode_entropy": None}
    if contexts is not None and len(rows) >= 2 * contexts:
        groups: dict[int, list[int]] = {row["context"]: [] for row in rows}
        for row in won:
            groups[row["context"]].append(row["mode"])
        unsolved = "zero" if modes.entropy == "contexts" else "skip"
        conditional = partial(conditional_entropy, num_modes=modes.number, unsolved=unsolved)
        found |= _entropy("mode_entropy", list(groups.values()), conditional)
    pooled = partial(mode_entropy, num_modes=modes.number)
    found |= _entropy("mode_entropy" if contexts is None else "pooled_mode_entropy", taken, pooled)
    return found | {"distinct_modes": len(set(taken))}


def _entropy(name: str, units: Sequence, statistic: Callable) -> dict[str, float | None]:
    value = statistic(units) if len(units) else None  # undefined without successes
    # resamples of a single unit never differ
    interval = (None, None) if value is None or len(units) < 2 else bootstrap_interval(units, statistic)
    low, high = (None if end is None else min(max(end, 0.0), 1.0) for end in interval)
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def task_scores(
    task: Task, result: dict[str, Any], episodes: Sequence[TensorDict], contexts: Sequence[int] | None
) -> dict[str, Any]:
    """Adds the results of the function that ``Task.score`` names to those of :func:`score`.

    If the function returns ``rates``, a dict from names in words to a bool per rollout, they join the success in
    ``rates``, with intervals.
    """
    rule = resolve(task.score, f"score of task {task.name!r}")
    found = {} if rule is None else dict(rule(result, episodes, contexts))
    rates = {name: rate(good) for name, good in found.pop("rates", {}).items()}
    return result | found | {"rates": result["rates"] | rates}


def stacking_scores(result: dict[str, Any], episodes: Sequence[TensorDict], contexts: Sequence[int]) -> dict[str, Any]:
    """Returns as ``rates`` whether one or more, and two or more boxes reached the zone in rollouts of Stacking."""
    stacked = [int((episode[-1]["next", MODE] >= 0).sum()) for episode in episodes]
    least = {"one box stacked": 1, "two boxes stacked": 2}
    return {"rates": {name: [count >= number for count in stacked] for name, number in least.items()}}
