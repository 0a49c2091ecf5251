# This source code is licensed under the MIT license found in the LICENSE file.
"""
What is a label worth? Comparing controllers.
=============================================

**What you will learn**

* how a controller of your own takes part in the comparison: a module with a window of states in and actions out,
* how the same budget of labels is spent by a ridge, a supervised network and KOAP,
* which demonstrations to label next, and what asking costs: no label at all.

Run it with ``python tutorials/compare_controllers.py``; it takes about a minute and leaves
``compare_controllers.png`` behind.
"""

# %%
# One set of demonstrations, several budgets
# ------------------------------------------
# ``LabelBudget`` hides every action outside the budget and says what it spent. With one seed a larger budget contains
# every smaller one, so that curves are not driven by luck of the draw.

import torch
from matplotlib.figure import Figure
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_koap.data import LabelBudget, cut_windows, make_window_buffer, select_state
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.evaluation.active_labelling import rank_trajectories
from torchrl_koap.evaluation.latent_space import infer_steps
from torchrl_koap.modules import (
    LinearInverseDynamics,
    Normalizer,
    SupervisedInverseDynamics,
    make_koopman_inverse_dynamics,
)
from torchrl_koap.objectives import InverseDynamicsLoss, KOAPLoss
from torchrl_koap.tasks import get_task
from torchrl_koap.training.action_errors import hidden_action_errors, rmse_mm
from torchrl_koap.training.closed_form import fit_closed_form

torch.manual_seed(0)
task = get_task("avoiding")
demonstrations, _ = record_demonstrations("avoiding", episodes=48)
demonstrations = select_state(demonstrations, task.state_columns)


def budget(count):
    data, _ = LabelBudget(count, seed=1).apply(demonstrations, command=task.command_columns)
    return data


def normalizers(data):
    return {
        "state_normalizer": Normalizer.fit(data["state"], mode="standard"),
        "action_normalizer": Normalizer.fit(data["action"], mode="rms", mask=data["has_action"]),
    }


# %%
# A training loop for all of them
# -------------------------------
# Every loss reads the same windows; unlabelled steps reach no gradient. ``labelled_share`` says how much of a batch has
# labels: all of it for a network that only labels teach, as it comes for one that learns from states.


def train(loss, data, history, *, labelled_share, updates=300):
    keys = ["state", "action", "has_action"]
    buffer = make_window_buffer(data, 16, 128, select=keys, pad_before=history, labelled_share=labelled_share)
    optimizer = torch.optim.AdamW(loss.parameters(), 1e-3)
    for _ in range(updates):
        losses = loss(buffer.sample())
        sum(losses[key] for key in losses.keys() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()


def koap(data):
    model = make_koopman_inverse_dynamics(2, 2, **normalizers(data))
    model.fit_scales(cut_windows(data, 16, select=["state"], pad_before=model.num_past)["state"])
    train(KOAPLoss(model, action_coeff=0.0), data, model.num_past, labelled_share=None)
    fit_closed_form(model, data, shared_axes=task.actuated)
    return model


def supervised(data):
    model = SupervisedInverseDynamics(2, 2, look_ahead=(1, 2, 3, 4, 5), **normalizers(data))
    model.fit_scales(cut_windows(data, 16, select=["state"], pad_before=model.num_past)["state"])
    train(InverseDynamicsLoss(model), data, model.num_past, labelled_share=1.0)
    return model


def ridge(data):
    model = LinearInverseDynamics(2, 2)
    fit_closed_form(model, data)
    return model


# %%
# A controller of your own
# ------------------------
# Any module with these four attributes is a controller: it works in ``PlanThenControl``, in ``relabel`` and below. This
# one says that the command moves as fast as the arm will, times one number that it fits to the labels.


class Proportional(TensorDictModuleBase):
    in_keys, out_keys = ["state"], ["action"]
    num_past, num_window_frames = 0, 4

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(1))

    def velocity(self, state):
        frames = torch.arange(state.shape[-2])
        ahead = state[..., (frames + 3).clamp_max(state.shape[-2] - 1), :]
        return (ahead - state) / 3

    def forward(self, tensordict):
        return tensordict.set("action", self.gain * self.velocity(tensordict["state"]))


def proportional(data):
    model = Proportional()
    windows = cut_windows(data, 4, select=["state", "action", "has_action"])
    labelled = windows["has_action"][:, 0].squeeze(-1)
    speed, action = model.velocity(windows["state"])[labelled, 0], windows["action"][labelled, 0]
    model.gain.data.fill_((speed * action).sum() / speed.square().sum())
    return model


# %%
# The curve
# ---------
# Errors are measured on trajectories of which no label was in the budget. Those labels are read here and nowhere else.

counts = (1, 2, 5, 12)
controllers = {"KOAP": koap, "supervised": supervised, "ridge": ridge, "my own": proportional}
errors = {name: [] for name in controllers}
for count in counts:
    data = budget(count)
    for name, make in controllers.items():
        controller = make(data).eval()
        errors[name].append(rmse_mm(*hidden_action_errors(controller, demonstrations, data)))

# %%
# What to label next
# ------------------
# The covariance of a ridge does not depend on the values of labels, only on where they are. So the next ones can
# be chosen before anybody has labelled them.

data = budget(1)
model = koap(data)
steps = infer_steps(model, data)
chosen = rank_trajectories(
    steps["latent_action"], steps["episode"], steps["has_action"], penalty=0.15, criterion="a_optimal", count=4
)
first = data["episode"][data["has_action"].squeeze(-1)][:1].tolist()
asked = LabelBudget.of_episodes([*first, *(choice.episode for choice in chosen)])
data, _ = asked.apply(demonstrations, command=task.command_columns)
suggested = rmse_mm(*hidden_action_errors(koap(data).eval(), demonstrations, data))

# %%
figure = Figure(figsize=(6, 4), layout="constrained")
axes = figure.add_subplot(xlabel="labelled demonstrations of 48", ylabel="action error (mm)", xscale="log")
for name, values in errors.items():
    axes.plot(counts, values, marker="o", label=name)
axes.plot([5], [suggested], marker="*", markersize=14, linestyle="none", color="black", label="KOAP, 5 suggested")
axes.set_xticks(counts, map(str, counts))
axes.minorticks_off()
axes.set_ylim(bottom=0)
axes.legend()
figure.savefig("compare_controllers.png", dpi=120)

# %%
# Conclusion
# ----------
# ``errors`` holds the curve of each controller. An action error is not a success rate: ``koap curve`` puts planner,
# controller and environment together, over seeds, with intervals and paired comparisons, one method per line of
# ``torchrl_koap/training/methods.py``.
