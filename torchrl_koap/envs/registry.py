# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes the environment that ``Task.env`` names; import registers D3IL's with Gymnasium, too.

Interface of an environment, D3IL's (:class:`~torchrl_koap.envs.ManipulationEnv`) or your own::

    EnvBase          batch-locked, batch size [num_envs]; __init__(num_envs, num_threads=, max_steps=, dtype=, ...)
    max_steps        control steps after which an episode is truncated
    reset            reset(contexts=[n, bodies, 3]) places the bodies of the task, if it has any; x, y (m), yaw (rad).
                     Without it the environment draws them. One call resets all environments
    set_seed         seeds all that it draws; rollouts and recordings call it with the seed of their first episode
    observation      [n, obs]; success [n, 1] bool, latched until the reset; mode [n, ...], one of Task.modes.leaves
    collision        [n, 1] bool, if an episode can end by one
    context          [n, bodies, 3], if bodies of the task start elsewhere in each episode
    reward, done, terminated, truncated

Videos read ``sims.model`` and ``sims.data`` of MuJoCo if they exist.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_koap import keys
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.transforms import EndEffectorNoise
from torchrl_koap.files import refuse
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Task, get_task


def make_env(task: Task | str, num_envs: int = 1, *, noisy: bool = False, **options: Any) -> EnvBase:
    """Makes the task's environment.

    Args:
        task (Task or str): the task, or its name.
        num_envs (int): number of parallel episodes.
        noisy (bool): adds ``Task.noise`` to the measured end effector, as in rollouts of policies.
        **options: further arguments of the environment, such as ``num_threads`` and ``dtype``. They override
            ``Task.env_options`` and ``Task.max_steps``.

    Returns:
        EnvBase: the batched environment.

    Raises:
        ValueError: if the task is unknown, or has no environment; if its environment lacks a part of the interface.

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
    options = {"max_steps": task.max_steps, **task.env_options, **options}
    what = f"env of task {task.name!r}"
    make = resolve(task.env, what)
    try:
        env = make(num_envs, **options)
    except TypeError as error:
        raise ValueError(f"{what}: {task.env!r} cannot be made: {error}") from error
    refuse(what, _env_faults(env, task, num_envs))
    return TransformedEnv(env, EndEffectorNoise(task, task.noise)) if noisy and task.noise else env


def _env_faults(env: EnvBase, task: Task, num_envs: int) -> list[str]:
    """Lists what an environment lacks of the interface above."""
    if list(env.batch_size) != [num_envs]:
        return [f"its batch size is {list(env.batch_size)}, wanted [{num_envs}]"]
    if getattr(env, "max_steps", None) is None:
        return ["it has no attribute 'max_steps'"]
    wanted = [keys.OBSERVATION, keys.SUCCESS, keys.MODE, *([keys.CONTEXT] if task.scene.varies else [])]
    entries = set(env.observation_spec.keys())
    if missing := [name for name in wanted if name not in entries]:
        return [f"its observation_spec has no entry {name!r}" for name in missing]
    widths = {
        "observations": (env.observation_spec[keys.OBSERVATION].shape[-1], task.observation_dim),
        "actions": (env.action_spec.shape[-1], task.action_dim),
    }
    return [f"its {part} have {own} columns, the task's {ours}" for part, (own, ours) in widths.items() if own != ours]


IDS = {"Avoiding-v0": "avoiding", "Aligning-v0": "aligning", "Stacking-v0": "stacking"}
IDS |= {"Sorting4-v0": "sorting", "Sorting2-v0": "sorting_2", "Sorting6-v0": "sorting_6"}


class ManipulationGymEnv(gymnasium.Env):
    """Gives one environment of a task Gymnasium's interface.

    Observation and action are those of the batched environment in float32, and ``info`` holds

    ============== ============================ ====================================================================
    key            type                         meaning
    ============== ============================ ====================================================================
    ``success``    bool                         the task is done
    ``collision``  bool                         only if an episode can end by one (Avoiding)
    ``mode``       bool or int64 array          leaf ``mode`` of the batched environment
    ``mode_index`` int                          number of the mode, -1 while it is not decided
    ``context``    float64 ``[objects, 3]``     only in tasks with objects: where they start, x, y (m) and yaw (rad)
    ============== ============================ ====================================================================

    Args:
        task (str): name of the task.
        render_mode (str, optional): ``"rgb_array"`` or None.
        width, height (int): size of pictures in pixels.

    Raises:
        ValueError: for an unknown task, another ``render_mode``, or actions of a wrong shape or that are not finite.

    Examples:
        >>> import gymnasium
        >>> import torchrl_koap.envs  # registers
        >>> env = gymnasium.make("torchrl_koap/Sorting2-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["mode_index"], info["context"].shape
        ((10,), -1, (2, 3))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 29}

    def __init__(self, task: str, render_mode: str | None = None, *, width: int = 480, height: int = 480):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        facts = get_task(task)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(facts.control_hz)}
        self.task = facts
        self.batched = make_env(facts, dtype=torch.float64)
        self._size = {"width": width, "height": height}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (facts.observation_dim,), np.float32)
        low, high = (
            bound[0].float().numpy() for bound in (self.batched.action_spec.low, self.batched.action_spec.high)
        )
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; ``options["context"]`` ``[objects, 3]`` places objects, by default at random.

        Raises:
            ValueError: for another option, or a context of a wrong shape, out of range, or of a task without objects.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        context = options.pop("context", None)
        if options:
            raise ValueError(f"the only option of reset() is 'context', got {', '.join(map(repr, options))}")
        if context is None and not self.task.objects:
            return self._split(self.batched.reset())
        contexts = draw_contexts(self.task, 1, self.np_random) if context is None else np.asarray(context)[None]
        return self._split(self.batched.reset(contexts=contexts))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Executes an action and runs one control step (35 ms, Stacking 30 ms)."""
        action = torch.as_tensor(np.asarray(action, dtype=np.float32))[None]
        data = self.batched.step(TensorDict({keys.ACTION: action}, [1]))["next"]
        observation, info = self._split(data)
        return observation, data["reward"].item(), data["terminated"].item(), data["truncated"].item(), info

    def render(self) -> np.ndarray | None:
        """Draws the scene, uint8 [height, width, 3]; None without ``render_mode``."""
        camera = self.task.scene.camera
        return self.batched.render(**self._size, camera=camera) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Frees graphics memory."""
        self.batched.close()

    def _split(self, data) -> tuple[np.ndarray, dict[str, Any]]:
        info = {
            keys.SUCCESS: data[keys.SUCCESS].item(),
            keys.MODE: data[keys.MODE][0].numpy(),
            "mode_index": self.task.modes.index_of(data[keys.MODE]).item(),
        }
        if keys.COLLISION in data.keys():
            info[keys.COLLISION] = data[keys.COLLISION].item()
        if self.task.objects:
            info[keys.CONTEXT] = data[keys.CONTEXT][0].numpy()
        return data[keys.OBSERVATION][0].float().numpy(), info


for _id, _task in IDS.items():
    gymnasium.register(f"torchrl_koap/{_id}", f"{__name__}:ManipulationGymEnv", kwargs={"task": _task})
