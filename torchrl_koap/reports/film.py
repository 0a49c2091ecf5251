# This source code is licensed under the MIT license found in the LICENSE file.
"""One rollout as the simulator's camera sees it: recorded actions, played again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from torchrl_koap.reports.pictures import NotFilmed, NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import SUCCESS, as_array
from torchrl_koap.reports.writing import Film
from torchrl_koap.tasks import Task

MOST_FRAMES = 24  # software rendering takes 0.1 s each


@picture(
    "film.gif",
    source="rollouts.safetensors",
    title="One rollout as the camera sees it",
    caption="Recorded commands, played again in the simulator: the first success, or the first rollout if there is"
    " none. Long ones pass faster than they did.",
    order=30,
)
def film_rollout(rollouts: Mapping[str, Any], run: RunFacts) -> Film:
    """Films the first successful rollout, or the first one if there is none.

    Args:
        rollouts (mapping): ``action`` ``[E, T, act]``, ``outcome`` ``[E]``, ``context`` ``[E, bodies, 3]`` of tasks
            with any.
        run (RunFacts): the run.

    Raises:
        NothingToDraw: if actions were not kept, or the task is not known.
        NotFilmed: if no OpenGL library can be used.
    """
    if run.task is None or run.task.env is None or "action" not in rollouts:
        raise NothingToDraw("the rollouts hold no actions of a task with a simulator")
    won = np.flatnonzero(rollouts["outcome"] == SUCCESS)
    index = int(won[0]) if len(won) else 0
    context = rollouts["context"][index] if "context" in rollouts else None
    try:
        return film_actions(rollouts["action"][index], run.task, context=context)
    except RuntimeError as error:
        raise NotFilmed(error) from error


def film_actions(actions: Any, task: Task, *, context: Any = None, width: int = 400, height: int = 300) -> Film:
    """Plays recorded actions again in the task's environment and films them.

    Nothing but the context is drawn at random and the simulator repeats itself exactly, so the film shows what
    happened, as long as the context is the recorded one to the last digit (float64).

    Args:
        actions (array): one episode's actions ``[T, act]``; rows with NaN are left out.
        task (Task): the task.

    Keyword Args:
        context (array, optional): where the bodies start ``[bodies, 3]``, in a task that has any: x, y (m), yaw (rad).
        width (int): width in pixels.
        height (int): height in pixels.

    Returns:
        Film: at most some two dozen frames, each of two control steps or more but never shown for longer than two.

    Raises:
        ValueError: for a wrong shape, or no context where one is needed.
        RuntimeError: if no OpenGL library can be used; the message says what to install.
    """
    if task.env is None or task.scene.camera is None:
        raise RuntimeError(f"task {task.name!r} names no camera of a simulator to film it with")
    actions = as_array("actions", actions, [None, task.action_dim])
    actions = actions[np.isfinite(actions).all(1)].astype(np.float64)
    if task.bodies:
        if context is None:
            raise ValueError(f"task {task.name!r} starts differently every time: a film needs the 'context'")
        context = as_array("context", context, [len(task.bodies), 3]).astype(np.float64)[None]
    stride = max(2, -(-len(actions) // MOST_FRAMES))
    return Film(list(_frames(actions, task, context, stride, (width, height))), 2 / task.control_hz)


def _frames(
    actions: np.ndarray, task: Task, context: np.ndarray | None, stride: int, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    import torch  # it and the simulator take seconds

    from torchrl_koap.envs.mujoco.rendering import Renderer
    from torchrl_koap.envs.registry import make_env

    env = make_env(task, 1, max_steps=len(actions) + 1, dtype=torch.float64)
    renderer: Any = None
    try:
        renderer = Renderer(env.sims.model, *size, shadows=False)
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
