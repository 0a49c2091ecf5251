# This source code is licensed under the MIT license found in the LICENSE file.
"""One rollout as the simulator's camera sees it: recorded actions, played again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from torchrl_koap.reports.pictures import Film, NotFilmed, NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import SUCCESS, entry
from torchrl_koap.tasks import Task

MOST_FRAMES = 24  # software rendering takes 0.1 s each
SIZE = 400, 300  # pixels


@picture(
    "film.gif",
    source="rollouts.safetensors",
    title="One rollout as the camera sees it",
    caption="Recorded commands, played again in the simulator: the first success, or the first rollout if there is"
    " none. Long ones pass faster than they did.",
    order=30,
)
def film_rollout(rollouts: Mapping[str, Any], run: RunFacts) -> Film:
    """Plays the actions of the first successful rollout, or of the first one, again in the simulator and films them.

    Nothing but the context is drawn at random and the simulator repeats itself exactly, so the film shows what
    happened, as long as the context is the recorded one to the last digit (float64).

    Args:
        rollouts (mapping): ``action`` ``[E, T, act]`` (NaN after the end), ``outcome`` ``[E]``, ``context``
            ``[E, bodies, 3]`` of tasks with bodies: x, y (m), yaw (rad).

    Raises:
        NothingToDraw: if actions were not kept, or the task is not known.
        NotFilmed: if the scene has no camera, or no OpenGL library can be used; the message says what to install.
        ValueError: for a wrong shape, or no context where one is needed.
    """
    task = run.task
    if task is None or task.env is None or "action" not in rollouts:
        raise NothingToDraw("the rollouts hold no actions of a task with a simulator")
    if task.scene.camera is None:
        raise NotFilmed(f"task {task.name!r} names no camera of a simulator to film it with")
    won, context = np.flatnonzero(entry(rollouts, "outcome", [None]) == SUCCESS), None
    index = int(won[0]) if len(won) else 0
    actions = entry(rollouts, "action", [None, None, task.action_dim])[index]
    actions = actions[np.isfinite(actions).all(1)].astype(np.float64)
    if task.bodies:
        if "context" not in rollouts:
            raise ValueError(f"task {task.name!r} starts differently every time: a film needs the 'context'")
        context = entry(rollouts, "context", [None, len(task.bodies), 3])[index].astype(np.float64)[None]
    stride = max(2, -(-len(actions) // MOST_FRAMES))
    try:
        return Film(list(_frames(actions, task, context, stride)), 2 / task.control_hz)
    except RuntimeError as error:
        raise NotFilmed(error) from error


def _frames(actions: np.ndarray, task: Task, context: np.ndarray | None, stride: int) -> Iterator[np.ndarray]:
    """The start, every so many steps, and the end."""
    import torch  # it and the simulator take seconds

    from torchrl_koap.envs.mujoco.rendering import Renderer
    from torchrl_koap.envs.registry import make_env

    env = make_env(task, 1, max_steps=len(actions) + 1, dtype=torch.float64)
    renderer: Any = None
    try:
        renderer = Renderer(env.sims.model, *SIZE, shadows=False)
        data = env.reset() if context is None else env.reset(contexts=context)
        yield renderer.render(env.sims.data[0], task.scene.camera)
        for number, action in enumerate(actions):
            data = env.step(data.set("action", data["observation"].new_tensor(action[None])))["next"]
            last = number == len(actions) - 1 or bool(data["done"].any())
            if last or number % stride == stride - 1:
                yield renderer.render(env.sims.data[0], task.scene.camera)
            if last:
                return
    finally:
        if renderer is not None:
            renderer.close()
        env.close()
