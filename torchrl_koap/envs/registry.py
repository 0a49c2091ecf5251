# This source code is licensed under the MIT license found in the LICENSE file.
"""The environment of a task, as ``Task.env`` names it.

What an environment has to offer, D3IL's (:class:`~torchrl_koap.envs.ManipulationEnv`) or one's own::

    EnvBase          batch-locked, batch size [num_envs]; __init__(num_envs, num_threads=, max_steps=, dtype=, ...)
    max_steps        control steps after which an episode is truncated
    reset            reset(contexts=[n, bodies, 3]) starts the episodes there, where the task has bodies; x, y (m), yaw
                     (rad). Without it the environment draws them. One call resets all environments
    set_seed         of the contexts that it draws
    observation      [n, obs]; success [n, 1] bool, latched until the reset; mode [n, ...], what Task.modes.index reads
    collision        [n, 1] bool, where an episode can end by one
    context          [n, bodies, 3], where the task has bodies
    reward, done, terminated, truncated

Films read ``sims.model`` and ``sims.data`` of MuJoCo where they are there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_koap.envs.transforms import EndEffectorNoise
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Task, get_task


def make_env(task: Task | str, num_envs: int = 1, **options: Any) -> EnvBase:
    """Makes the task's environment.

    Args:
        task (Task or str): the task.
        num_envs (int): number of parallel episodes.
        **options: further arguments of the environment, such as ``num_threads``, ``max_steps`` and ``dtype``. They
            join, and go before, ``Task.env_options``.

    Returns:
        EnvBase: the batched environment.

    Raises:
        ValueError: if the task is unknown, or has no environment.

    Examples:
        >>> from torchrl_koap.envs.registry import make_env
        >>> make_env("sorting_2", 3).batch_size
        torch.Size([3])
    """
    task = get_task(task)
    if task.env is None:
        raise ValueError(
            f"task {task.name!r} has no environment (Task.env is None): it can be trained on data, but not rolled out,"
            " recorded or drawn by a simulator. `koap eval --env ID` takes an environment of Gymnasium"
        )
    return resolve(task.env, f"env of task {task.name!r}")(num_envs, **{**task.env_options, **options})


def make_env_of(task: Task, *, num_threads: int = 1) -> Callable[[int], Any]:
    """Returns a function from a number of parallel episodes to the task's environment as policies meet it.

    With ``Task.noise`` the measured end effector is disturbed. A task without an environment is refused at once.
    """
    if task.env is None:
        make_env(task)  # tells so now rather than at the first rollout

    def make(num_envs: int) -> EnvBase:
        env = make_env(task, num_envs, num_threads=num_threads, max_steps=task.max_steps)
        return TransformedEnv(env, EndEffectorNoise(task, task.noise)) if task.noise else env

    return make


def mode_index_of(task: Task | str) -> Callable[[torch.Tensor], torch.Tensor]:
    """Returns the function that turns a task's leaf ``mode`` into a number.

    Args:
        task (Task or str): the task.

    Returns:
        callable: leaf ``mode`` ``[*B, ...]`` to the number of the mode ``[*B]``, int64, -1 while it is not decided; 0
        for a task without modes.

    Examples:
        >>> import torch
        >>> from torchrl_koap.envs import mode_index_of
        >>> mode_index_of("sorting_2")(torch.tensor([[1, 0], [-1, -1]]))
        tensor([ 1, -1])
    """
    task = get_task(task)
    if task.modes.index is None:
        return lambda mode: torch.zeros(mode.shape[:-1], dtype=torch.int64, device=mode.device)
    return resolve(task.modes.index, f"modes.index of task {task.name!r}")
