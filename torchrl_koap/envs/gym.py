# This source code is licensed under the MIT license found in the LICENSE file.
"""The tasks as single Gymnasium environments, registered under ``torchrl_koap/<Task>-v0``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap import keys
from torchrl_koap.envs.avoiding import ACTION_BOUND, AvoidingEnv, mode_index


class AvoidingGymEnv(gymnasium.Env):
    """One :class:`~torchrl_koap.envs.avoiding.AvoidingEnv` behind Gymnasium's interface.

    Observation float32 [4]: commanded xy, measured TCP xy (m). Action float32 [2]: change of the commanded xy (m); the
    action space is the range of human demonstrators, larger actions are executed unchanged. Reward 1 in the step that
    reports success, else 0. ``info`` holds ``success``, ``collision`` (bool), ``mode`` (bool [9]) and ``mode_index``.

    Args:
        render_mode (str, optional): ``"rgb_array"`` or None.
        max_steps (int): control steps after which an episode is truncated.
        width (int): width of pictures in pixels.
        height (int): height of pictures in pixels.
        camera (str): camera of pictures, see :meth:`~torchrl_koap.envs.base.ManipulationEnv.render`.

    Raises:
        ValueError: for another ``render_mode``, or actions of a wrong shape or that are not finite.

    Examples:
        >>> import gymnasium
        >>> import torchrl_koap.envs  # registers
        >>> env = gymnasium.make("torchrl_koap/Avoiding-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["mode_index"]
        ((4,), -1)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 29}

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        max_steps: int = 250,
        width: int = 480,
        height: int = 480,
        camera: str = "front",
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self.batched = AvoidingEnv(1, max_steps=max_steps)
        self._picture = {"width": width, "height": height, "camera": camera}
        size = self.batched.task.observation_dim
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-ACTION_BOUND, ACTION_BOUND, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; every episode starts in the same state."""
        super().reset(seed=seed)
        return self._split(self.batched.reset())

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Moves the commanded xy by ``action`` (m) and runs one control step of 35 ms."""
        action = torch.as_tensor(np.asarray(action, dtype=np.float32))[None]
        data = self.batched.step(TensorDict({keys.ACTION: action}, [1]))["next"]
        observation, info = self._split(data)
        return observation, data["reward"].item(), data["terminated"].item(), data["truncated"].item(), info

    def render(self) -> np.ndarray | None:
        """Picture of the scene, uint8 [height, width, 3], or None without ``render_mode``."""
        return self.batched.render(**self._picture) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Frees graphics memory."""
        self.batched.close()

    def _split(self, data) -> tuple[np.ndarray, dict[str, Any]]:
        info = {
            keys.SUCCESS: data[keys.SUCCESS].item(),
            keys.COLLISION: data[keys.COLLISION].item(),
            keys.MODE: data[keys.MODE][0].numpy(),
            "mode_index": mode_index(data[keys.MODE]).item(),
        }
        return data[keys.OBSERVATION][0].numpy(), info


def register() -> None:
    """Makes ``gymnasium.make("torchrl_koap/Avoiding-v0")`` work; importing ``torchrl_koap.envs`` calls it."""
    if "torchrl_koap/Avoiding-v0" not in gymnasium.registry:
        gymnasium.register("torchrl_koap/Avoiding-v0", entry_point="torchrl_koap.envs.gym:AvoidingGymEnv")
