# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures: what is in the figures, what is said in their titles, and what bad input gets."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib import colors as matplotlib_colors
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
from run_files import make_demonstrations, make_rollouts

from torchrl_koap import mode_plots, path_plots, plot_scenes, plots
from torchrl_koap.animation import animate_rollouts, render_rollout


@pytest.fixture
def figures(monkeypatch):
    """Collects the figures that are saved."""
    saved = []
    save = Figure.savefig

    def keep(self, *args, **kwargs):
        saved.append(self)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", keep)
    return saved


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes]


def drawn_lines(axes):
    return [line for item in axes.collections if isinstance(item, LineCollection) for line in item.get_segments()]


ROLLOUTS = make_rollouts()
EVERY = {
    "losses": lambda path: plots.plot_losses({"step": [1, 2], "loss_planner": [1.0, 0.5]}, path),
    "eigenvalues": lambda path: plots.plot_eigenvalues(torch.rand(4), torch.rand(4), path, control_hz=28.6),
    "actions": lambda path: plots.plot_actions(torch.rand(9, 2), torch.rand(9, 2), path),
    "modes": lambda path: mode_plots.plot_modes(torch.arange(9), path, reference=torch.arange(24)),
    "rollouts": lambda path: path_plots.plot_rollouts(ROLLOUTS, path),
    "plans": lambda path: path_plots.plot_plans(ROLLOUTS, path),
    "demonstrations": lambda path: path_plots.plot_demonstrations(make_demonstrations(), path),
}


