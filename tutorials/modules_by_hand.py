# This source code is licensed under the MIT license found in the LICENSE file.
"""
The modules by hand
===================

**What you will learn**

* how lifting, operator, latent action and action decoder fit together as TensorDict modules,
* how they work with losses, a replay buffer and a collector of TorchRL.

Run it with ``python tutorials/modules_by_hand.py``; it writes ``modules_by_hand.png``.
"""

# %%
# Four parts and a model
# ----------------------
# The latent action ``u_t = f(x_{t-1}, x_t, x_{t+2}, x_{t+3})`` is computed from states. The loss trains lifting ``z =
# g(x)`` and operator to satisfy ``z' = K z + u``. Only the decoder ``a = D u`` needs labels.

import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_koap.data import LabelBudget, cut_windows, select_state
from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.modules import (
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LatentActionMLP,
    LinearActionDecoder,
    Normalizer,
    PolicyEnv,
    make_policy,
)
from torchrl_koap.objectives import KOAPLoss
from torchrl_koap.tasks import get_task
from torchrl_koap.training import fit

torch.manual_seed(0)
task = get_task("avoiding")
demonstrations = select_state(record_demonstrations("avoiding", episodes=24)[0], task.state_columns)
data, report = LabelBudget(count=2).apply(demonstrations, command=task.command_columns)
model = KoopmanInverseDynamics(
    LatentActionMLP(2, 16, hidden_dims=(32, 32), num_past=1, look_ahead=(2, 3), relative=True),
    LinearActionDecoder(16, 2),
    lifting=KoopmanLifting(2, 16, hidden_dims=(32, 32), include_state=True),
    operator=KoopmanOperator(16),
    state_normalizer=Normalizer.fit(data["state"], mode="standard"),
    action_normalizer=Normalizer.fit(data["action"], mode="rms", mask=data["has_action"]),
)
for name, part in {
    "latent action": model.latent_action,
    "lifting": model.lifting,
    "operator": model.operator,
    "action decoder": model.action_decoder,
}.items():
    size = sum(parameter.numel() for parameter in part.parameters())
    print(f"{name:15} {part.in_keys} -> {part.out_keys}, {size:,} parameters")

# %%
# A replay buffer of windows, and the losses
# ------------------------------------------
# Windows are TensorDicts ``[N, 16]``, so any buffer of TorchRL holds them. ``has_action`` marks labels. Elsewhere the
# action is NaN and reaches no gradient.

windows = cut_windows(data, 16, select=["state", "action", "has_action"], pad_before=model.num_past)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(windows)), batch_size=128)
buffer.extend(windows)
model.prepare(windows["state"])
loss = KOAPLoss(model)
optimizer = torch.optim.AdamW(loss.parameters(), 1e-3)
history = []
for update in range(400):
    losses = loss(buffer.sample())
    terms = {key: losses[key] for key in losses.keys() if key.startswith("loss_")}
    sum(terms.values()).backward()
    optimizer.step()
    optimizer.zero_grad()
    history.append({key: value.item() for key, value in terms.items()})
    if update in (0, 99, 399):
        print(f"update {update + 1:3}: " + ", ".join(f"{key} {value:.4f}" for key, value in history[-1].items()))
print(f"labels: {report.labelled_transitions} of {report.total_transitions} transitions")

# %%
# The latent actions and actions of one window, and the largest eigenvalues of the operator.

with torch.no_grad():
    window = model(TensorDict({"state": windows["state"][:1]}, [1]))
print("latent actions", tuple(window["latent_action"].shape), "actions", tuple(window["action"].shape))
radii = model.operator.eigenvalues().abs().sort(descending=True).values
print("largest eigenvalues of K:", [round(value, 3) for value in radii[:4].tolist()])

# %%
# A policy in a TorchRL collector
# -------------------------------
# The planner is trained for a short time. ``PolicyEnv`` adds the frames and the noise that the policy reads. The
# collector returns ordinary TorchRL batches.

planner = fit(data, task, method="linear", planner={"steps": 600}, progress=False).planner
policy = make_policy(planner, model.eval(), state_of=task.state_columns)
env = PolicyEnv(AvoidingEnv(num_envs=8, max_steps=task.max_steps), policy)
env.set_seed(0)  # before the collector starts the first episodes
collector = Collector(env, policy, frames_per_batch=8 * 100, total_frames=8 * 100)
batch = next(iter(collector))
collector.shutdown()
xy = batch["observation"][..., task.observation["measured_xy"]]  # [8, 100, 2]
ended = batch["next", "done"].any(1).squeeze(-1)
succeeded = batch["next", "success"].any(1).squeeze(-1)
print(f"collector: batch {tuple(batch.shape)}, {int(ended.sum())} of 8 ended, {int(succeeded.sum())} with success")

# %%
figure = Figure(figsize=(8, 3.6), layout="constrained")
axes, plane = figure.subplots(1, 2)
for key in history[0]:
    axes.plot([row[key] for row in history], label=key)
axes.set(xlabel="update", yscale="log")
axes.legend()
for path, over in zip(xy.numpy(), batch["next", "done"].squeeze(-1), strict=True):
    end = int(over.nonzero()[0]) + 1 if over.any() else len(path)
    plane.plot(*path[:end].T, linewidth=1)
plane.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="the collector's episodes")
figure.savefig("modules_by_hand.png", dpi=90)

# %%
# Conclusion
# ----------
# Every part can be replaced. ``make_koopman_inverse_dynamics`` builds the default model: Fourier features, a nearer
# look-ahead and a decoder in closed form. This needs fewer labels than gradients.
