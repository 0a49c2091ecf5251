# This source code is licensed under the MIT license found in the LICENSE file.
"""Records Scooping: camera frames of a robot with its joint targets, or of a hand without actions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_koap.data.formats.writers import LeRobotWriter
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.scooping.expert import HABITS, ScoopingExpert, SpoonKinematics, start_episodes
from torchrl_koap.envs.scooping.simulation import ScoopingSimulations
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.tasks.scooping import CAMERA, EMBEDDING_DIM, FRAME_HZ, IMAGE_SIZE, STARTS, start_of

AFTERWARDS = 12  # frames after a success: labels of the last look-ahead steps cannot train a controller
MAX_ATTEMPTS = 10


@dataclass(frozen=True)
class VideoReport:
    """Counts of a recording."""

    embodiment: str  # "robot" or "hand"
    episodes: int  # demonstrations that were kept
    attempts: int  # demonstrations that were played
    frames: int  # of the kept demonstrations
    again: int  # number of kept demonstrations that scooped more than once

    def __str__(self) -> str:
        kept = f"{self.episodes} demonstrations by a {self.embodiment}, {self.frames} frames"
        return f"{kept}; {self.attempts} were played to get them, {self.again} scoop more than once"


def _context_at(task: Task, start: int, generator: np.random.Generator) -> np.ndarray:
    while True:
        context = draw_contexts(task, 1, generator)[0]
        if start_of(context) == start:
            return context


def _play(
    task: Task, sims: ScoopingSimulations, expert: ScoopingExpert, renderer: Renderer
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns frames uint8 ``[T + 1, H, W, 3]``, states ``[T + 1, d]``, targets ``[T, nu]``; None without success."""
    frames, states, targets, after = [], [], [], 0
    width = task.observation_dim - EMBEDDING_DIM  # without the bowl's place if it never moves

    def look() -> None:
        frames.append(renderer.render(sims.data[0], CAMERA))
        states.append(np.append(sims.spoon_position[0], sims.bowl_positions[0])[:width])

    look()
    for _ in range(task.max_steps):
        target = expert.target()
        if expert.finished:
            break
        sims.advance(np.zeros(1, dtype=np.int64), target[None])
        look()
        targets.append(target)
        after += int(sims.success[0])
        if after > AFTERWARDS:
            break
    return (np.stack(frames), np.stack(states), np.stack(targets)) if sims.success[0] else None


def record_videos(
    folder: str | Path,
    embodiment: str,
    episodes: int,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    *,
    task: Task | str = "scooping",
) -> VideoReport:
    """Records demonstrations of a ``"robot"``, or of a ``"hand"`` without actions, as a LeRobot data set with pictures.

    They begin at the start positions in turn. A failed one is repeated from another place. Robot and hand never share a
    start. ``progress`` is called with the number of demonstrations recorded and wanted. Raises an error if the folder
    is not empty.
    """
    task = get_task(task)
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    sims = ScoopingSimulations(embodiment, 1)
    writer = LeRobotWriter(
        folder,
        fps=FRAME_HZ,
        state_names=("spoon_x", "spoon_y", "spoon_z", *task.observation_names[EMBEDDING_DIM + 3 :]),
        action_names=task.action_names if embodiment == "robot" else (),
        camera=f"observation.images.{CAMERA}",
        embodiment=embodiment,
        task="take a piece out of the bowl with the spoon",
    )
    arm, stream = SpoonKinematics(), sorted(HABITS).index(embodiment)
    attempts, frames, again = 0, 0, 0
    with closing(sims), closing(Renderer(sims.model, IMAGE_SIZE, IMAGE_SIZE, shadows=False)) as renderer:
        for number in range(episodes):
            for attempt in range(MAX_ATTEMPTS):
                own = (seed, stream, number, attempt)
                context = _context_at(task, number % len(STARTS), np.random.default_rng((*own, 1)))
                start_episodes(sims, np.array([0]), context[None], arm)
                expert = ScoopingExpert(sims, 0, start_of(context), own)
                episode = _play(task, sims, expert, renderer)
                attempts += 1
                if episode is not None:
                    break
            else:
                raise RuntimeError(f"the {embodiment} never succeeded in {MAX_ATTEMPTS} attempts, episode {number}")
            pictures, states, targets = episode
            writer.add(states, targets, frames=pictures)
            frames, again = frames + len(pictures), again + int(expert.attempts > 1)
            if progress is not None:
                progress(number + 1, episodes)
    writer.close()
    return VideoReport(embodiment, episodes, attempts, frames, again)
