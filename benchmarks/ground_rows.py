# This source code is licensed under the MIT license found in the LICENSE file.
"""Pools scores of the proving grounds; makes their table and picture for the README and the page of results."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from scipy.stats import spearmanr
from tables import METHOD_NAMES, fact, percent, read_rows, table

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.reports.style import BLUE, GREEN, INK, MUTED, ORANGE, PALE_BLUE, tidy

TITLES = {
    "pusht": "Push-T",
    "pusht_pixels": "Push-T from pixels",
    "adroit_door": "Adroit door",
    "meta_world_assembly": "Meta-World assembly",
    "meta_world_bin-picking": "Meta-World bin-picking",
    "meta_world_peg-insert-side": "Meta-World peg-insert-side",
    "meta_world_shelf-place": "Meta-World shelf-place",
    "meta_world_pick-place": "Meta-World pick-place",
    "unitree_g1": "Unitree G1",
}
COMPARED = {  # methods with the colours of their bars
    "koap": BLUE,
    "koap_untrained": PALE_BLUE,
    "linear_steps": ORANGE,
    "dd_lookahead": GREEN,
    "dd": "#9fd3ad",
    "vpt": "#b39ddb",
    "dp": MUTED,
}
ONE_SEED = "\N{DAGGER}"  # marks a score with fewer training seeds than its row states
STEP = 0.9 / len(COMPARED)  # distance of neighbouring bars


@dataclass(frozen=True)
class Score:
    """Score of a method on a ground, pooled over all training seeds.

    Args:
        seeds (int): training seeds.
        n (int): rollouts or recordings over all seeds.
        successes (int): successful rollouts.
        reward (float, optional): mean largest reward.
        error (float): standard error of that mean.
        plan, action (float, optional): plan error relative to standing still, action error relative to a ridge.
    """

    seeds: int
    n: int
    successes: int
    reward: float | None
    error: float
    plan: float | None
    action: float | None

    @property
    def interval(self) -> tuple[float, float, float]:
        """Returns the mean largest reward, or else the success rate, with its 95 % interval."""
        if self.reward is not None:
            return self.reward, self.reward - 1.96 * self.error, self.reward + 1.96 * self.error
        return self.successes / self.n, *wilson_interval(self.successes, self.n)

    @property
    def text(self) -> str:
        """Formats the score."""
        if self.reward is not None:
            return f"{self.reward:.2f}"
        if self.plan is not None or self.action is not None:
            return " / ".join("none" if share is None else f"{share:.2f}" for share in (self.action, self.plan))
        return percent({"successes": self.successes, "n": self.n}, 0)


def ground_score(ground: str, method: str, labels: int | None = None) -> Score | None:
    """Pools the rows of a method on a ground with default execution; None without rows.

    Args:
        ground (str): its name.
        method (str): a name of ``koap methods``.
        labels (int, optional): number of labelled demonstrations. Default: :func:`usual_labels`.
    """
    named = {"ground": ground, "method": method, "execution": "default", "labels": labels or usual_labels(ground)}
    rows = read_rows("proving_grounds", **named)
    if not rows:
        return None

    def mean(column: str) -> float | None:
        values = [float(row[column]) for row in rows if row[column]]
        return sum(values) / len(values) if values else None

    return Score(
        seeds=len(rows),
        n=sum(int(row["n"]) for row in rows),
        successes=sum(int(row["successes"] or 0) for row in rows),
        reward=mean("largest_reward"),
        error=sum(float(row["standard_error"] or 0) ** 2 for row in rows) ** 0.5 / len(rows),
        plan=mean("plan_error"),
        action=mean("action_error"),
    )


def usual_labels(ground: str) -> int:
    """Returns the number of labelled demonstrations in most trainings on a ground."""
    counts = Counter(int(row["labels"]) for row in read_rows("proving_grounds", ground=ground))
    return counts.most_common(1)[0][0]


def ground_text(ground: str, method: str, labels: int | None = None) -> str:
    """Formats :func:`ground_score`; "not run" if there is none."""
    score = ground_score(ground, method, labels)
    return "not run" if score is None else score.text


def grounds_table() -> str:
    """Formats a row per ground, a column per method."""
    published = {row["key"] for row in read_rows("facts")}
    body = []
    for ground, title in TITLES.items():
        scores = [ground_score(ground, method) for method in COMPARED]
        first = next(score for score in scores if score is not None)
        key = f"{ground}_published_mean"
        row = [title, str(usual_labels(ground)), f"{first.seeds} x {first.n // first.seeds}"]
        row += [_beside(score, first.seeds) for score in scores]
        body.append([*row, fact(key) if key in published else "none"])
    heads = [METHOD_NAMES[method] for method in COMPARED]
    return table(["benchmark", "labelled", "training seeds x n", *heads, "published, all labels"], body)


def _beside(score: Score | None, seeds: int) -> str:
    """Formats a cell and marks a score with fewer than ``seeds`` training seeds."""
    if score is None:
        return "not run"
    return score.text + ONE_SEED * (score.seeds < seeds)


def rank_correlations() -> str:
    """Formats rank correlations of each score in ``planner_scores.csv`` with failures, for every ground and seed."""
    rows, body = read_rows("planner_scores"), []
    for name, seed in dict.fromkeys((row["ground"], row["seed"]) for row in rows):
        cells = [row for row in rows if (row["ground"], row["seed"]) == (name, seed)]
        failures = [int(row["n"]) - int(row["successes"]) for row in cells]
        scores = [[float(row[kind]) for row in cells] for kind in ("plan_score", "energy_score")]
        found = [f"{spearmanr(score, failures)[0]:.2f}" for score in scores]
        body.append([name, seed, str(len(cells)), *found])
    return table(["benchmark", "training seed", "planners", "plan score", "energy score alone"], body)


def draw_grounds(path: Path) -> Path:
    """Draws bars of every method per ground: scores of rollouts, and errors on recordings.

    Args:
        path (Path): png to write.
    """
    rolled = [ground for ground in TITLES if (score := ground_score(ground, "koap")) and score.plan is None]
    judged = [ground for ground in TITLES if ground not in rolled]
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[max(2, len(rolled)), 2 * max(1, len(judged))])
    left.set(ylim=(0, 1.12), ylabel="largest reward, or success")
    right.set(ylim=(0, 1.6), ylabel="error on recordings")
    for number, (method, color) in enumerate(COMPARED.items()):
        for place, ground in enumerate(rolled):
            score = ground_score(ground, method)
            if score is not None:
                _bar(left, place + STEP * number, *score.interval, color, METHOD_NAMES[method])
        for place, ground in enumerate(judged):
            score = ground_score(ground, method)
            for step, share in enumerate(() if score is None else (score.action, score.plan)):
                if share is not None:
                    _bar(right, 2 * place + step + STEP * number, share, share, share, color, METHOD_NAMES[method])
    texts = [f"{TITLES[ground].replace(' ', chr(10), 1)}\n{usual_labels(ground)} labelled" for ground in rolled]
    left.set_xticks([place + 0.4 for place in range(len(rolled))], texts, fontsize=8)
    kinds = ("actions,\nridge = 1", "plans,\nstanding still = 1")
    texts = [f"{TITLES[ground]}\n{kind}" for ground in judged for kind in kinds]
    right.set_xticks([place + 0.4 for place in range(len(texts))], texts, fontsize=8)
    right.axhline(1, color=MUTED, linewidth=0.7, linestyle=":")
    handles = {text: handle for handle, text in zip(*left.get_legend_handles_labels(), strict=True)}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=len(COMPARED), frameon=False, fontsize=9
    )
    for axes in (left, right):
        tidy(axes)
    figure.savefig(path, dpi=130, facecolor="white", metadata={"Software": None})
    return path


def _bar(axes, place: float, mean: float, low: float, high: float, color: str, name: str) -> None:
    axes.bar(place, mean, width=0.9 * STEP, color=color, label=name)
    axes.plot([place, place], [low, high], color=INK, linewidth=1)
    top = min(high, 0.9 * axes.get_ylim()[1])  # the number of a bar that exceeds the axis is drawn inside the bar
    ink = INK if top == high else "white"
    axes.annotate(f"{mean:.2f}", (place, top), ha="center", va="bottom", fontsize=6, color=ink, rotation=90)
