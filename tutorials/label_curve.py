# This source code is licensed under the MIT license found in the LICENSE file.
"""
A label curve on a cluster of two workers
=========================================

**What you will learn**

* how to train methods, shares of labels and seeds on several workers,
* how to read the table: intervals and paired differences.

Run it with ``python tutorials/label_curve.py``; it writes ``label_curve.png``. With ``ray`` installed (``pip install
'torchrl_koap[ray]'``) the trainings are tasks of a Ray cluster on this machine, else local processes. The results are
the same.
"""

# %%
# A small curve
# -------------
# Three methods, two shares of labels and two seeds make twelve trainings, called cells. Each seed has a planner. Few
# updates and rollouts keep the time to minutes. ``koap curve`` has options of the same names.

import importlib.util
import tempfile
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_koap import ControllerConfig, EvalConfig, PlannerConfig
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.studies import Machines, Study, run_study

if __name__ == "__main__":  # workers import this file
    launcher = "ray" if importlib.util.find_spec("ray") else "local"
    study = Study(
        out=Path(tempfile.mkdtemp()) / "curve",
        methods=("koap", "koap_untrained", "linear"),
        labels=(0.025, 0.1),
        seeds=2,
        record=40,
        planner=PlannerConfig(steps=600),
        controller=ControllerConfig(steps=100),
        evaluation=EvalConfig(episodes=12),
    )
    machines = Machines(workers=2, launcher=launcher)
    result = run_study(study, machines)
    print(f"launcher {launcher}: {result.counts['done']} cells done, {result.counts['failed']} failed")

    # %%
    # Another call with the same folder runs only missing cells; now there are none. More labels would add cells.

    again = run_study(study, machines).counts
    print(f"called again: {again['done']} done, {again['missing']} missing")

    # %%
    # The table
    # ---------
    # Seeds are pooled: 24 rollouts per entry. Intervals are up to forty points wide, so only large differences are
    # significant here. ``comparisons.csv`` pairs the methods rollout by rollout.

    pooled = defaultdict(list)
    for row in result.rows:
        pooled[row["method"], row["labels"]].append(row)
    print(f"\n{'method':16}{'labelled':>10}{'success in % (95 %)':>24}{'action error':>16}")
    points = defaultdict(list)
    for (method, labels), rows in sorted(pooled.items()):
        trials = sum(row["episodes"] for row in rows)
        wins = sum(row["successes"] for row in rows)
        low, high = (100 * end for end in wilson_interval(wins, trials))
        error = sum(row["action_error"] for row in rows) / len(rows)
        points[method].append((labels, 100 * wins / trials, low, high))
        print(f"{method:16}{labels:>10.1%}{f'{100 * wins / trials:.0f} ({low:.0f}-{high:.0f})':>24}{error:>13.2f} mm")
    print("\npaired with koap, rows of comparisons.csv")
    for line in (study.out / "comparisons.csv").read_text().splitlines()[:5]:
        print("  " + ", ".join(line.split(",")[3:9]))

    # %%
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel="labelled share of 40 demonstrations", ylabel="success (%)", xscale="log")
    for shift, (method, line) in enumerate(points.items()):
        share, rate, low, high = zip(*line, strict=True)
        share = [value * (1 + 0.04 * shift) for value in share]
        axes.plot(share, rate, marker="o", label=method)
        axes.vlines(share, low, high, alpha=0.4)
    axes.set_xticks((0.025, 0.1), ("2.5 %", "10 %"))
    axes.minorticks_off()
    axes.set_ylim(0, 100)
    axes.legend()
    figure.savefig("label_curve.png", dpi=90)

# %%
# Conclusion
# ----------
# On a running cluster, call ``koap curve --launcher ray --address auto``. All workers must see the folder of the curve.
