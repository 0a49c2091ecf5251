# This source code is licensed under the MIT license found in the LICENSE file.
"""
Which demonstration to label next
=================================

**What you will learn**

* why the next labels can be chosen before they are made,
* how much chosen labels lower the error, compared with random ones.

Run it with ``python tutorials/label_next.py``; it writes ``label_next.png``.
"""

# %%
# Forty-eight demonstrations, one of them labelled
# ------------------------------------------------

import statistics

import torch
from matplotlib.figure import Figure

import torchrl_koap
from torchrl_koap import get_task
from torchrl_koap.data import LabelBudget, select_state
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.evaluation.active_labelling import rank_trajectories
from torchrl_koap.evaluation.data_errors import first_actions
from torchrl_koap.evaluation.latent_space import infer_steps

task = get_task("avoiding")
demonstrations, _ = record_demonstrations("avoiding", episodes=48)
demonstrations = select_state(demonstrations, task.state_columns)
every = demonstrations["episode"].unique().tolist()


def labelled(episodes):
    return LabelBudget(episodes=episodes).apply(demonstrations, command=task.command_columns)[0]


def fit(episodes):
    data = labelled(episodes)
    # untrained features: only the choice of labels is compared, and a fit is fast
    return torchrl_koap.fit(data, task, method="koap_untrained", planner=False, progress=False), data


# %%
# The choice reads no label
# -------------------------
# The uncertainty of a ridge regression depends on the labelled states, not on the *values* of labels. ``a_optimal``
# takes the demonstration that lowers the decoder's mean uncertainty most, then repeats this with the chosen ones
# added. ``random`` chooses at random.


def choose(criterion, first, count):
    trained, data = fit([first])
    steps = infer_steps(trained.controller, data)
    if criterion == "random":
        names = steps["episode"][steps["episode"] != first].unique()
        return names[torch.randperm(len(names), generator=torch.Generator().manual_seed(first))[:count]].tolist()
    chosen = rank_trajectories(
        steps["latent_action"],
        steps["episode"],
        steps["has_action"],
        penalty=trained.results["decoder_fit"]["penalty"],
        count=count,
    )
    return [choice.episode for choice in chosen]


# %%
# What it gains
# -------------
# Errors are measured on twelve demonstrations without labels for any method. Six different first labels show the
# random variation.

judged = every[-12:]
pool = torch.isin(demonstrations["episode"], torch.tensor(every[:-12]))
held_out, demonstrations = demonstrations[~pool], demonstrations[pool]
firsts, counts = every[:36:6], (1, 2, 3, 5)
errors = {name: {count: [] for count in counts} for name in ("random", "a_optimal")}
for first in firsts:
    order = {name: [first, *choose(name, first, max(counts) - 1)] for name in errors}
    for name, episodes in order.items():
        for count in counts:
            controller = fit(episodes[:count])[0].controller
            predicted, true, _ = first_actions(controller, held_out, judged)
            errors[name][count].append(1e3 * (predicted - true).square().mean().sqrt().item())
print("the first", firsts[0], "was followed by", {name: chosen[1:] for name, chosen in order.items()})

print(f"\naction error in mm on {len(judged)} other demonstrations, median over {len(firsts)} first labels")
print(f"{'labelled':14}" + "".join(f"{count:>8}" for count in counts))
for name, by_count in errors.items():
    print(f"{name:14}" + "".join(f"{statistics.median(values):8.2f}" for values in by_count.values()))
better = sum(a < b for a, b in zip(errors["a_optimal"][5], errors["random"][5], strict=True))
print(f"\nwith 5 labels a_optimal beats random from {better} of {len(firsts)} starts")

# %%
figure = Figure(figsize=(6, 3.6), layout="constrained")
axes = figure.add_subplot(xlabel=f"labelled demonstrations of {len(every) - 12}", ylabel="action error (mm)")
for name, color in {"random": "#8a929e", "a_optimal": "#1f6feb"}.items():
    for values in zip(*errors[name].values(), strict=True):
        axes.plot(counts, values, color=color, alpha=0.2, linewidth=1)
    axes.plot(counts, [statistics.median(errors[name][c]) for c in counts], color=color, marker="o", label=name)
axes.set_xticks(counts)
axes.set_ylim(bottom=0)
axes.legend()
figure.savefig("label_next.png", dpi=90)

# %%
# Conclusion
# ----------
# ``koap suggest RUN --count 5`` does this for a run and prints the command that uses the labels. On Avoiding the error
# falls by a few percent, because most demonstrations show the same motions. The pale lines show the spread between
# first labels.
