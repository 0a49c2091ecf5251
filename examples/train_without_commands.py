# This source code is licensed under the MIT license found in the LICENSE file.
"""KOAP on Avoiding from TorchRL parts, without ``koap train``: python examples/train_without_commands.py"""

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.objectives import SoftUpdate

from torchrl_koap import modules as koap
from torchrl_koap.data import LabelBudget, cut_windows, extrapolate_ends, make_window_buffer, select_state
from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.objectives import KOAPLoss, PlannerLoss
from torchrl_koap.tasks import get_task

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--demonstrations", type=int, default=48)
parser.add_argument("--updates", type=int, default=1000, help="of planner and controller each")
options = parser.parse_args()
torch.manual_seed(0)
task = get_task("avoiding")
# data set: only two demonstrations keep their actions; elsewhere the action is NaN and has_action is False
data, _ = record_demonstrations("avoiding", episodes=options.demonstrations)
data, report = LabelBudget(count=2).apply(select_state(data, task.state_columns), command=task.command_columns)
print(f"{report.labelled_transitions} of {report.total_transitions} transitions have labels")
controller = koap.KoopmanInverseDynamics(
    koap.LatentActionMLP(2, 16, hidden_dims=(64, 64), num_past=1, look_ahead=(2, 3), relative=True),
    koap.LinearActionDecoder(16, 2),  # maps the latent action to actions
    lifting=koap.KoopmanLifting(2, 16, hidden_dims=(64, 64), include_state=True),
    operator=koap.KoopmanOperator(16),  # with the lifting, shapes the latent action on all states
    state_normalizer=koap.Normalizer.fit(data["state"], mode="standard"),
    action_normalizer=koap.Normalizer.fit(data["action"], mode="rms", mask=data["has_action"]),
)
planner = koap.StatePlanner(koap.TemporalUnet(2, 4), state_dim=2)
labels = make_window_buffer(data, 16, 128, select=["state", "action", "has_action"], pad_before=1, labelled_share=0.25)
extended = extrapolate_ends(data, 13)  # plans made near the end of a demonstration have a future too
states = make_window_buffer(extended, 16, 128, select=["state"], pad_before=1)
windows = cut_windows(extended, 16, select=["state"], pad_before=1)  # statistics of what is trained on
planner.fit_normalizers(windows["state"])
controller.prepare(windows["state"])
planner_loss = PlannerLoss(planner)
average = SoftUpdate(planner_loss, eps=0.99)  # the policy plans with averaged weights
for loss, buffer, rate in ((KOAPLoss(controller), labels, 1e-3), (planner_loss, states, 3e-3)):
    optimizer = torch.optim.AdamW(loss.parameters(), rate)
    for _ in range(options.updates):
        terms = {key: value for key, value in loss(buffer.sample()).items() if key.startswith("loss_")}
        sum(terms.values()).backward()
        optimizer.step()
        optimizer.zero_grad()
        average.step()
    print({key: round(value.item(), 4) for key, value in terms.items()})
planner_loss.target_network_params.to_module(planner)
policy = koap.make_policy(planner.eval(), controller.eval(), state_of=task.state_columns)
env = TransformedEnv(AvoidingEnv(8, max_steps=120), RewardSum())
collector = Collector(koap.PolicyEnv(env, policy), policy, frames_per_batch=960, total_frames=960)
batch = next(iter(collector))
collector.shutdown()
print(f"{tuple(batch.shape)}: {int(batch['next', 'success'].any(1).sum())} of 8 environments succeed at least once")
