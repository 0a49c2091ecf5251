# This source code is licensed under the MIT license found in the LICENSE file.
"""
Imitation with few action labels.
=================================

**What you will learn**

* how demonstrations with and without actions share one replay buffer,
* how a Koopman inverse dynamics model maps states to latent actions, and latent actions to actions,
* how planner and controller become one policy in a TorchRL environment.

Run it with ``python tutorials/few_labels.py``; it takes about a minute and writes ``few_labels.png``.
"""

# %%
# Demonstrations, most of them without actions
# --------------------------------------------
# Scripted experts steer the rod around six cylinders. The label budget keeps the actions of two of the 48 trajectories.
# Elsewhere the action is NaN and ``has_action`` is False, so a leak would give NaN losses.

from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_koap.data import (
    LabelBudget,
    RecoveryAugmentation,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
    select_state,
)
from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.evaluation.rollouts import roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import score
from torchrl_koap.modules import Normalizer, StatePlanner, TemporalUnet, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.objectives import KOAPLoss, PlannerLoss
from torchrl_koap.reports.rollout_plots import draw_rollouts
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import get_task
from torchrl_koap.training.closed_form import fit_closed_form

torch.manual_seed(0)
task = get_task("avoiding")
demonstrations, _ = record_demonstrations("avoiding", episodes=48)
demonstrations = select_state(demonstrations, task.state_columns)
data, report = LabelBudget(count=2, unit="trajectory").apply(demonstrations, command=task.command_columns)
print(f"labels: {report.labelled_transitions} of {report.total_transitions} transitions, 2 of 48 demonstrations")

# %%
# Latent actions from states alone
# --------------------------------
# ``KOAPLoss`` trains lifting, operator and latent actions on *all* windows. Without labels its action term is zero.
# Normalisers read all states, but only actions of the budget.

inverse_dynamics = make_koopman_inverse_dynamics(
    2,
    2,
    state_normalizer=Normalizer.fit(data["state"], mode="standard"),
    action_normalizer=Normalizer.fit(data["action"], mode="rms", mask=data["has_action"]),
)
history = inverse_dynamics.num_past
inverse_dynamics.prepare(cut_windows(data, 16, select=["state"], pad_before=history)["state"])
loss = KOAPLoss(inverse_dynamics, action_coeff=0.0)
buffer = make_window_buffer(data, 16, 256, select=["state", "action", "has_action"], pad_before=history)
optimizer = torch.optim.AdamW(loss.parameters(), 1e-3)
for _ in range(200):
    sum(loss(buffer.sample()).values()).backward()
    optimizer.step()
    optimizer.zero_grad()

# %%
# Finally, the linear decoder is fitted to the labels in closed form.

fit = fit_closed_form(inverse_dynamics, data, axes=task.moved_columns())
print(f"decoder: penalty {fit['penalty']:g}, {fit['labels_used']} labels used")

# %%
# A planner over states
# ---------------------
# The planner reads no action. The augmentation displaces observed states, so that plans return to the demonstration.

planner = StatePlanner(TemporalUnet(2, 4), state_dim=2, relative=False, num_steps=5)
extended = extrapolate_ends(data, 13)
planner.fit_normalizers(cut_windows(extended, 16, select=["state"], pad_before=1)["state"])
planner_loss = PlannerLoss(planner)
average = SoftUpdate(planner_loss, eps=0.99)
windows = make_window_buffer(extended, 16, 128, select=["state"], pad_before=1)
augment = RecoveryAugmentation(0.004)
optimizer = torch.optim.AdamW(planner_loss.parameters(), 3e-3)
for _ in range(1000):
    planner_loss(augment(windows.sample()))["loss_planner"].backward()
    optimizer.step()
    optimizer.zero_grad()
    average.step()
planner_loss.target_network_params.to_module(planner)

# %%
# Rollouts
# --------
# Every environment of the batch runs one episode with its own seed. The planner has 1,000 updates; ``make demo`` has
# more.

policy = make_policy(planner, inverse_dynamics, state_of=task.state_columns)
seeds = list(range(24))
episodes = roll_out(policy, AvoidingEnv, seeds, max_steps=task.max_steps)
result = score(episodes, seeds, task.modes)
rollouts = rollouts_to_tensors(episodes, task, interval=4)
rollouts = {name: tensor.numpy() for name, tensor in rollouts.items()}
draw_rollouts(rollouts, RunFacts(Path(), task)).savefig("few_labels.png", dpi=150)
rate, low, high = (100 * result["rates"]["success"][name] for name in ("rate", "low", "high"))
print(f"success {rate:.1f} % ({low:.0f}-{high:.0f}) of {len(seeds)} rollouts")
print(f"{result['distinct_modes']} of {task.modes.number} ways taken, entropy {result['mode_entropy']:.2f}")

# %%
# Every module works alone as well, for example to compute latent actions of a window.

latent = inverse_dynamics(TensorDict({"state": extended["state"][None, :16]}, batch_size=[1]))["latent_action"]
print("latent actions of a window:", tuple(latent.shape))

# %%
# Conclusion
# ----------
# Two labelled trajectories out of 48 were enough. ``result`` holds the success rate with its interval. ``report``
# counts the labels that were used.
#
# ``koap train`` does the same in one command. ``docs/results.md`` shows the effect of each choice.
