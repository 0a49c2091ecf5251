# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures: what is in the figures, what is said in their titles, and what bad input gets."""

from __future__ import annotations

import math
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
import torch
from figure_parts import drawn_lines, titles
from matplotlib.figure import Figure
from PIL import Image
from run_files import make_demonstrations, make_object_rollouts, make_rollouts

from torchrl_koap.evaluation.latent_space import spectrum
from torchrl_koap.reports import demonstration_plot, mode_plots, objects, rollout_plots, training_plots
from torchrl_koap.reports.mode_colors import mode_colors

ROLLOUTS = make_rollouts()
EVERY = {
    "losses": lambda path: training_plots.plot_losses({"step": [1, 2], "loss_planner": [1.0, 0.5]}, path),
    "eigenvalues": lambda path: training_plots.plot_eigenvalues(torch.rand(4), torch.rand(4), path, control_hz=28.6),
    "actions": lambda path: training_plots.plot_actions(torch.rand(9, 2), torch.rand(9, 2), path),
    "modes": lambda path: mode_plots.plot_modes(torch.arange(9), path, reference=torch.arange(24)),
    "rollouts": lambda path: rollout_plots.plot_rollouts(ROLLOUTS, path),
    "plans": lambda path: rollout_plots.plot_plans(ROLLOUTS, path),
    "demonstrations": lambda path: demonstration_plot.plot_demonstrations(make_demonstrations(), path),
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


def test_import_brings_neither_the_simulator_nor_pyplot():
    heavy = "mujoco", "numba", "torchrl", "matplotlib.pyplot"
    modules = "torchrl_koap.reports.rollout_plots, torchrl_koap.reports.animation"
    code = f"import sys, {modules}; print([m for m in {heavy} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"


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
    training_plots.plot_losses(metrics, tmp_path / "a.png")
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
    np.testing.assert_allclose(training_plots.running_mean(values, reach), wanted, atol=1e-12)


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
        training_plots.plot_losses(metrics, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def test_eigenvalues_outside_the_circle_are_counted(figures, tmp_path):
    training_plots.plot_eigenvalues(
        torch.tensor([0.5, 0.6, 0.0]), torch.tensor([0.0, 0.9, 1.0]), tmp_path / "a.png", control_hz=28.6
    )
    assert titles(figures[0])[0] == "3 eigenvalues, radius 1.0817\n1 inside, 1 on, 1 outside the unit circle"
    rank = figures[0].axes[1]
    inside, on, outside = (item.get_offsets() for item in rank.collections)
    np.testing.assert_allclose(inside, [[3, -0.5]])
    np.testing.assert_allclose(on, [[2, 0.0]], atol=1e-7)
    np.testing.assert_allclose(outside, [[1, math.hypot(0.6, 0.9) - 1]], rtol=1e-6)


def test_eigenvalues_near_the_circle_are_counted_as_in_the_text(figures, tmp_path):
    """Eigenvalues within 2 % of 1, some nearer than the tolerance: figure, legend and `koap inspect` agree."""
    size = torch.tensor([1.006, 1.0009, 1.00001, 0.9995, 0.995, 0.981])
    training_plots.plot_eigenvalues(size, torch.zeros(6), tmp_path / "a.png", control_hz=28.6)
    facts = spectrum(size.to(torch.complex128))
    counted = {name: facts[name] for name in ("inside", "on", "outside")}
    assert counted == {"inside": 2, "on": 3, "outside": 1}
    assert titles(figures[0])[0].endswith("2 inside, 3 on, 1 outside the unit circle")
    legend = [text.get_text() for text in figures[0].axes[1].get_legend().get_texts()]
    assert legend == [f"{name} the circle: {number}" for name, number in counted.items()]
    places = figures[0].axes[1].transData.transform([(0, value - 1) for value in size])[:, 1]
    height = figures[0].axes[1].get_window_extent().height
    assert places[0] - places[1] > 0.1 * height and places[3] - places[4] > 0.1 * height  # told apart by eye


@pytest.mark.parametrize("real", [[math.nan, 1.0], []])
def test_bad_eigenvalues(real, tmp_path):
    with pytest.raises(ValueError, match="finite and at least one"):
        training_plots.plot_eigenvalues(real, [0.0] * len(real), tmp_path / "a.png")


def test_actions_tell_the_error_and_the_broken_budget(figures, tmp_path):
    true = torch.zeros(50, 2)
    predicted = torch.tensor([0.003, 0.004]).expand(50, 2).clone()
    predicted[0] = torch.nan  # left out
    columns = {"names": ["x", "y"], "units": ["m", "m"]}
    training_plots.plot_actions(predicted.requires_grad_(), true, tmp_path / "a.png", **columns)
    wanted = ["x: RMSE 3 mm", "y: RMSE 4 mm", "all: RMSE 3.54 mm, median 3.5"]
    assert titles(figures[0]) == wanted
    assert figures[0].get_suptitle() == (
        "49 steps of unlabelled demonstrations - for analysis only: reads labels outside the budget"
    )


def test_actions_in_two_units(figures, tmp_path):
    """Stacking: seven joints in mrad per step, and a width in mm that the error of all leaves out."""
    true = torch.zeros(50, 8)
    predicted = torch.tensor([0.002] * 7 + [0.08]).expand(50, 8)
    names = [*(f"joint {index}" for index in range(1, 8)), "gripper"]
    training_plots.plot_actions(
        predicted, true, tmp_path / "a.png", names=names, units=["rad"] * 7 + ["m"], absolute=["gripper"]
    )
    said = titles(figures[0])
    assert said[0] == "joint 1: RMSE 2 mrad" and said[7] == "gripper: RMSE 80 mm"
    assert said[8] == "all but gripper: RMSE 2 mrad, median 2"
    panels = figures[0].axes
    assert panels[6].get_xlabel() == "recorded joint 7 (mrad per step)"
    assert panels[7].get_xlabel() == "recorded gripper (mm)"
    assert [text.get_text() for text in panels[8].get_legend().get_texts()] == names[:7]


def test_actions_of_another_robot(figures, tmp_path):
    """Seven joint torques: names and units as given, nothing speaks of x, y or mm."""
    true, names = torch.rand(30, 7), [f"torque {index}" for index in range(7)]
    training_plots.plot_actions(true + 0.5, true, tmp_path / "a.png", names=names, units=["N m"] * 7)
    assert titles(figures[0])[6:] == ["torque 6: RMSE 0.5 N m", "all: RMSE 0.5 N m, median 0.5"]
    training_plots.plot_actions(true + 0.5, true, tmp_path / "b.png")
    assert titles(figures[1])[0] == "action 1: RMSE 0.5" and figures[1].axes[0].get_xlabel().endswith("(per step)")
    with pytest.raises(ValueError, match="'units' must be one per action column, 7 in all, got 1"):
        training_plots.plot_actions(true, true, tmp_path / "c.png", units=["m"])


@pytest.mark.parametrize(
    ("predicted", "message"),
    [(torch.zeros(3, 2), r"'predicted' must have shape \[4, 2\]"), (torch.full((4, 2), math.nan), "no row of 4")],
)
def test_bad_actions(predicted, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        training_plots.plot_actions(predicted, torch.zeros(4, 2), tmp_path / "a.png")


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
    np.testing.assert_allclose([bar.get_facecolor()[:3] for bar in axes.patches], mode_colors("avoiding"))


def test_rollouts_are_cut_coloured_and_counted(figures, tmp_path):
    rollout_plots.plot_rollouts(ROLLOUTS, tmp_path / "a.png")
    axes, side = figures[0].axes
    assert titles(figures[0])[0] == "2 of 4 rollouts succeed, out of time: 1, collision: 1"
    lines = axes.collections[0]
    np.testing.assert_allclose(lines.get_segments(), ROLLOUTS["position"][:2])
    np.testing.assert_allclose(lines.get_colors()[:, :3], mode_colors("avoiding")[:2])
    late, hit = axes.lines[1:]  # the first line is the finish
    assert len(late.get_xdata()) == 20 and len(hit.get_xdata()) == 10
    np.testing.assert_allclose(axes.collections[-1].get_offsets()[0], ROLLOUTS["position"][3, 9])
    counts = [text.get_text() for text in side.texts[:24]]
    assert counts == ["1", "1"] + ["0"] * 22


def test_a_list_of_modes_in_words(figures, tmp_path):
    rollouts = make_object_rollouts("sorting")
    rollout_plots.plot_rollouts(rollouts, tmp_path / "a.png", task="sorting")
    side = figures[0].axes[2]
    said = [text.get_text() for text in side.texts]
    assert said[:4] == ["1", "red, red, blue, blue", "1", "red, blue, red, blue"] and said[-1] == "order of arrival"
    mode_plots.plot_modes([0, 1, 1], tmp_path / "b.png", task="sorting_2")
    bars = figures[1].axes[0]
    assert [tick.get_text() for tick in bars.get_xticklabels()] == ["red\nblue", "blue\nred"]
    assert [bar.get_height() for bar in bars.patches] == [1, 2]
    mode_plots.plot_modes(range(20), tmp_path / "c.png", task="sorting_6")
    assert len(figures[2].axes[0].patches) == 20


@pytest.mark.parametrize("task", ["aligning", "sorting", "stacking", None])
def test_objects_get_a_panel(task, figures, tmp_path):
    rollouts = make_object_rollouts(task or "stacking")
    looks = objects.object_looks(task, rollouts["context"].shape[1])
    rollout_plots.plot_rollouts(rollouts, tmp_path / "a.png", task=task, num_modes=6)
    beside = figures[0].axes[1]
    assert beside.get_title(loc="left").startswith("objects")
    for index, look in enumerate(looks):
        wanted = [rollouts["object_position"][e, : 21 if e < 3 else 11, index].numpy() for e in range(4)]
        found = [line for line in drawn_lines(beside) if len(line) in (20, 11) and np.allclose(line[0], wanted[0][0])]
        assert bool(found) is not look.still
        if found:
            np.testing.assert_allclose(found[0], wanted[0])
    entries = [text.get_text() for text in figures[0].axes[2].get_legend().get_texts()]
    assert entries[:2] == ["out of time", "collision"] and entries[-2:] == ["end", "end of a failure"]
    assert entries[2:-2] == list(dict.fromkeys(look.label for look in looks))


def test_plans_of_a_task_with_objects(figures, tmp_path):
    rollout_plots.plot_plans(make_object_rollouts("aligning"), tmp_path / "a.png", task="aligning", episodes=[1, 3])
    lines = drawn_lines(figures[0].axes[0])
    outline = objects.outlines(make_object_rollouts("aligning")["context"].numpy()[1, 0], (0.05, 0.05))
    assert any(line.shape == (5, 2) and np.allclose(line, outline) for line in lines)


def test_plans_lie_over_their_path(figures, tmp_path):
    rollout_plots.plot_plans(ROLLOUTS, tmp_path / "a.png", episodes=[1])
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
        rollout_plots.plan_deviation(path, [plan[:10], plan[10:]]), brute.min(1)[reached], atol=1e-3
    )
    assert rollout_plots.plan_deviation(path[:1], [plan]).size == 0


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
    assert rollout_plots.choose_episodes(list(mode), outcome, count) == wanted


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
        rollout_plots.plot_plans(rollouts, tmp_path / "a.png")
    with pytest.raises(ValueError, match="must be 0 to 3, got 4"):
        rollout_plots.plot_plans(ROLLOUTS, tmp_path / "a.png", episodes=[4])
