# This source code is licensed under the MIT license found in the LICENSE file.
"""
A label curve on a cluster of two workers
=========================================

**What you will learn**

* how methods, budgets and seeds become cells that run wherever there is a processor,
* how to read the table: intervals, paired differences, and what a few seeds cannot tell.

Run it with ``python tutorials/label_curve.py``; it leaves ``label_curve.png`` behind. With ``ray`` installed
(``pip install 'torchrl_koap[ray]'``) the cells are tasks of a Ray cluster on this machine, else local processes: the
results are the same.
"""

# %%
# A small curve
# -------------
# Two workers, three methods, two budgets, two seeds: twelve cells on one planner. Networks, rollouts and demonstrations
# are kept few so that it takes minutes; ``koap curve`` asks for the same with options of the same names.

import csv
import importlib.util
import tempfile
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_koap import CurveConfig, run_curve
from torchrl_koap.evaluation.statistics import wilson_interval

if __name__ == "__main__":  # workers import this file
    out = Path(tempfile.mkdtemp()) / "curve"
    launcher = "ray" if importlib.util.find_spec("ray") else "local"
    config = CurveConfig(
        out=out,
        methods="koap,koap_untrained,linear",
        fractions="0.025,0.1",
        seeds=2,
        demonstrations=40,
        episodes=12,
        steps=600,
        controller_steps=100,
        workers=2,
        launcher=launcher,
    )
    result = run_curve(config)
    print(f"launcher {launcher}: {result['done']} cells done, {result['failed']} failed")

    # %%
    # A call with the same folder does what is missing, which now is nothing. A larger budget would add its cells only.

    again = run_curve(config)
    print(f"called again: {again['done']} done, {again['missing']} missing")

    # %%
    # The table
    # ---------
    # Seeds are pooled: 24 rollouts per entry. An interval of that many is up to forty points wide, so only the large
    # differences mean anything here. ``comparisons.csv`` pairs the methods rollout by rollout.

    with (out / "cells.csv").open() as file:
        cells = list(csv.DictReader(file))
    pooled = defaultdict(list)
    for cell in cells:
        pooled[cell["method"], float(cell["fraction"])].append(cell)
    print(f"\n{'method':16}{'labelled':>10}{'success in % (95 %)':>24}{'action error':>16}")
    points = defaultdict(list)
    for (method, fraction), rows in sorted(pooled.items()):
        trials = sum(int(row["episodes"]) for row in rows)
        wins = sum(int(row["successes"]) for row in rows)
        low, high = (100 * end for end in wilson_interval(wins, trials))
        error = sum(float(row["action_error"]) for row in rows) / len(rows)
        points[method].append((fraction, 100 * wins / trials, low, high))
        print(f"{method:16}{fraction:>10.1%}{f'{100 * wins / trials:.0f} ({low:.0f}-{high:.0f})':>24}{error:>13.2f} mm")
    with (out / "comparisons.csv").open() as file:
        rows = list(csv.DictReader(file))
    print("\npaired with koap, first rows of comparisons.csv")
    for row in rows[:4]:
        print("  " + ", ".join(f"{name} {value}" for name, value in list(row.items())[:8] if value))

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
# On a cluster that runs already: ``koap curve --launcher ray --address auto``. Workers write to the folder of the
# curve, which has to be one that all of them see.
