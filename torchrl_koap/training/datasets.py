# This source code is licensed under the MIT license found in the LICENSE file.
"""Selects the trajectories and labels of the demonstrations that a training uses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.label_budget import LabelReport
from torchrl_koap.data.trajectories import labelled_episodes
from torchrl_koap.keys import EPISODE, STATE
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import digest_of, load_tensors
from torchrl_koap.tasks import Task
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.policy_facts import tells_commands

# without columns derived from these, which may differ between versions
_RECORDED = ("observation", "action", "has_action", "episode", "step_count", ("next", "observation"), ("next", "done"))


def fingerprint(data: TensorDictBase) -> dict[str, Any]:
    """Returns the size of flat data ``[N]`` and a checksum of what was recorded."""
    present = set(data.keys(True, True))
    return {"steps": len(data), "sha256": digest_of((name, data.get(name)) for name in _RECORDED if name in present)}


def within_budget(task: Task, config: TrainConfig, data: TensorDictBase) -> tuple[TensorDictBase, LabelReport]:
    """Hides the labels of flat data ``[N]`` that a training with these options does not see; also returns a report."""
    tell = tells_commands(task, get_method(config.method))
    return config.labels.budget(config.run.seed).apply(data, command=task.command_columns, tell_commands=tell)


def choose_held_out(data: TensorDictBase, fraction: float | None, *, seed: int = 0) -> list[int]:
    """Returns the numbers of the trajectories to hold out from the planner, those without a label first.

    Trajectories with labels are taken only if the others do not suffice. They lose no label: the planner does not
    see them, the controller does. At least one trajectory is held out (of ten or more, two), and at least one is left.
    A single trajectory is not held out.

    The fraction is a share of all trajectories of flat data ``[N]``, in ``[0, 1)``; None is 0.
    """
    if not fraction:
        return []
    episodes = data[EPISODE].unique_consecutive().cpu()
    total = len(episodes)
    number = min(max(math.floor(fraction * total + 0.5), 1 if total < 10 else 2), total - 1)
    labelled = torch.isin(episodes, labelled_episodes(data).cpu())
    order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
    order = torch.cat([order[~labelled[order]], order[labelled[order]]])
    return sorted(episodes[order[:number]].tolist())


def held_out_facts(data: TensorDictBase, episodes: Sequence[int]) -> dict[str, Any]:
    """Returns what ``config.json`` records of held-out trajectories: numbers and a checksum of states."""
    if not len(episodes):
        return {}
    states = data[STATE][torch.isin(data[EPISODE].cpu(), torch.tensor(list(episodes)))]
    return {"held_out_episodes": list(episodes), "held_out_states": digest_of([("state", states)])}


def held_out_by(source: Path, data: TensorDictBase) -> list[int]:
    """Returns the numbers that the trajectories held out from a run's planner have in flat data ``[N]``.

    If these numbers now mean others, they are found by their states; none if the run holds no demonstrations.
    """
    run = RunDirectory(source)
    content, path = run.read_json("config.json"), run.path / "demonstrations.safetensors"
    episodes = content.get("held_out_episodes") or []
    if held_out_facts(data, episodes).items() <= content.items():
        return episodes
    if not path.exists():
        return []
    theirs = load_tensors(path)[0]
    known, now = _by_states(theirs[EPISODE], theirs[STATE]), _by_states(data[EPISODE], data[STATE])
    unseen = {digest for number, digest in known.items() if number in episodes}
    return [number for number, digest in now.items() if digest in unseen]


def _by_states(episode: Tensor, states: Tensor) -> dict[int, str]:
    """Returns a checksum of the states ``[N, d]`` of each trajectory, by its number."""
    numbers, lengths = episode.unique_consecutive(return_counts=True)
    parts = states.split(lengths.tolist())
    return {number: digest_of([("", part)]) for number, part in zip(numbers.tolist(), parts, strict=True)}


def split_held_out(
    data: TensorDictBase, episodes: Sequence[int]
) -> tuple[TensorDictBase, TensorDictBase | None, TensorDictBase]:
    """Splits flat data ``[N]``: what a planner learns from, what is held out from it, what a controller sees.

    The second is None if nothing is held out. A controller sees held-out trajectories that have a label.
    """
    if not len(episodes):
        return data, None, data
    episode = data[EPISODE]
    held_out = torch.isin(episode, torch.as_tensor(list(episodes), device=episode.device))
    if held_out.all():
        raise ValueError(
            f"all {len(episode.unique())} trajectories that are used are held out: nothing is left to"
            " train on; lower planner.held_out or raise labels.trajectories"
        )
    labelled = torch.isin(episode, labelled_episodes(data))
    return data[~held_out], data[held_out], data[~held_out | labelled]
