# This source code is licensed under the MIT license found in the LICENSE file.
"""
From videos without actions to a scooping robot
===============================================

**What you will learn**

* how a frozen network turns videos of a robot and of a hand into one data set of embeddings,
* how a planner learns from all videos, and a controller from five demonstrations with joint targets,
* what a small set like this one reaches, and what it does not show.

Run it with ``python tutorials/scooping.py``; it needs the extra ``vision`` and an OpenGL library, and writes
``scooping.png``.
"""

# %%
# Two kinds of videos
# -------------------
# A spoon takes pieces out of a bowl, filmed at ten frames a second. The robot's recordings have joint targets. Only
# five demonstrations keep them. The hand has neither joints nor labels, and differs in look, speed and approach. From
# the shell: ``koap demos --task scooping --embodiment robot``, or ``hand``.

import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

import torchrl_koap
from torchrl_koap.data import LabelBudget, load_ted
from torchrl_koap.envs import ScoopingEnv
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.scooping.recording import record_videos
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.scooping import CAMERA, EMBEDDING_DIM, RIM_HEIGHT
from torchrl_koap.vision import load_backbone, load_encoder
from torchrl_koap.vision.embedding import embed_recordings, read_sources

torch.set_num_threads(1)
NETWORK = "torchrl_koap.vision.backbones:lite0_cells"
load_backbone(NETWORK)  # an early error names the package of missing weights
folder, task = Path(tempfile.mkdtemp()), get_task("scooping")
EACH, LABELLED, TRIALS = 24, 5, 15
for embodiment in ("robot", "hand"):
    report = record_videos(folder / embodiment, embodiment, EACH)
    print(f"{embodiment}: {report.episodes} videos, {report.frames} frames")

# %%
# Frames to embeddings
# --------------------
# EfficientNet-Lite0 was trained on ImageNet. Averages over 6 x 6 cells keep positions. Principal components are
# fitted on these frames, without labels. To test them, a linear map from embeddings to the spoon's position is fitted
# on 75 % of the robot's videos. The policy never reads the position.

sources, _ = read_sources([folder / embodiment for embodiment in ("robot", "hand")], task)
report = embed_recordings(sources, task, folder / "data", network=NETWORK)[CAMERA]
encoder = load_encoder(folder / "data" / "cameras" / f"{CAMERA}.safetensors")
stored, _ = load_ted(folder / "data" / "ted")

robots = stored["episode"] < EACH
seen = stored["observation"][robots, :EMBEDDING_DIM].double()
seen, spoon = torch.cat([seen, torch.ones(len(seen), 1)], 1), stored["observation"][robots, EMBEDDING_DIM:].double()
fitted = stored["episode"][robots] < 0.75 * EACH
probe = torch.linalg.lstsq(seen[fitted], spoon[fitted]).solution
off = 1000 * (seen[~fitted] @ probe - spoon[~fitted]).norm(dim=1).mean()
print(f"{EMBEDDING_DIM} components keep {report.kept:.0%} of the variance: the spoon's place within {off:.0f} mm")

# %%
# A planner of all videos, controllers of five demonstrations
# ------------------------------------------------------------
# The planner reads no action, so it learns from the hand's videos as well. Controllers read the embeddings of all
# videos and the joint targets of five. There are three: ridge regression on raw frames, KOAP, and KOAP with random
# features.

data, labels = LabelBudget(episodes=range(LABELLED)).apply(stored)
print(f"labels: {labels.labelled_transitions} of {labels.total_transitions} steps")
updates, planner, trained = {"linear": 0, "koap": 100, "koap_untrained": 0}, {"steps": 1000}, {}
for name, steps in updates.items():
    trained[name] = torchrl_koap.fit(
        data, task, method=name, planner=planner, controller={"steps": steps}, progress=False
    )
    planner = trained[name].planner  # shared by all controllers

# %%
# Scooping
# --------
# There are fifteen trials from the three start positions. Joint targets are decoded once per plan
# (``task.defaults.execution``). With decoding at every frame, a position error would act as a velocity.


def trials(trained):
    """Episodes in the simulator, frames included."""
    policy = trained.policy()
    contexts = draw_contexts("scooping", TRIALS, 1)

    def make_env(number):
        return ScoopingEnv(number, encoder=encoder, pixels=True)

    return roll_out(policy, make_env, range(TRIALS), max_steps=task.max_steps, contexts=contexts)


episodes, rates = {}, {}
for name, each in trained.items():
    episodes[name] = trials(each)
    over = sum(bool(episode["next", "mode"].any()) for episode in episodes[name])
    taken = sum(bool(episode["next", "success"].any()) for episode in episodes[name])
    rate, low, high = rates[name] = (100 * taken / TRIALS, *(100 * end for end in wilson_interval(taken, TRIALS)))
    print(f"{name:14} over the rim {over} of {TRIALS}, with a piece {taken}: {rate:.0f} % ({low:.0f}-{high:.0f})")

# %%
# Top: videos of a hand, of a robot and of KOAP. Bottom: success with 95 % intervals, and the height of KOAP's spoon.

tried = sorted(episodes["koap"], key=lambda episode: not episode["next", "success"].any())
videos = sources.cameras[CAMERA]
films = {"a hand's video": list(videos[EACH].read()), "a robot's video": list(videos[0].read())}
films["a trial of koap"] = tried[0]["pixels"].numpy()
figure = Figure(figsize=(8, 6.6), layout="constrained")
above, below = figure.subfigures(2, 1, height_ratios=(3, 1.7))
for row, (title, frames) in zip(above.subplots(3, 7), films.items(), strict=True):
    for axes, moment in zip(row, np.linspace(0, len(frames) - 1, 7).astype(int), strict=True):
        axes.imshow(frames[moment])
        axes.set(xticks=[], yticks=[], xlabel=f"{moment / task.control_hz:.1f} s")
    row[0].set_ylabel(title)
left, right = below.subplots(1, 2, width_ratios=(1, 1.8))
for place, (rate, low, high) in enumerate(rates.values()):
    left.bar(place, rate, color="#1f6feb", width=0.6)
    left.vlines(place, low, high, color="#24292f")
left.set(xticks=range(len(rates)), ylim=(0, 100), ylabel="success (%)")
left.set_xticklabels([name.replace("_", "\n") for name in rates])
for episode in tried:
    height = 1000 * episode["observation"][:, EMBEDDING_DIM + 2]
    color = "#1f6feb" if episode["next", "success"].any() else "#b3b9c1"
    right.plot(torch.arange(len(height)) / task.control_hz, height, color=color, linewidth=1)
right.axhline(1000 * RIM_HEIGHT, color="#d9730d", linewidth=1)
right.set(xlabel="time (s); blue: trials that took a piece, orange: the bowl's rim", ylabel="height of the spoon (mm)")
figure.savefig("scooping.png", dpi=90)

# %%
# Conclusion
# ----------
# The spoon takes a piece in most trials, with labels of five demonstrations. This set is too small to rank controllers:
# the intervals overlap. Random features do about as well as trained ones, also with four times the videos
# (``docs/results/scooping.md``).
#
# From the shell: ``koap demos --task scooping --embodiment robot --out robot``, the same with ``hand``, then ``koap
# embed robot hand --task scooping --out data``, ``koap train`` and ``koap eval``.
