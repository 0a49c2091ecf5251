# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording Scooping: camera frames of a robot with its joint targets, or of a hand without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchrl_koap.data.formats.writers import LeRobotWriter
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.scooping.expert import HABITS, ScoopingExpert, SpoonKinematics, start_joints
from torchrl_koap.envs.scooping.simulation import ScoopingSimulations
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.tasks.scooping import CAMERA, EMBEDDING_DIM, FRAME_HZ, IMAGE_SIZE, STARTS, start_of

AFTERWARDS = 12  # frames that are recorded after a success: a controller's labels end before its look-ahead does
MAX_ATTEMPTS = 10


@dataclass(frozen=True)
class FilmedEpisode:
    """A demonstration: frames uint8 ``[T + 1, H, W, 3]``, the rest ``[T + 1, d]``, actions ``[T, act]`` or None."""

    frames: np.ndarray
    state: np.ndarray
    action: np.ndarray | None


@dataclass(frozen=True)
class VideoReport:
    """What a recording came to."""

    embodiment: str  # who was recorded
    episodes: int  # demonstrations that were kept
    attempts: int  # demonstrations that were played
    frames: int  # of those that were kept
    again: int  # how many of those scooped more than once

    def __str__(self) -> str:
        kept = f"{self.episodes} demonstrations by a {self.embodiment}, {self.frames} frames"
        return f"{kept}; {self.attempts} were played to get them, {self.again} scoop more than once"


def _play_episodes(embodiment: str, episodes: int, seed: int, task: str) -> Iterator[tuple[FilmedEpisode, int, int]]:
    """Plays demonstrations in their order; one that does not succeed is played again, from another place.

    They begin at the start positions in turn, so that the first few of them have seen them all. Also told: how often
    each was played, and how often the spoon went into the bowl.
    """
    sims, arm = ScoopingSimulations(embodiment, 1), SpoonKinematics()
    renderer = Renderer(sims.model, IMAGE_SIZE, IMAGE_SIZE, shadows=False)
    stream, rows = sorted(HABITS).index(embodiment), np.zeros(1, dtype=np.int64)
    try:
        for number in range(episodes):
            for attempt in range(MAX_ATTEMPTS):
                own = (seed, stream, number, attempt)
                context = _context_at(task, number % len(STARTS), np.random.default_rng((*own, 1)))
                bowls = context[None, 1, :2] if len(context) > 1 else None
                sims.reset(rows, start_joints(context, embodiment, arm)[None], [context[0, 2]], bowls)
                expert = ScoopingExpert(sims, 0, start_of(context), own)
                episode = _play(sims, expert, lambda: renderer.render(sims.data[0], CAMERA))
                if episode is None:
                    continue
                if bowls is not None:
                    stands = np.repeat(bowls, len(episode.frames), axis=0)
                    episode = replace(episode, state=np.concatenate([episode.state, stands], axis=1))
                yield episode, attempt + 1, expert.attempts
                break
            else:
                raise RuntimeError(f"the {embodiment} never succeeded in {MAX_ATTEMPTS} attempts, episode {number}")
    finally:
        renderer.close()
        sims.close()


def _context_at(task: str, start: int, generator: np.random.Generator) -> np.ndarray:
    while True:
        context = draw_contexts(task, 1, generator)[0]
        if start_of(context) == start:
            return context


def _play(sims: ScoopingSimulations, expert: ScoopingExpert, draw: Callable[[], np.ndarray]) -> FilmedEpisode | None:
    rows = np.zeros(1, dtype=np.int64)
    frames, spoons, actions, after = [draw()], [sims.spoon_position[0]], [], 0
    for _ in range(get_task("scooping").max_steps):
        target = expert.target()
        if expert.finished:
            break
        sims.advance(rows, target[None])
        frames.append(draw())
        spoons.append(sims.spoon_position[0])
        actions.append(target)
        after += int(sims.success[0])
        if after > AFTERWARDS:
            break
    if not sims.success[0]:
        return None
    labels = np.stack(actions) if sims.embodiment == "robot" else None
    return FilmedEpisode(np.stack(frames), np.stack(spoons), labels)


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

    The two never share a start. ``progress`` is called with the number of demonstrations recorded and wanted. A folder
    that is not empty is refused.
    """
    task = get_task(task)
    lookup(HABITS, embodiment, "embodiment")
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    writer = LeRobotWriter(
        folder,
        fps=FRAME_HZ,
        state_names=("spoon_x", "spoon_y", "spoon_z", *task.observation_names[EMBEDDING_DIM + 3 :]),
        action_names=task.action_names if embodiment == "robot" else (),
        camera=f"observation.images.{CAMERA}",
        embodiment=embodiment,
        task="take a piece out of the bowl with the spoon",
    )
    attempts, frames, again = 0, 0, 0
    for number, (episode, played, scooped) in enumerate(_play_episodes(embodiment, episodes, seed, task.name), 1):
        writer.add(episode.state, episode.action, frames=episode.frames)
        attempts, frames, again = attempts + played, frames + len(episode.frames), again + int(scooped > 1)
        if progress is not None:
            progress(number, episodes)
    writer.close()
    return VideoReport(embodiment, episodes, attempts, frames, again)