@pytest.mark.parametrize("name", EVERY)
def test_picture_is_written_whole_and_leaves_no_state(name, tmp_path):
    before = dict(matplotlib.rcParams)
    path = tmp_path / "new" / f"{name}.png"
    assert EVERY[name](path) == path
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]  # nothing half-written beside it
    picture = np.asarray(Image.open(path).convert("L"))
    assert min(picture.shape) > 300 and picture.std() > 5
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_earlier_picture_survives_a_failure(tmp_path, monkeypatch):
    path = EVERY["losses"](tmp_path / "losses.png")
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(OSError, match="No space left"):
        EVERY["losses"](path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_import_is_quick_and_brings_neither_torch_nor_pyplot():
    heavy = "torch", "mujoco", "numba", "matplotlib.pyplot"
    code = (
        f"import sys, torchrl_koap.path_plots, torchrl_koap.animation; print([m for m in {heavy} if m in sys.modules])"
    )
    start = time.perf_counter()
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"
    assert time.perf_counter() - start < 10  # 0.7 s on a quiet machine


def test_geometry_is_that_of_the_environment():
    avoiding = pytest.importorskip("torchrl_koap.envs.avoiding")
    assert [(x, y, radius) for _, x, y, radius, _ in avoiding.OBSTACLES] == list(plot_scenes.AVOIDING_CYLINDERS)
    assert avoiding.FINISH_Y == plot_scenes.AVOIDING_FINISH


def test_scene_has_true_radii():
    axes = plot_scenes.draw_scene(Figure().add_subplot(), "avoiding")
    sizes = sorted(round(patch.get_radius(), 3) for patch in axes.patches)
    assert sizes == [0.025] * 5 + [0.03] + [0.035] * 5 + [0.04]
    assert axes.get_aspect() == 1


def test_unknown_scene_suggests_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'avoiding'"):
        plot_scenes.draw_scene(Figure().add_subplot(), "avoidin")


def test_mode_colors_are_distinct_with_hue_by_last_row_and_lightness_by_the_others():
    colors = plot_scenes.mode_colors("avoiding")
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(24)
    assert apart.min() > 0.08 and colors.min() >= 0 and colors.max() <= 1
    hue = matplotlib_colors.rgb_to_hsv(colors)[:, 0].reshape(6, 4)
    spread = np.abs(np.angle(np.exp(2j * np.pi * (hue - hue[2:3])))) / (2 * np.pi)
    assert spread.max() < 0.06  # a column keeps its hue
    between = np.abs(np.angle(np.exp(2j * np.pi * (hue[:, :, None] - hue[:, None])))) / (2 * np.pi)
    assert between[:, ~np.eye(4, dtype=bool)].min() > 0.08
    luminance = (colors @ [0.2126, 0.7152, 0.0722]).reshape(6, 4)
    assert (np.diff(luminance, axis=0) > 0).all()


@pytest.mark.parametrize("mode", range(24))
def test_mode_names_follow_the_flags(mode):
    envs = pytest.importorskip("torchrl_koap.envs.avoiding")
    row1, row2, row3 = plot_scenes.mode_name(mode, "avoiding").split(", ")
    flags = torch.zeros(9, dtype=torch.int64)
    flags[("left", "right").index(row1)] = 1
    flags[2 + ("left", "middle", "right").index(row2)] = 1
    flags[5 + int(row3[-1]) - 1] = 1
    assert envs.mode_index(flags) == mode


def test_modes_of_a_task_without_choices():
    assert plot_scenes.mode_colors(None, 6).shape == (6, 3)
    assert plot_scenes.mode_name(3, None, 6) == "3"
    with pytest.raises(ValueError, match="wanted num_modes"):
        plot_scenes.mode_colors("sorting")


def test_losses_get_a_panel_each_and_zero_is_said(figures, tmp_path):
    gap = math.nan
    metrics = {
        "step": [1, 2, 3, 4],
        "loss_planner": [1.0, 0.1, gap, gap],
        "loss_action": [gap, gap, 0.0, 0.0],
        "loss_new_term": [gap, gap, 4.0, 2.0],
        "loss_koopman": [gap] * 4,
        "learning_rate": [1.0] * 4,
    }
    plots.plot_losses(metrics, tmp_path / "a.png")
    assert titles(figures[0]) == ["planner", "action decoder (labelled steps)", "new term"]
    planner, action, _ = figures[0].axes
    raw = planner.lines[0]
    assert raw.get_xdata().tolist() == [1, 2] and raw.get_ydata().tolist() == [1.0, 0.1]
    assert planner.get_yscale() == "log"
    assert not action.lines and "no label" in action.texts[0].get_text()


@pytest.mark.parametrize("reach", [0, 1, 3, 50])
def test_running_mean(reach):
    values = np.random.default_rng(0).normal(size=21)
    values[[4, 5]] = np.nan
    wanted = [
        np.nanmean(values[max(i - reach, 0) : i + reach + 1]) if reach or i not in (4, 5) else np.nan for i in range(21)
    ]
    np.testing.assert_allclose(plots.running_mean(values, reach), wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        ({"loss_planner": [1.0]}, "need the column 'step'"),
        ({"step": [1]}, r"no value of any loss_\* column"),
        ({"step": [1, 2], "loss_planner": [1.0]}, r"'loss_planner' must have shape \[2\], got \[1\]"),
    ],
)
def test_bad_metrics(metrics, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        plots.plot_losses(metrics, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def test_eigenvalues_outside_the_circle_are_counted(figures, tmp_path):
    plots.plot_eigenvalues(
        torch.tensor([0.5, 0.6, 0.0]), torch.tensor([0.0, 0.9, 1.0]), tmp_path / "a.png", control_hz=28.6
    )
    assert titles(figures[0])[:2] == ["3 eigenvalues, 1 outside the unit circle", "largest magnitude 1.0817"]
    rank = figures[0].axes[1]
    inside, outside = (item.get_offsets() for item in rank.collections)
    np.testing.assert_allclose(inside, [[2, 1.0], [3, 0.5]])
    np.testing.assert_allclose(outside, [[1, math.hypot(0.6, 0.9)]])


@pytest.mark.parametrize("real", [[math.nan, 1.0], []])
def test_bad_eigenvalues(real, tmp_path):
    with pytest.raises(ValueError, match="finite and at least one"):
        plots.plot_eigenvalues(real, [0.0] * len(real), tmp_path / "a.png")


def test_actions_tell_the_error_and_the_broken_budget(figures, tmp_path):
    true = torch.zeros(50, 2)
    predicted = torch.tensor([0.003, 0.004]).expand(50, 2).clone()
    predicted[0] = torch.nan  # left out
    plots.plot_actions(predicted.requires_grad_(), true, tmp_path / "a.png")
    wanted = ["x: RMSE 3.00 mm", "y: RMSE 4.00 mm", "all: RMSE 3.54 mm, median 3.50"]
    assert titles(figures[0]) == wanted
    assert figures[0].get_suptitle() == (
        "49 steps of unlabelled demonstrations - for analysis only: reads labels outside the budget"
    )


@pytest.mark.parametrize(
    ("predicted", "message"),
    [(torch.zeros(3, 2), r"'predicted' must have shape \[4, 2\]"), (torch.full((4, 2), math.nan), "no row of 4")],
)
def test_bad_actions(predicted, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        plots.plot_actions(predicted, torch.zeros(4, 2), tmp_path / "a.png")


@pytest.mark.parametrize(("episodes", "number"), [(3, 2), (5, 3), (4, 4)])
def test_even_entropy_is_the_mean_over_all_draws(episodes, number):
    draws = np.stack(np.meshgrid(*[range(number)] * episodes), -1).reshape(-1, episodes)
    entropies = [mode_plots.mode_entropy(draw.tolist(), number) for draw in draws]
    assert mode_plots.even_entropy(episodes, number) == pytest.approx(np.mean(entropies), abs=1e-12)


def test_modes_histogram(figures, tmp_path):
    mode_plots.plot_modes(torch.tensor([0, 0, 23, 23, -1]), tmp_path / "a.png", reference=torch.tensor([5, 5, 6, -1]))
    axes = figures[0].axes[0]
    heights = np.array([bar.get_height() for bar in axes.patches])
    assert heights.tolist() == [2] + [0] * 22 + [2]
    assert titles(figures[0])[0].startswith(f"2 of 24 modes, entropy {math.log(2, 24):.2f};")
    assert titles(figures[0])[0].endswith("; 1 without a mode")
    levels = [line[0][1] for line in drawn_lines(axes)]
    assert levels[5] == pytest.approx(4 * 2 / 3) and sum(levels) == pytest.approx(4)
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], plot_scenes.mode_colors("avoiding"))


def test_rollouts_are_cut_coloured_and_counted(figures, tmp_path):
    path_plots.plot_rollouts(ROLLOUTS, tmp_path / "a.png")
    axes, side = figures[0].axes
    assert titles(figures[0])[0] == "2 of 4 rollouts succeed, out of time: 1, collision: 1"
    lines = axes.collections[0]
    np.testing.assert_allclose(lines.get_segments(), ROLLOUTS["position"][:2])
    np.testing.assert_allclose(lines.get_colors()[:, :3], plot_scenes.mode_colors("avoiding")[:2])
    late, hit = axes.lines[1:]  # the first line is the finish
    assert len(late.get_xdata()) == 20 and len(hit.get_xdata()) == 10
    np.testing.assert_allclose(axes.collections[-1].get_offsets()[0], ROLLOUTS["position"][3, 9])
    counts = [text.get_text() for text in side.texts[:24]]
    assert counts == ["1", "1"] + ["0"] * 22


def test_plans_lie_over_their_path(figures, tmp_path):
    path_plots.plot_plans(ROLLOUTS, tmp_path / "a.png", episodes=[1])
    axes = figures[0].axes[0]
    assert axes.get_title(loc="left") == "episode 1: left, left, gap 2\noff the path: median 0.0, 95 % within 0.0 mm"
    lines = drawn_lines(axes)
    assert len(lines) == 4 and all(len(line) == 4 for line in lines)
    starts = axes.collections[1].get_offsets()
    np.testing.assert_allclose(starts, ROLLOUTS["position"][1, [0, 4, 8, 12]])


def test_plan_deviation_is_the_distance_to_the_polyline():
    generator = np.random.default_rng(0)
    path, plan = generator.normal(size=(7, 2)), generator.normal(size=(30, 2))
    share = np.linspace(0, 1, 4001)[:, None]
    fine = np.concatenate([a + share * (b - a) for a, b in zip(path[:-1], path[1:], strict=True)])
    brute = np.linalg.norm(plan[:, None] - fine, axis=-1)
    reached = brute.argmin(1) < len(fine) - 1
    np.testing.assert_allclose(
        path_plots.plan_deviation(path, [plan[:10], plan[10:]]), brute.min(1)[reached], atol=1e-3
    )
    assert path_plots.plan_deviation(path[:1], [plan]).size == 0


@pytest.mark.parametrize(
    ("mode", "outcome", "count", "wanted"),
    [
        ([3, 3, 5, 5], [1, 1, 1, 1], 3, [0, 2, 1]),
        (range(24), [1] * 24, 4, [0, 8, 15, 23]),
        ([-1] * 5, [2] * 5, 4, [0, 1, 2, 3]),
        ([-1, 4], [0, 1], 6, [0, 1]),
        ([], [], 6, []),
    ],
)
def test_episodes_are_chosen_for_variety(mode, outcome, count, wanted):
    assert path_plots.choose_episodes(list(mode), outcome, count) == wanted


def test_demonstrations_emphasise_exactly_the_labelled_transitions(figures, tmp_path):
    data = make_demonstrations()
    data["labelled"] = torch.zeros(40, dtype=torch.bool)
    data["labelled"][[3, 19, 25]] = True  # 19 is the last step of the first one: no line to the second
    path_plots.plot_demonstrations(data, tmp_path / "a.png")
    axes = figures[0].axes[0]
    grey, blue = axes.collections
    assert [len(line) for line in grey.get_segments()] == [20, 20]
    np.testing.assert_allclose(blue.get_segments(), torch.stack([data["state"][[3, 25]], data["state"][[4, 26]]], 1))
    assert titles(figures[0])[0] == ("2 demonstrations; labels on 3 of 40 transitions (7.5%)\nin 2 of 2 demonstrations")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": None}, "missing entry 'mode'"),
        ({"position": torch.zeros(4, 20, 3)}, r"'position' must have shape \[any, any, 2\], got \[4, 20, 3\]"),
        ({"outcome": torch.zeros(3)}, r"'outcome' must have shape \[4\], got \[3\]"),
        ({"plan_step": torch.zeros(4, 2)}, r"'plan_step' must have shape \[4, 5\]"),
    ],
)
def test_bad_rollouts(change, message, tmp_path):
    rollouts = {key: value for key, value in (ROLLOUTS | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        path_plots.plot_plans(rollouts, tmp_path / "a.png")
    with pytest.raises(ValueError, match="must be 0 to 3, got 4"):
        path_plots.plot_plans(ROLLOUTS, tmp_path / "a.png", episodes=[4])


def test_animation_shows_every_step_and_holds_the_end(tmp_path):
    seen = []
    path = animate_rollouts(ROLLOUTS, tmp_path / "a.gif", stride=3, progress=lambda *done: seen.append(done))
    assert seen == [(number, 8) for number in range(1, 9)]  # steps 0, 3, ..., 18 and the last, 19
    with Image.open(path) as film:
        assert film.n_frames == 8 and film.info["duration"] == 100  # 3 x 35 ms, in hundredths of a second
        first = np.asarray(film.convert("L")).astype(int)
        film.seek(7)
        assert film.info["duration"] == 1500
        assert (np.abs(np.asarray(film.convert("L")).astype(int) - first) > 60).sum() > 500
    assert path.stat().st_size < 2e6


@pytest.mark.parametrize(
    "call", [lambda path: animate_rollouts(ROLLOUTS, path), lambda path: render_rollout([[0, 0]], path)]
)
def test_animation_refuses_other_files(call, tmp_path):
    with pytest.raises(ValueError, match="written as .gif"):
        call(tmp_path / "a.avi")


@pytest.mark.parametrize(("option", "value"), [("episodes", [9]), ("episodes", []), ("stride", 0)])
def test_animation_options(option, value, tmp_path):
    with pytest.raises(ValueError, match=option):
        animate_rollouts(ROLLOUTS, tmp_path / "a.gif", **{option: value})


def test_film_of_recorded_actions(tmp_path):
    pytest.importorskip("torchrl_koap.envs")
    actions = torch.full((6, 2), 0.008)
    actions[5] = torch.nan
    try:
        path = render_rollout(actions, tmp_path / "a.gif", width=96, height=72)
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")
    with Image.open(path) as film:
        assert film.size == (96, 72) and film.n_frames == 4  # the start, and after 2, 4, 5 steps


def test_film_needs_its_packages_and_task(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="'sorting'"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.gif", task="sorting")
    monkeypatch.setattr("torchrl_koap.animation.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="pip install imageio imageio-ffmpeg"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.mp4")
