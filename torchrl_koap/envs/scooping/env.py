# This source code is licensed under the MIT license found in the LICENSE file.
"""Scooping: a Panda takes pieces out of a bowl with a spoon; the state is the embedding of a camera frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Unbounded

from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.scooping.expert import SpoonKinematics, start_episodes
from torchrl_koap.envs.scooping.simulation import ScoopingSimulations
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.scooping import CAMERA, EMBEDDING_DIM, FRAME_HZ, IMAGE_SIZE
from torchrl_koap.vision.encoder import FrozenImageEncoder, load_encoder, projection_of

JOINT_SPEED = 2.5  # rad/s; largest speed towards a target
PIXELS = "pixels"


class ScoopingEnv(ManipulationEnv):
    """Scooping as a native-batch TorchRL environment on MuJoCo.

    =============== ============ ================= ============================================================
    key             shape        dtype             meaning
    =============== ============ ================= ============================================================
    ``observation`` [n, 99]      ``dtype``         0-95 embedding of the camera's frame, 96-98 the spoon's
                                                   position (m), which planner and controller never see
    ``action``      [n, 7]       ``dtype``         joint targets (rad) for the end of the step, absolute
    ``pixels``      [n, H, W, 3] uint8             the frame, with ``pixels=True``
    ``success``     [n, 1]       bool              the spoon has left the bowl with a piece on it
    ``mode``        [n, 1]       bool              the spoon has reached over the rim
    ``context``     [n, 1, 3]    ``dtype``         start of the spoon, x, y (m); layout of the pieces (rad)
    =============== ============ ================= ============================================================

    A step is a frame of 100 ms, in which the joints' servos are commanded three times (30 Hz), on a straight line from
    the last target to the new one. *Over the rim*: the middle of the spoon's floor is inside the rim's circle and less
    than 5 cm above it. *Success*: afterwards the spoon is 4 cm above the rim and carries a piece for 0.2 s. There is no
    failure. Unlike in D3IL's tasks, the observation is the present frame. If the bowl moves, columns 99 and 100 and a
    second row of the context are its position (m).

    Args and errors are those of :class:`~torchrl_koap.envs.base.ManipulationEnv`, and

    Keyword Args:
        task (str): ``"scooping"``, or ``"scooping_moving_bowl"``, whose bowl moves between episodes.
        encoder (FrozenImageEncoder, optional): embeds the frames. Default: EfficientNet-Lite0 and the projection
            of the task that comes with the package.
        embed (bool): embed the frames. If False, the embedding is zero, and neither OpenGL nor weights are needed.
        pixels (bool): return the frames, too.

    Raises:
        ValueError: for an embedding of another size than the task's, or weights that do not match the projection.
        RuntimeError: if there is no OpenGL library, or the extra with the weights is missing.

    Examples:
        >>> from torchrl_koap.envs import ScoopingEnv
        >>> env = ScoopingEnv(num_envs=2, seed=0, embed=False)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 99])
    """

    def __init__(
        self,
        *args: Any,
        task: str = "scooping",
        encoder: FrozenImageEncoder | None = None,
        embed: bool = True,
        pixels: bool = False,
        **options: Any,
    ):
        self._arm = SpoonKinematics()
        chosen = (encoder or load_encoder(projection_of(task))) if embed else None
        if chosen is not None:
            dim = 0 if chosen.projection is None else chosen.projection.dim
            if dim != EMBEDDING_DIM:
                raise ValueError(f"the encoder's projection must have {EMBEDDING_DIM} components, got {dim}")
        super().__init__(*args, task=get_task(task), **options)
        self._encoder = chosen
        self._pixels = np.zeros((*self.batch_size, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        self._return_pixels = pixels
        self._camera: Renderer | None = None
        if pixels:
            self.observation_spec[PIXELS] = Unbounded(self._pixels.shape, dtype=torch.uint8, device=self.device)
        if embed or pixels:
            self._camera = Renderer(self.sims.model, IMAGE_SIZE, IMAGE_SIZE, shadows=False)

    @property
    def ACTION_BOUND(self) -> tuple:
        """Range of the joints (rad)."""
        return tuple(self._arm.low), tuple(self._arm.high)

    def _simulations(self, num_envs: int, num_threads: int) -> ScoopingSimulations:
        return ScoopingSimulations("robot", num_envs, num_threads)

    def _start(self, rows: np.ndarray) -> None:
        start_episodes(self.sims, rows, self._contexts[rows], self._arm)

    def _begin(self, rows: np.ndarray) -> None:
        self._commands[rows] = self.sims.commands[rows]

    def _command(self, rows: np.ndarray, action: np.ndarray) -> None:
        reach = JOINT_SPEED / FRAME_HZ
        targets = np.clip(action, self._arm.low, self._arm.high)
        self._commands[rows] += np.clip(targets - self._commands[rows], -reach, reach)

    def _advance(self, rows: np.ndarray) -> None:
        self.sims.advance(rows, self._commands)

    def _observe(self, rows: np.ndarray) -> np.ndarray:
        embedding = np.zeros((len(rows), EMBEDDING_DIM))
        if self._camera is not None and len(rows):
            self._pixels[rows] = [self._camera.render(self.sims.data[row], CAMERA) for row in rows]
            if self._encoder is not None:
                embedding = self._encoder.embed(torch.from_numpy(self._pixels[rows])).double().numpy()
        seen = (embedding, self.sims.spoon_position[rows], self.sims.bowl_positions[rows])
        return np.concatenate(seen, axis=1)[:, : self.task.observation_dim]  # the bowl only if it moves

    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.sims.success[rows], np.zeros(len(rows), dtype=bool)

    def _update_mode(self, rows: np.ndarray) -> None:
        self._mode[rows, 0] = self.sims.rim[rows]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepped = self._rows(tensordict, "_step")
        rows = stepped[~self._success[stepped]]  # finished episodes do not change and need no frame
        self._command(rows, self._checked_action(tensordict, rows))
        self._advance(rows)
        self._steps[rows] += 1
        self._update_mode(rows)
        self._success[rows] = self._check(rows)[0]
        self._observation[rows] = self._observe(rows)
        return self._stepped(stepped)

    def _leaves(self) -> TensorDictBase:
        leaves = super()._leaves()
        if self._return_pixels:
            leaves.set(PIXELS, self._tensor(self._pixels))
        return leaves

    def close(self, **kwargs) -> None:
        """Frees graphics memory and threads."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        super().close(**kwargs)
