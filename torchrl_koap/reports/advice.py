# This source code is licensed under the MIT license found in the LICENSE file.
"""What to try next, from the numbers of a run: one small function per rule, each with its reason in figures.

A rule speaks where its numbers are there and point somewhere, and is silent otherwise. What it proposes is a command
that tells more or a change that was measured to matter (``docs/results``); that it helps in this case is not known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torchrl_koap.evaluation.findings import GOOD
from torchrl_koap.reports.run_facts import RunFacts, mapping, number

APART = 0.2  # success rates that differ by more than chance of a few dozen rollouts
WIDE = 0.25  # width of a 95 % interval that hardly tells two methods apart
FEW_MODES = 0.7  # of the entropy that a uniform choice would have
FEW_LABELS = 300  # labelled transitions
CONTROLS = ("koap_untrained", "linear_steps", "linear")


@dataclass(frozen=True)
class Advice:
    """What the numbers say, what may help or tell more, and a command line, if any, with ``{run}`` or ``{data}``."""

    finding: str
    proposal: str
    command: str = ""


def advice(run: RunFacts) -> list[Advice]:
    """Returns everything that the rules have to say about a run, most telling first."""
    return [item for rule in RULES for item in [rule(run)] if item is not None]


def which_part(run: RunFacts) -> Advice | None:
    """The closed loop fails and nobody has looked where."""
    success = run.success()
    if success is None or success >= GOOD or run.experiment("both") is not None or _is_policy(run):
        return None
    finding = f"success is {_percent(success)}; whether planner or controller fails is not known"
    return Advice(finding, "let each of them work alone", "koap inspect {run}")


def planner_fails(run: RunFacts) -> Advice | None:
    """The planner does not reach the goal even when its plans come true."""
    planner = run.experiment("planner_alone")
    if planner is None or planner >= GOOD:
        return None
    return Advice(
        f"plans that come true reach the goal in {_percent(planner)} only: the planner is what fails, not the labels",
        "more updates (--steps), more demonstrations, or a wide MLP (--planner.network mlp); more labels will not help",
    )


def plans_are_not_followed(run: RunFacts) -> Advice | None:
    """Planner alone high, closed loop low: what lies between a plan and its execution."""
    planner, controller, both = (run.experiment(name) for name in ("planner_alone", "controller_alone", "both"))
    if planner is None or both is None or planner < GOOD or planner - both < APART:
        return None
    seen = f"plans alone reach the goal in {_percent(planner)}, the closed loop in {_percent(both)}"
    if controller is not None and controller < GOOD:
        return Advice(
            f"{seen}, recorded futures are followed in {_percent(controller)}: the controller is what fails",
            "more labels, those that teach the decoder most first",
            "koap suggest {run} --count 5",
        )
    return Advice(
        f"{seen}; recorded futures are followed well: executed states leave what the planner was trained on",
        "train the planner with larger disturbances (`recovery` of the task, twice the present one)",
    )


def one_way_only(run: RunFacts) -> Advice | None:
    """Low entropy of the modes."""
    entropy = run.evaluated("mode_entropy")
    entropy = run.evaluated("pooled_mode_entropy") if entropy is None else entropy
    success, even = run.success(), run.expected_entropy
    if entropy is None or not even or not success or entropy >= FEW_MODES * even:
        return None
    seen = f"the entropy of the modes is {entropy:.2f}, a uniform choice would average {even:.2f}"
    if _is_policy(run):
        return Advice(
            f"{seen}: a method without a planner knows the labelled ways only",
            "a method that plans learns the ways from all demonstrations (--method koap)",
        )
    return Advice(
        seen,
        "look at the modes of the demonstrations first; if the planner has lost some, train it longer (--steps)",
        "koap inspect {run}",
    )


def control_is_as_good(run: RunFacts) -> Advice | None:
    """A plain ridge errs no more than the method."""
    method, split = run.config.get("method"), run.evaluation.get("action_errors_on")
    errors = run.action_errors.get(split) if split else None
    own, ridge = (number((errors or {}).get(name)) for name in ("relative", "ridge_relative"))
    if own is None or ridge is None or own < ridge or method in CONTROLS:
        return None
    return Advice(
        f"actions of {method} err {own:.3g} times as much as their mean would, a plain ridge's {ridge:.3g} times",
        "the ridge is simpler; compare both in closed loop before keeping either",
        "koap curve --datasets {data} --methods koap koap_untrained linear_steps linear --out curves/compare",
    )


def few_labels(run: RunFacts) -> Advice | None:
    """Little is labelled, and it does not succeed yet."""
    labels, success = number(mapping(run.summary.get("labels")).get("labelled_transitions")), run.success()
    planner = run.experiment("planner_alone")
    if labels is None or labels >= FEW_LABELS or success is None or success >= GOOD:
        return None
    if planner is not None and planner < GOOD:  # more labels would not help
        return None
    if not str(run.config.get("method", "")).startswith("koap"):
        return None
    return Advice(
        f"{labels:,.0f} transitions are labelled",
        "a few more labels may do, where they teach the decoder most",
        "koap suggest {run} --count 5",
    )


def too_slow(run: RunFacts) -> Advice | None:
    """A plan takes longer than the robot waits."""
    plan, control = run.evaluated("plan_ms"), run.control_hz
    if plan is None or control is None or plan < 1000 / control:
        return None
    return Advice(
        f"a plan takes {plan:.0f} ms, a control step {1000 / control:.0f} ms",
        "plan in a thread (AsynchronousAgent), or less often (--replan-interval)",
        "koap latency {run}",
    )


def few_rollouts(run: RunFacts) -> Advice | None:
    """The interval of the success is wide."""
    low, high, episodes = (run.success(entry) for entry in ("low", "high", "episodes"))
    if low is None or high is None or episodes is None or high - low <= WIDE or episodes >= 60:
        return None
    return Advice(
        f"the interval of the success is {100 * (high - low):.0f} points wide with {episodes:.0f} rollouts",
        "more rollouts before anything is concluded",
        "koap eval {run} --episodes 60 --seed 100",
    )


RULES: tuple[Callable[[RunFacts], Advice | None], ...] = (
    planner_fails,
    plans_are_not_followed,
    which_part,
    few_labels,
    one_way_only,
    control_is_as_good,
    too_slow,
    few_rollouts,
)


def _is_policy(run: RunFacts) -> bool:
    """Whether the method acts without a planner, as far as the summary tells."""
    return number(run.summary.get("planner_parameters")) == 0


def _percent(rate: float) -> str:
    return f"{100 * rate:.0f} %"
