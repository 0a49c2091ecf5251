# This source code is licensed under the MIT license found in the LICENSE file.
"""
Planners: solvers, steps, temperature, modes
===========================================

**What you will learn**

* how many solver steps a plan needs,
* what temperature and candidates do to success and to the variety of modes,
* how to see without a simulator whether a planner has several modes.

Run it with ``python tutorials/planners.py``; it writes ``planners.png``.
"""

# %%
# A trained planner
# -----------------
# The repository holds a policy for Avoiding. Solver, steps and temperature are options of the *evaluation*, so nothing
# is trained here.

import time

import torch
from matplotlib.figure import Figure

from torchrl_koap import get_task, load_policy
from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.evaluation.scores import score
from torchrl_koap.runs.run_directory import find_run

torch.set_num_threads(1)
task, run = get_task("avoiding"), find_run("pretrained:avoiding")
planner = load_policy(run).planner

# %%
# One situation, many plans
# -------------------------
# The rod stands below the middle of the second row. Of 200 plans from the same two frames, how many go left, and how
# many through a cylinder?

here = torch.tensor([[0.5, -0.02], [0.5, -0.013]]).expand(200, 2, 2)


def plans_with(solver, steps):
    planner.solver, planner.num_steps = solver, steps
    began = time.perf_counter()
    with torch.no_grad():
        noise = torch.randn(200, *planner.noise_shape, generator=torch.Generator().manual_seed(0))
        plans = planner.sample(here, noise=noise)
    return plans, (time.perf_counter() - began) * 1e3


exact, _ = plans_with("ddim", 50)
print("one situation, 200 plans; distance to the plans of 50 ddim steps from the same noise")
rows = {}
for solver in ("ddim", "dpm++2m"):
    for steps in (1, 2, 5, 10, 20):
        plans, spent = plans_with(solver, steps)
        apart = (plans - exact).norm(dim=-1).mean() * 1e3
        left = (plans[:, -1, 0] < 0.5).float().mean()
        rows[solver, steps] = float(apart)
        print(f"{solver:8} {steps:3} steps: {apart:6.2f} mm apart, {100 * left:3.0f} % go left, {spent:6.0f} ms")

# %%
# The same in closed loop
# -----------------------
# Each setting has 24 rollouts with the same seeds. Read the entropy of the modes beside the success.

seeds = list(range(24))


def closed_loop(steps, **options):
    policy = load_policy(run, **{"candidates": 1, **options})
    policy.planner.num_steps = steps
    episodes = roll_out(policy, AvoidingEnv, seeds, max_steps=task.max_steps)
    return score(episodes, seeds, task.modes), episodes


print("\nclosed loop, 24 rollouts each")
results = {}
for name, steps, options in (
    ("1 step", 1, {}),
    ("2 steps", 2, {}),
    ("10 steps", 10, {}),
    ("10 steps, temperature 0.5", 10, {"temperature": 0.5}),
    ("10 steps, 4 candidates", 10, {"candidates": 4}),
):
    results[name], episodes = closed_loop(steps, **options)
    result = results[name]
    rate, low, high = (100 * result["rates"]["success"][part] for part in ("rate", "low", "high"))
    print(
        f"{name:25} success {rate:5.1f} % ({low:.0f}-{high:.0f}),"
        f" entropy {result['mode_entropy'] or 0:.2f}, {result['distinct_modes']} modes"
    )

# %%
from torchrl_koap.reports.scenes import draw_scene  # noqa: E402

figure = Figure(figsize=(9, 3.6), layout="constrained")
few, many, curve = figure.subplots(1, 3, width_ratios=(1, 1, 1.2))
for axes, steps in ((few, 1), (many, 10)):
    for words in draw_scene(axes, task).texts:
        words.remove()  # labels outside the visible part
    for plan in plans_with("dpm++2m", steps)[0][:60].numpy():
        axes.plot(*plan.T, color="#1f6feb", linewidth=0.6, alpha=0.5)
    axes.set(title=f"60 plans, {steps} step{'s' * (steps > 1)}", xlim=(0.38, 0.62), ylim=(-0.08, 0.16))
for solver in ("ddim", "dpm++2m"):
    steps = [count for name, count in rows if name == solver]
    curve.plot(steps, [rows[solver, count] for count in steps], marker="o", label=solver)
curve.set(xlabel="solver steps", ylabel="distance to 50 steps (mm)", xscale="log", yscale="log")
curve.legend()
figure.savefig("planners.png", dpi=90)

# %%
# Conclusion
# ----------
# One solver step gives the *mean* of all modes; with ten the plans differ. In closed loop, one step lowers success and
# entropy. The two solvers hardly differ. 24 rollouts are too few to compare temperature and candidates: their intervals
# overlap. Times are those of the machine that made this page.
