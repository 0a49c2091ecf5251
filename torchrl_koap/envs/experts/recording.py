# This source code is licensed under the MIT license found in the LICENSE file.
"""How scripted experts play: which expert, environment and demands belong to a task, and one attempt of a batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_koap import keys
from torchrl_koap.data import RawEpisode
from torchrl_koap.data.d3il.conversion import OBJECTS
from torchrl_koap.envs.contexts import yaw_quaternions


@dataclass(frozen=True)
class Recipe:
    """What it takes to record demonstrations of one task.

    Args:
        make_env (callable): environment of a number of episodes, ``num_threads`` and ``dtype``.
        make_expert (callable): expert from modes, contexts ``[n, objects, 3]`` (None without) and seeds.
        mode_index (callable): leaf ``mode`` to a number, -1 if incomplete.
        num_modes (int): modes 0 to ``num_modes - 1`` are played.
        most_rows (int): longer recordings are discarded.
        touching (callable, optional): environments in which something forbidden is touched, bool ``[n]``.
        clearance (callable, optional): least distance of a recording to what must not be touched (m).
        least_clearance (float): nearer recordings are discarded (m).
    """

    make_env: Callable[..., Any]
    make_expert: Callable[..., Any]
    mode_index: Callable[[Tensor], Tensor]
    num_modes: int
    most_rows: int
    touching: Callable[[Any], np.ndarray] | None = None
    clearance: Callable[[RawEpisode], float] | None = None
    least_clearance: float = 0.0


def _avoiding() -> Recipe:
    from torchrl_koap.envs.avoiding import OBSTACLES, AvoidingEnv, mode_index
    from torchrl_koap.envs.experts.avoiding import ROD_RADIUS, AvoidingExpert

    def clearance(episode: RawEpisode) -> float:
        """Least distance between the rod, taken as upright, and any cylinder (m)."""
        path = episode.robot["c_pos"][:, :2]
        gaps = [np.linalg.norm(path - (x, y), axis=1).min() - radius for _, x, y, radius, _ in OBSTACLES]
        return min(gaps) - ROD_RADIUS

    return Recipe(
        make_env=AvoidingEnv,
        make_expert=lambda modes, contexts, seeds: AvoidingExpert(modes, seeds),
        mode_index=mode_index,
        num_modes=24,
        # the human demonstrations have at most 104 rows and pass the cylinders at 3 mm or more
        most_rows=120,
        touching=lambda env: env.obstacle_contacts().any(1),
        clearance=clearance,
        least_clearance=0.003,
    )


def _aligning() -> Recipe:
    from torchrl_koap.envs.aligning import AligningEnv, mode_index
    from torchrl_koap.envs.experts.aligning import AligningExpert

    return Recipe(AligningEnv, AligningExpert, mode_index, num_modes=2, most_rows=399)


def _sorting(num_boxes: int) -> Recipe:
    from torchrl_koap.envs.experts.sorting import SortingExpert
    from torchrl_koap.envs.sorting import SortingEnv, mode_index

    return Recipe(
        make_env=partial(SortingEnv, num_boxes=num_boxes),
        make_expert=partial(SortingExpert, num_boxes=num_boxes),
        mode_index=mode_index,
        num_modes=math.comb(num_boxes, num_boxes // 2),
        most_rows=699,
    )


def _stacking() -> Recipe:
    from torchrl_koap.envs.experts.stacking import StackingExpert
    from torchrl_koap.envs.stacking import StackingEnv, mode_index

    return Recipe(StackingEnv, StackingExpert, mode_index, num_modes=6, most_rows=999)


# made when asked for: a simulator takes seconds to import
RECIPES: dict[str, Callable[[], Recipe]] = {
    "avoiding": _avoiding,
    "aligning": _aligning,
    "sorting": partial(_sorting, 4),
    "sorting_2": partial(_sorting, 2),
    "sorting_6": partial(_sorting, 6),
    "stacking": _stacking,
}
FAULTS = ("collision", "unfinished", "mode", "close", "slow")


def play(
    env,
    recipe: Recipe,
    task: str,
    rows: np.ndarray,
    modes: Sequence[int],
    contexts: np.ndarray | None,
    seeds: Sequence,
    progress: Callable[[int], None],
) -> list[tuple[RawEpisode | None, str]]:
    """Plays one attempt of the episodes ``rows``.

    Args:
        env (ManipulationEnv): one environment per episode of the recording.
        recipe (Recipe): that of the task.
        task (str): name of the task.
        rows (np.ndarray): episodes to play.
        modes (sequence of int): mode asked for in each of them.
        contexts (np.ndarray, optional): context of each of them.
        seeds (sequence): seed of each of them.
        progress (callable): called with the number of episodes that are over.

    Returns:
        list: for each episode its recording and ``""``, or None and what went wrong, one of ``FAULTS``.
    """
    count = env.batch_size[0]
    active = np.zeros(count, dtype=bool)
    active[rows] = True
    expert = recipe.make_expert(modes, contexts, seeds)
    start = torch.from_numpy(active[:, None].copy())
    data = env.reset(env.reset().set("_reset", start), contexts=contexts) if contexts is not None else env.reset()
    logs, touched, lengths = [], np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
    for _ in range(env.max_steps):
        action = np.zeros((count, env.task.action_dim))
        action[rows] = expert.act(data[keys.OBSERVATION].numpy()[rows])
        data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(active[:, None].copy()))
        data = env.step(data)["next"].clone()
        logs.append((env.raw_log(), env.raw_objects()))
        lengths += active
        if recipe.touching is not None:
            touched |= active & recipe.touching(env)
        active[rows] &= ~expert.finished
        active &= ~touched
        progress(int(len(rows) - active[rows].sum() - touched.sum()))
        if not active.any():
            break
    reached = recipe.mode_index(data[keys.MODE]).numpy()
    success = data[keys.SUCCESS].squeeze(-1).numpy()
    results = []
    for index, row in enumerate(rows):
        context = None if contexts is None else _raw_context(contexts[index])
        episode = _episode(logs[: lengths[row]], row, task, context)
        faults = {
            "collision": touched[row],
            "unfinished": active[row] or not success[row],
            "mode": reached[row] != modes[index],
            "close": recipe.clearance is not None and recipe.clearance(episode) < recipe.least_clearance,
            "slow": len(episode) > recipe.most_rows,
        }
        fault = next((name for name in FAULTS if faults[name]), "")
        results.append((None if fault else episode, fault))
    return results


def _raw_context(context: np.ndarray) -> list[list[np.ndarray]]:
    """D3IL's way to write a context: position and yaw in deg, and a quaternion, for every object."""
    return [
        [np.array([x, y, math.degrees(yaw)]), quaternion]
        for (x, y, yaw), quaternion in zip(context, yaw_quaternions(context[:, 2]), strict=True)
    ]


def _episode(logs: list[tuple[dict, dict]], row: int, task: str, context: Any) -> RawEpisode:
    robot = {name: np.stack([log[name][row] for log, _ in logs]) for name in logs[0][0]}
    robot["wall_clock"] = np.rint(robot["time_stamp"] * 1e9).astype(np.int64)  # simulated, so that files are repeatable
    objects = {}
    for name, own in zip(OBJECTS[task], logs[0][1], strict=True):
        poses = np.stack([poses[own][row] for _, poses in logs])
        objects[name] = {"sim_step": robot["sim_step"], "pos": poses[:, :3], "quat": poses[:, 3:]}
    return RawEpisode(robot=robot, objects=objects, context=context)
