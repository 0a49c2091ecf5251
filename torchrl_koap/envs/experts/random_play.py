# This source code is licensed under the MIT license found in the LICENSE file.
"""Random play: a tool that is pushed about at random, with every command known and nothing achieved.

Labels cost least where nobody has to demonstrate: a robot that moves at random within some bounds knows what it
commanded. Whether such labels serve for the demonstrations of a task, which go elsewhere, is another question.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap import keys
from torchrl_koap.data import flatten_trajectories
from torchrl_koap.envs.experts.noise import ar1_noise
from torchrl_koap.envs.registry import make_env
from torchrl_koap.tasks import Task, get_task

MAX_ATTEMPTS = 50


def record_random_play(
    task: Task | str,
    trajectories: int,
    steps: int = 80,
    *,
    push: float,
    bounds: Sequence[tuple[float, float]],
    memory: float = 8.0,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> TensorDict:
    """Records random motions of a tool whose actions are changes of its commanded position, every action labelled.

    Actions are autoregressive noise; behind a bound they point inwards. A motion that ends early, such as by a
    collision, is played again with other draws.

    Args:
        task (Task or str): the task, or its name.
        trajectories (int): number of motions.
        steps (int): actions of each. Defaults to ``80``.

    Keyword Args:
        push (float): standard deviation of every action (m).
        bounds (sequence of pairs): for every action, between which coordinates the tool is kept (m).
        memory (float): steps after which a share 1/e of an action remains. Defaults to ``8``.
        seed (int): of all draws. Defaults to ``0``.
        dtype (torch.dtype): floating type of the entries; everything is computed in float64.

    Returns:
        TensorDict: flat data ``[trajectories * steps]`` in the storage layout of :mod:`torchrl_koap.keys`.

    Raises:
        ValueError: if the actions of the task are no changes of a position, there are not as many bounds as actions, or
            a number is out of range.
        RuntimeError: if a motion ends early in every attempt.

    Examples:
        >>> from torchrl_koap.envs.experts.random_play import record_random_play
        >>> play = record_random_play("avoiding", 2, steps=20, push=0.004, bounds=[(0.3, 0.7), (-0.25, 0.3)])
        >>> play["action"].shape, play["has_action"].all().item()
        (torch.Size([40, 2]), True)
    """
    facts = get_task(task) if isinstance(task, str) else task
    columns = _tool_columns(facts)
    low, high = _check_bounds(facts, bounds)
    for option, value in (("trajectories", trajectories), ("steps", steps), ("push", push), ("memory", memory)):
        if not value > 0:
            raise ValueError(f"{option} must be positive, got {value!r}")
    env = make_env(facts, trajectories, max_steps=steps + 1, dtype=torch.float64)
    found: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
    try:
        for attempt in range(MAX_ATTEMPTS):
            draws = [np.random.default_rng((seed, number, attempt)) for number in range(trajectories)]
            noise = np.stack([ar1_noise(draw, memory, push, (steps, facts.action_dim)) for draw in draws], 1)
            for number, motion in enumerate(_play(env, noise, columns, low, high)):
                if motion is not None:
                    found.setdefault(number, motion)
            if len(found) == trajectories:
                frames, actions = zip(*(found[number] for number in range(trajectories)), strict=True)
                return flatten_trajectories(frames, actions, dtype=dtype)
    finally:
        env.close()
    missing = [number for number in range(trajectories) if number not in found]
    raise RuntimeError(
        f"random play of task {facts.name!r} ended before {steps} steps in {MAX_ATTEMPTS} attempts at motions"
        f" {missing}: take fewer steps, smaller pushes or narrower bounds"
    )


def _tool_columns(task: Task) -> slice:
    """Columns of the observation that hold the position which actions change."""
    columns = task.observation[task.position]
    if task.env is None or task.targets or columns.stop - columns.start != task.action_dim:
        raise ValueError(
            f"random play pushes a tool about; task {task.name!r} has no environment in which {task.action_dim} actions"
            " change the position of one"
        )
    return columns


def _check_bounds(task: Task, bounds: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    pairs = np.asarray(bounds, dtype=np.float64)
    if pairs.shape != (task.action_dim, 2) or not (pairs[:, 0] < pairs[:, 1]).all():
        raise ValueError(f"bounds must be {task.action_dim} pairs (low, high), got {list(bounds)}")
    return pairs[:, 0], pairs[:, 1]


def _play(
    env, noise: np.ndarray, columns: slice, low: np.ndarray, high: np.ndarray
) -> list[tuple[torch.Tensor, torch.Tensor] | None]:
    """One attempt: noise ``[steps, n, act]`` becomes a motion per environment, None where it ended early."""
    data = env.reset()
    frames, actions = [data[keys.OBSERVATION].numpy().copy()], []
    ended = np.zeros(noise.shape[1], dtype=bool)
    for wanted in noise:
        place = frames[-1][:, columns]
        action = np.where(place < low, np.abs(wanted), np.where(place > high, -np.abs(wanted), wanted))
        step = data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(~ended[:, None]))
        data = env.step(step)["next"].clone()
        ended |= data["done"].squeeze(-1).numpy()
        frames.append(data[keys.OBSERVATION].numpy().copy())
        actions.append(action)
    motions = zip(np.stack(frames, 1), np.stack(actions, 1), ended, strict=True)
    return [
        None if early else (torch.from_numpy(observation), torch.from_numpy(action))
        for observation, action, early in motions
    ]
