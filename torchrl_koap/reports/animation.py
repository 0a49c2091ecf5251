# This source code is licensed under the MIT license found in the LICENSE file.
"""Moving pictures of rollouts: from above without any graphics library, or as the simulator's camera sees them."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchrl_koap.reports.mode_colors import mode_colors
from torchrl_koap.reports.objects import object_looks, object_paths
from torchrl_koap.reports.paths import executed_paths, has_objects, keep_inside
from torchrl_koap.reports.pictures import NotFilmed, NothingToDraw, picture
from torchrl_koap.reports.scenes import draw_scene
from torchrl_koap.reports.style import FAILURE_MARKS, INK, NO_MODE, SUCCESS, as_array, set_title
from torchrl_koap.tasks.registry import get_task

HOLD_SECONDS = 1.5
MOST_PICTURES = 170  # of an animation from above, unless a stride is given
FILM_PICTURES = 24  # of a film likewise: software rendering takes 0.1 s each
_VIDEO = "a .mp4 needs imageio with ffmpeg: pip install imageio imageio-ffmpeg, or write a .gif"


@picture(
    "rollouts.gif",
    source="rollouts.safetensors",
    title="The same rollouts in real time",
    caption="Every dot is one rollout, the thin grey line ahead of it is its present plan. Plans that swing from"
    " picture to picture mean a planner that cannot make up its mind between modes.",
    caption_of=has_objects(
        " Squares are the objects, pale lines their paths; black marks are tools that ran out of time."
    ),
    place=20,
)
def animate_rollouts(
    rollouts: Mapping[str, Any],
    path: str | Path,
    *,
    episodes: Sequence[int] | None = None,
    task: str | None = "avoiding",
    num_modes: int | None = None,
    control_hz: float = 1 / 0.035,
    stride: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """All rollouts at once from above, in real time, as a gif; plans are thin lines ahead of the dots.

    The bodies of tasks that have them are squares in their colours with a thin path; tools then leave no path.

    Args:
        rollouts (mapping): ``position`` [E, T, 2] (m), ``length``, ``mode``, ``outcome`` [E] and, optionally, ``plan``
            [E, P, H, 2] with ``plan_step`` [E, P], and ``object_position`` [E, T, objects, 2]; see
            :func:`~torchrl_koap.reports.rollout_plots.plot_rollouts`.
        path (str or Path): gif to write.
        episodes (sequence of int, optional): episodes to show. Default: all.
        task (str, optional): task whose scene and modes are drawn.
        num_modes (int, optional): number of modes, needed where the task names no choices.
        control_hz (float): control steps per second.
        stride (int, optional): control steps per picture. Default: 2, more where that makes more than 170 pictures.
        progress (callable, optional): called with (pictures made, pictures wanted).

    Raises:
        ValueError: for a path that is not a gif, an episode that does not exist or a stride below 1.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.animation import animate_rollouts
        >>> one = {"position": torch.rand(1, 4, 2), "length": [4], "mode": [3], "outcome": [1]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     animate_rollouts(one, f"{folder}/rollouts.gif").name
        'rollouts.gif'
    """
    if Path(path).suffix != ".gif":
        raise ValueError(f"the pictures from above are written as .gif, got {str(path)!r}")
    if stride is not None and stride < 1:
        raise ValueError(f"stride must be at least 1, got {stride}")
    paths = executed_paths(rollouts)
    episodes = list(range(len(paths)) if episodes is None else episodes)
    wrong = [index for index in episodes if not 0 <= index < len(paths)]
    if wrong or not episodes:
        raise ValueError(f"episodes must be one or more of 0 to {len(paths) - 1}, got {wrong[:1] or episodes}")
    longest = max(len(paths[index]) for index in episodes)
    stride = stride or max(2, -(-longest // MOST_PICTURES))
    steps = [*range(0, longest, stride)]
    if steps and steps[-1] != longest - 1:
        steps.append(longest - 1)

    def pictures() -> Iterator[np.ndarray]:
        for number, image in enumerate(_top_down(rollouts, paths, episodes, steps, task, num_modes)):
            if progress is not None:
                progress(number + 1, len(steps))
            yield image

    return _write(pictures(), path, stride / control_hz)


@picture(
    "film.gif",
    source="rollouts.safetensors",
    title="One rollout as the camera sees it",
    caption="Recorded commands, played again in the simulator: the first success, or the first rollout if there is"
    " none. Long ones pass faster than they did.",
    place=30,
)
def film_rollout(rollouts: Mapping[str, Any], path: Path, *, task: str | None) -> Path:
    """Films the first successful rollout, or the first one if there is none.

    Args:
        rollouts (mapping): ``action`` [E, T, act], ``outcome`` [E], ``context`` [E, objects, 3] of tasks with any.
        path (Path): gif to write.

    Keyword Args:
        task (str, optional): name of the task.

    Raises:
        NothingToDraw: if actions were not kept, or the task is not known.
        NotFilmed: if no OpenGL library can be used.
    """
    if task is None or "action" not in rollouts:
        raise NothingToDraw("the rollouts hold no actions of a known task")
    won = np.flatnonzero(rollouts["outcome"] == SUCCESS)
    index = int(won[0]) if len(won) else 0
    context = rollouts["context"][index] if "context" in rollouts else None
    try:
        return render_rollout(rollouts["action"][index], path, task=task, context=context)
    except RuntimeError as error:
        raise NotFilmed(error) from error


def render_rollout(
    actions: Any,
    path: str | Path,
    *,
    task: str = "avoiding",
    context: Any = None,
    camera: str | None = None,
    width: int = 400,
    height: int = 300,
    stride: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Plays recorded actions again in the task's environment and films them.

    Nothing but the context is drawn at random and the simulator repeats itself exactly, so the film shows what
    happened, as long as the context is the recorded one to the last digit (float64).

    Args:
        actions (torch.Tensor or array): one episode's actions [T, act]; rows with NaN are left out.
        path (str or Path): ``.gif``, or ``.mp4`` where imageio and ffmpeg are installed.
        task (str): name of the task.
        context (array, optional): where the objects start [objects, 3], in a task that has any: x, y (m), yaw (rad).
        camera (str, optional): ``"front"``, ``"cage"`` or ``"wrist"``. Default: the one that shows the task best.
        width (int): width in pixels.
        height (int): height in pixels.
        stride (int, optional): control steps per picture. Default: 2, more where that makes more than 24 pictures.
            A picture is shown for as long as two control steps at most, so long episodes pass faster than they did.
        progress (callable, optional): called with (control steps played, control steps in all).

    Raises:
        ValueError: for an unknown task or camera, a wrong shape, no context where one is needed, or another kind of
            file.
        ModuleNotFoundError: if a ``.mp4`` is wanted and imageio or ffmpeg is not installed.
        RuntimeError: if no OpenGL library can be used; the message says what to install.
    """
    _check_kind(path)
    facts = get_task(task)
    if facts.env is None or facts.scene.camera is None:
        raise RuntimeError(f"task {task!r} names no camera of a simulator to film it with")
    actions = as_array("actions", actions, [None, facts.action_dim])
    actions = actions[np.isfinite(actions).all(1)].astype(np.float64)
    if facts.objects:
        if context is None:
            raise ValueError(f"task {task!r} starts differently every time: a film needs the 'context' of the episode")
        context = as_array("context", context, [len(facts.objects), 3]).astype(np.float64)[None]
    if stride is None:
        stride = max(2, -(-len(actions) // FILM_PICTURES))
    seconds = min(stride, 2) / facts.control_hz
    import torch

    from torchrl_koap.envs.mujoco.rendering import Renderer
    from torchrl_koap.envs.registry import make_env

    env = make_env(facts, 1, max_steps=len(actions) + 1, dtype=torch.float64)
    renderer: Any = None

    def pictures() -> Iterator[np.ndarray]:
        data = env.reset() if context is None else env.reset(contexts=context)
        view = camera or facts.scene.camera
        yield renderer.render(env.sims.data[0], view)
        for number, action in enumerate(actions):
            data = env.step(data.set("action", data["observation"].new_tensor(action[None])))["next"]
            last = number == len(actions) - 1 or bool(data["done"].any())
            if last or number % stride == stride - 1:
                yield renderer.render(env.sims.data[0], view)
            if progress is not None:
                progress(number + 1, len(actions))
            if last:
                return

    try:
        renderer = Renderer(env.sims.model, width, height, shadows=False)
        return _write(pictures(), path, seconds)
    finally:
        if renderer is not None:
            renderer.close()
        env.close()


def _top_down(rollouts, paths, episodes, steps, task, num_modes) -> Iterator[np.ndarray]:
    """Draws the scene once, adds each new piece of path to it, and lays dots and plans over it for one picture."""
    bodies = object_paths(rollouts)
    looks = object_looks(task, bodies[0].shape[1]) if bodies else ()
    pales = [tuple(0.45 * np.array(to_rgb(look.color)) + 0.55) for look in looks]
    mode = as_array("mode", rollouts["mode"], [len(paths)]).astype(int)
    outcome = as_array("outcome", rollouts["outcome"], [len(paths)]).astype(int)
    plan = plan_step = None
    if "plan" in rollouts and "plan_step" in rollouts:
        plan = as_array("plan", rollouts["plan"], [len(paths), None, None, 2])
        plan_step = as_array("plan_step", rollouts["plan_step"], plan.shape[:2])
    palette = mode_colors(task, num_modes)
    colors = {e: palette[mode[e]] if 0 <= mode[e] < len(palette) else NO_MODE for e in episodes}
    colors |= {e: INK for e in episodes if outcome[e] != SUCCESS}

    figure = Figure(figsize=(4.2, 5.2), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = draw_scene(figure.add_subplot(), task)
    axes.set(xlabel="", ylabel="")
    set_title(axes, f"{int((outcome[episodes] == SUCCESS).sum())} of {len(episodes)} rollouts succeed")
    moving = [] if bodies is None else [bodies[e].reshape(-1, 2) for e in episodes]
    keep_inside(axes, [*(paths[e] for e in episodes), *moving])
    trails = axes.add_collection(LineCollection([], linewidths=0.5 if looks else 1.0, animated=True, zorder=3))
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

    before = 0
    for step in steps:
        canvas.restore_region(background)
        moved = [e for e in episodes if len(paths[e]) > before]
        piece = slice(max(before - 1, 0), step + 1)
        if looks:
            trails.set_segments([bodies[e][piece, index] for e in moved for index in range(len(looks))])
            trails.set_color([pale for _ in moved for pale in pales])
        else:
            trails.set_segments([paths[e][piece] for e in moved])
            trails.set_color([colors[e] for e in moved])
        axes.draw_artist(trails)
        background = canvas.copy_from_bbox(figure.bbox)
        if looks:
            present = [bodies[e][min(step, len(bodies[e]) - 1)] for e in episodes if len(bodies[e])]
            squares.set_offsets(np.concatenate(present) if present else np.zeros((0, 2)))
            squares.set_facecolor([look.color for _ in present for look in looks])
            axes.draw_artist(squares)

        running = [e for e in episodes if len(paths[e]) > step + 1]
        if plan is not None:
            latest = [_latest_plan(plan[e], plan_step[e], step) for e in running]
            plans.set_segments([line for line in latest if len(line) > 1])
            axes.draw_artist(plans)
        dots.set_offsets(np.array([paths[e][step] for e in running]).reshape(-1, 2))
        dots.set_color([colors[e] for e in running])
        axes.draw_artist(dots)
        for kind, mark in marks.items():
            ended = [paths[e][-1] for e in episodes if outcome[e] == kind and 0 < len(paths[e]) <= step + 1]
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
    points = plan[made[-1], max(step - int(plan_step[made[-1]]), 0) :]  # what lies behind has been executed
    return points[np.isfinite(points).all(1)]


def _check_kind(path: str | Path) -> None:
    suffix = Path(path).suffix
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"moving pictures are written as .gif or .mp4, got {str(path)!r}")
    if suffix == ".mp4" and not all(importlib.util.find_spec(name) for name in ("imageio", "imageio_ffmpeg")):
        raise ModuleNotFoundError(_VIDEO)


def _write(pictures: Iterable[np.ndarray], path: str | Path, seconds: float) -> Path:
    """Writes pictures at ``seconds`` each, the last one for longer, aside first."""
    _check_kind(path)
    path = Path(path)
    frames = list(pictures)
    from torchrl_koap.files import replacing_file  # imports torch: only when something is written

    with replacing_file(path) as aside:
        if path.suffix == ".mp4":
            import imageio.v2 as imageio

            frames += frames[-1:] * round(HOLD_SECONDS / seconds)
            with imageio.get_writer(aside, format="FFMPEG", mode="I", fps=1 / seconds, macro_block_size=2) as writer:
                for frame in frames:
                    writer.append_data(frame)
        else:
            from PIL import Image

            # one palette for all, without dithering: what stands still does not flicker and costs nothing
            some = Image.fromarray(np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]]))
            palette = some.quantize(224, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # keeps rare colours
            images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
            times = [round(1000 * seconds)] * (len(images) - 1) + [round(1000 * HOLD_SECONDS)]
            images[0].save(aside, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0)
    return path
