# This source code is licensed under the MIT license found in the LICENSE file.
"""Advice on what to try next, from the numbers of a run, each piece with its reason in figures.

A rule gives advice only if its numbers exist and are conclusive. It proposes a command that finds out more, or a change
that was measured to matter (``docs/results``); whether it helps in this case is not known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from torchrl_koap.evaluation.findings import EXPERIMENTS, GOOD
from torchrl_koap.reports.run_facts import RunFacts, entry_at

APART = 0.2  # difference of success rates that exceeds chance with a few dozen rollouts
WIDE = 0.25  # width of a 95 % interval that hardly distinguishes two methods
FEW_MODES = 0.7  # share of the entropy of a uniform choice
FEW_LABELS = 300  # labelled transitions
CONTROLS = ("koap_untrained", "linear_steps", "linear")


@dataclass(frozen=True)
class Advice:
    """A finding, a proposal, and a command line, if any, with ``{run}`` or ``{data}`` to be filled in."""

    finding: str
    proposal: str
    command: str = ""


def advice(run: RunFacts) -> Iterator[Advice]:
    """Yields all advice about a run, the most important first."""
    success, policy = run.success(), run.summary.get("planner_parameters") == 0  # a policy has no planner
    planner, controller, both = (run.experiment(name) for name in EXPERIMENTS)
    if run.evaluation.get("env") and not run.evaluation.get("success_key") and not success:
        success = None  # not defined, as for a walker or another endless task
    method, fails = run.config.get("method"), success is not None and success < GOOD
    planner_fails = planner is not None and planner < GOOD
    if planner_fails:
        yield Advice(
            f"exactly executed plans reach the goal in {_percent(planner)} only: the planner fails, not the labels",
            "more updates (--steps), more demonstrations, or a wide MLP (--planner.network mlp); more labels will not"
            " help",
        )
    elif planner is not None and both is not None and planner - both >= APART:
        seen = f"plans alone reach the goal in {_percent(planner)}, the closed loop in {_percent(both)}"
        if controller is not None and controller < GOOD:
            yield Advice(
                f"{seen}, recorded futures are followed in {_percent(controller)}: the controller fails",
                "more labels, those that teach the decoder most first",
                "koap suggest {run} --count 5",
            )
        else:
            yield Advice(
                f"{seen}; recorded futures are followed well: executed states leave the planner's training data",
                "train the planner with larger disturbances (`recovery` of the task, twice the present one)",
            )
    if fails and both is None and not policy:  # koap inspect was not run
        apart = ("test each of them alone", "koap inspect {run}")
        if run.evaluation.get("env"):  # it cannot start from recorded states
            apart = ("compare their errors on recordings", "koap eval {run} --out {run}_recorded")
        yield Advice(f"success is {_percent(success)}; whether planner or controller fails is not known", *apart)
    labels = entry_at(run.summary, "labels", "labelled_transitions")
    if fails and not planner_fails and labels is not None and labels < FEW_LABELS and str(method).startswith("koap"):
        yield Advice(
            f"{labels:,.0f} transitions are labelled",
            "a few more labels may suffice, where they teach the decoder most",
            "koap suggest {run} --count 5",
        )
    # an entropy per context is lower, since a context has few successes
    entropy, even = run.evaluation.get("pooled_mode_entropy", run.evaluation.get("mode_entropy")), run.expected_entropy
    if entropy is not None and even and entropy < FEW_MODES * even:
        seen = f"the entropy of the modes is {entropy:.2f}, a uniform choice would average {even:.2f}"
        if policy:
            yield Advice(
                f"{seen}: a method without a planner learns only from labelled demonstrations",
                "a method that plans learns the modes from all demonstrations (--method koap)",
            )
        else:
            yield Advice(
                seen,
                "look at the modes of the demonstrations first; if the planner has lost some, train it longer"
                " (--steps)",
                "koap inspect {run}",
            )
    split = run.evaluation.get("action_errors_on")
    own, ridge = (entry_at(run.action_errors, split, name) for name in ("relative", "ridge_relative"))
    if own is not None and ridge is not None and own >= ridge and method not in CONTROLS:
        yield Advice(
            f"the action error of {method} is {own:.3g} times the mean action's, of a ridge on raw frames {ridge:.3g}",
            "the ridge is simpler; compare both in closed loop before keeping either",
            "koap curve --datasets {data} --methods koap koap_untrained linear_steps linear --out curves/compare",
        )
    plan, control = run.evaluation.get("plan_ms"), run.control_hz
    if plan is not None and control is not None and plan >= 1000 / control:
        yield Advice(
            f"a plan takes {plan:.0f} ms, a control step {1000 / control:.0f} ms",
            "plan in a thread (AsynchronousAgent), or less often (--replan-interval)",
            "koap latency {run}",
        )
    found = run.rates.get("success")
    if success is not None and found and found["high"] - found["low"] > WIDE and found["episodes"] < 60:
        yield Advice(
            f"the interval of the success is {100 * (found['high'] - found['low']):.0f} points wide with"
            f" {found['episodes']:.0f} rollouts",
            "more rollouts before anything is concluded",
            "koap eval {run} --episodes 60 --seed 100",
        )


def _percent(rate: float) -> str:
    return f"{100 * rate:.0f} %"
