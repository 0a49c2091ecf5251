# This source code is licensed under the MIT license found in the LICENSE file.
"""Animations: all rollouts at once from above, and one rollout seen by the simulator's camera."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchrl_koap.reports.pictures import Film, NotFilmed, NothingToDraw, picture
from torchrl_koap.reports.rollout_plots import episode_colors
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.scenes import bodies_of, body_paths, draw_scene, keep_inside, read_episodes
from torchrl_koap.reports.style import FAILURE_MARKS, INK, SUCCESS, entry, set_title
from torchrl_koap.tasks import CONTROL_HZ, Task

MOST_FRAMES = 170
FILM_FRAMES = 24  # software rendering takes 0.1 s each
SIZE = 400, 300  # pixels of a film


def _caption(run: RunFacts) -> str:
    objects = " Squares are the objects, pale lines their paths; black marks are tools that ran out of time."
    return (
        "Every dot is one rollout, the thin grey line ahead of it is its present plan. If plans swing from frame to"
        " frame, the planner switches between modes."
    ) + (objects if run.task is not None and run.task.bodies else "")


@picture(
    "rollouts.gif", source="rollouts.safetensors", title="The same rollouts in real time", caption=_caption, order=20
)
def animate_rollouts(rollouts: Mapping[str, Any], run: RunFacts) -> Film:
    """Shows all rollouts from above in real time; plans, if there are any, are thin lines ahead of the dots.

    In tasks with bodies, these are squares in their colours with a thin path, and tools leave no path. Entries
    as for :func:`~torchrl_koap.reports.rollout_plots.draw_plans`.
    """
    if run.offline:
        raise NothingToDraw("it is not known which columns are planar positions")
    longest = max(map(len, read_episodes(rollouts)[0]), default=0)
    if not longest:
        raise NothingToDraw("there are no rollouts")
    stride = max(2, -(-longest // MOST_FRAMES))
    steps = list(range(0, longest, stride))
    steps += [longest - 1] * (steps[-1] != longest - 1)
    return Film(_frames(rollouts, run, steps), stride / (run.control_hz or CONTROL_HZ))


def _frames(rollouts: Mapping[str, Any], run: RunFacts, steps: list[int]) -> Iterator[np.ndarray]:
    """Draws the scene once, adds each new piece of path, and draws dots and plans on top for each frame."""
    paths, mode, outcome = read_episodes(rollouts)
    moving, colors = body_paths(rollouts), episode_colors(mode, outcome, run.modes)
    bodies = bodies_of(run.task, moving[0].shape[1]) if moving else ()
    pales = [tuple(0.45 * np.array(to_rgb(body.color)) + 0.55) for body in bodies]
    plan = entry(rollouts, "plan", [len(paths), None, None, 2])
    plan_step = entry(rollouts, "plan_step", plan.shape[:2])
    figure = Figure(figsize=(4.2, 5.2), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = draw_scene(figure.add_subplot(), run.task)
    axes.set(xlabel="", ylabel="")
    set_title(axes, f"{int((outcome == SUCCESS).sum())} of {len(paths)} rollouts succeed")
    keep_inside(axes, [*paths, *(path.reshape(-1, 2) for path in moving)])
    trails = axes.add_collection(LineCollection([], linewidths=0.5 if bodies else 1.0, animated=True, zorder=3))
    squares = axes.scatter([], [], s=26, marker="s", animated=True, zorder=4, edgecolors="white", linewidths=0.4)
    plans = axes.add_collection(LineCollection([], linewidths=0.6, colors="#565c66", animated=True, alpha=0.75))
    dots = axes.scatter([], [], s=16, animated=True, zorder=5, linewidths=0)
    marks = {
        kind: axes.scatter([], [], s=60, marker=mark, color=INK, edgecolors="white", linewidths=0.8, animated=True)
        for kind, mark in FAILURE_MARKS.items()
    }
    clock = axes.text(0.02, 0.02, "", transform=axes.transAxes, animated=True, fontsize=8)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)

    before, every = 0, range(len(paths))
    for step in steps:
        canvas.restore_region(background)
        moved = [e for e in every if len(paths[e]) > before]
        piece = slice(max(before - 1, 0), step + 1)
        if bodies:
            trails.set_segments([moving[e][piece, index] for e in moved for index in range(len(bodies))])
            trails.set_color([pale for _ in moved for pale in pales])
        else:
            trails.set_segments([paths[e][piece] for e in moved])
            trails.set_color([colors[e] for e in moved])
        axes.draw_artist(trails)
        background = canvas.copy_from_bbox(figure.bbox)
        if bodies:
            present = [path[min(step, len(path) - 1)] for path in moving if len(path)]
            squares.set_offsets(np.concatenate(present) if present else np.zeros((0, 2)))
            squares.set_facecolor([body.color for _ in present for body in bodies])
            axes.draw_artist(squares)
        running = [e for e in every if len(paths[e]) > step + 1]
        latest = [_latest_plan(plan[e], plan_step[e], step) for e in running]
        plans.set_segments([line for line in latest if len(line) > 1])
        axes.draw_artist(plans)
        dots.set_offsets(np.array([paths[e][step] for e in running]).reshape(-1, 2))
        dots.set_color([colors[e] for e in running])
        axes.draw_artist(dots)
        for kind, mark in marks.items():
            ended = [paths[e][-1] for e in every if outcome[e] == kind and 0 < len(paths[e]) <= step + 1]
            mark.set_offsets(np.array(ended).reshape(-1, 2))
            axes.draw_artist(mark)
        clock.set_text(f"step {step}")
        axes.draw_artist(clock)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        before = step + 1


def _latest_plan(plan: np.ndarray, plan_step: np.ndarray, step: int) -> np.ndarray:
    made = np.flatnonzero((plan_step >= 0) & (plan_step <= step))
    if not len(made):
        return np.zeros((0, 2))
    points = plan[made[-1], step - int(plan_step[made[-1]]) :]  # without the executed part
    return points[np.isfinite(points).all(1)]


@picture(
    "film.gif",
    source="rollouts.safetensors",
    title="One rollout as the camera sees it",
    caption="Recorded commands, replayed in the simulator: the first success, or the first rollout if there is none."
    " Long rollouts are shown faster than real time.",
    order=30,
)
def film_rollout(rollouts: Mapping[str, Any], run: RunFacts) -> Film:
    """Replays the actions of the first successful rollout, or of the first one, in the simulator and films them.

    The simulator is deterministic: the film shows what happened if the context is the recorded one to the last digit
    (float64), or the Gymnasium environment is reset with the same seed. Entries: ``action`` ``[E, T, act]`` (NaN after
    the end), ``outcome`` ``[E]``, and ``context`` ``[E, bodies, 3]`` of tasks with bodies: x, y (m), yaw (rad). Raises
    :class:`NotFilmed` if the scene has no camera, or no OpenGL library can be used.
    """
    task, made = run.task, run.evaluation
    if "action" not in rollouts or not (made.get("env") or (task is not None and task.env is not None)):
        raise NothingToDraw("the rollouts hold no actions of a task with a simulator")
    won = np.flatnonzero(entry(rollouts, "outcome", [None]) == SUCCESS)
    index = int(won[0]) if len(won) else 0
    width = None if made.get("env") or task is None else task.action_dim
    actions = entry(rollouts, "action", [None, None, width])[index]
    actions = actions[np.isfinite(actions).all(1)]
    stride = max(2, -(-len(actions) // FILM_FRAMES))
    if made.get("env"):
        return Film(_gymnasium_frames(made, index, actions, stride), 2 / (run.control_hz or CONTROL_HZ))
    if task.scene.camera is None:
        raise NotFilmed(f"task {task.name!r} names no camera of a simulator to film it with")
    context = None
    if task.bodies:
        context = entry(rollouts, "context", [None, len(task.bodies), 3])[index].astype(np.float64)[None]
    try:
        return Film(list(_film_frames(actions.astype(np.float64), task, context, stride)), 2 / task.control_hz)
    except RuntimeError as error:
        raise NotFilmed(error) from error


def _gymnasium_frames(made: Mapping[str, Any], index: int, actions: np.ndarray, stride: int) -> list[np.ndarray]:
    """Films the actions in the Gymnasium environment of an ``eval.json``."""
    import gymnasium  # takes seconds, with the simulator

    from torchrl_koap.envs.gymnasium_batch import GymnasiumEpisode
    from torchrl_koap.evaluation.config import environment_arguments

    given, frames = environment_arguments(made.get("env_kwargs") or ()), list[np.ndarray]()
    try:
        with contextlib.closing(gymnasium.make(made["env"], **(given | {"render_mode": "rgb_array"}))) as env:
            episode = GymnasiumEpisode(env, 0, max_steps=len(actions))
            episode.reset(seed=made["episode"][index]["seed"])
            for number, action in enumerate(actions):
                if number % stride == 0:
                    frames.append(np.asarray(env.render(), np.uint8))
                episode.step(action)
            frames.append(np.asarray(env.render(), np.uint8))
    except Exception as error:  # any error of an external environment
        raise NotFilmed(f"environment {made['env']!r} was not filmed: {error!r}") from error
    if any(frame.ndim != 3 or frame.shape != frames[0].shape for frame in frames):
        raise NotFilmed(f"environment {made['env']!r} draws no picture [height, width, 3]")
    return frames


def _film_frames(actions: np.ndarray, task: Task, context: np.ndarray | None, stride: int) -> Iterator[np.ndarray]:
    """Films the start, every ``stride`` steps, and the end."""
    import torch  # takes seconds, with the simulator

    from torchrl_koap.envs.mujoco.rendering import Renderer
    from torchrl_koap.envs.registry import make_env

    with (
        contextlib.closing(make_env(task, 1, max_steps=len(actions) + 1, dtype=torch.float64)) as env,
        contextlib.closing(Renderer(env.sims.model, *SIZE, shadows=False)) as renderer,
    ):
        data = env.reset() if context is None else env.reset(contexts=context)
        yield renderer.render(env.sims.data[0], task.scene.camera)
        for number, action in enumerate(actions):
            data = env.step(data.set("action", data["observation"].new_tensor(action[None])))["next"]
            last = number == len(actions) - 1 or bool(data["done"].any())
            if last or number % stride == stride - 1:
                yield renderer.render(env.sims.data[0], task.scene.camera)
            if last:
                return
