# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that scenes and bodies are drawn to scale and at the positions of the environments."""

import mujoco
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from torchrl_koap.data.d3il.conversion import CONVERTERS
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.registry import make_env
from torchrl_koap.reports import scenes
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.tasks.avoiding import OBSTACLES


@pytest.fixture(scope="module")
def models():
    return {name: make_env(name).sims.model for name in TASKS if TASKS[name].source in CONVERTERS}


def shapes(task, role):
    return [shape for shape in TASKS[task].scene.shapes if shape.role == role]


def test_avoiding_is_that_of_the_environment(models):
    model = models["avoiding"]
    for shape, (name, *_) in zip(shapes("avoiding", "obstacle"), OBSTACLES, strict=True):
        geom = model.geom(name)
        np.testing.assert_allclose(model.body(name).pos[:2], shape.center)
        assert geom.size[0] == shape.half[0]
    (finish,) = shapes("avoiding", "finish")
    assert model.geom("finish_line").pos[1] == finish.center[1]


@pytest.mark.parametrize("task", ["sorting", "sorting_2", "sorting_6", "po_sorting"])
def test_sorting_is_that_of_the_environment(task, models):
    model = models[task]
    platform = model.body("platform")
    centre, half = platform.pos[:2], model.geom_size[platform.geomadr[0]][:2]
    (drawn,) = shapes(task, "platform")
    np.testing.assert_allclose([drawn.center, drawn.half], [centre, half], atol=1e-12)
    for name in ("red", "blue"):
        body = model.body(f"{name}_bin")
        geoms = range(int(body.geomadr[0]), int(body.geomadr[0] + body.geomnum[0]))
        walls = [(*body.pos[:2] + model.geom_pos[geom][:2], *model.geom_size[geom][:2]) for geom in geoms]
        found = [(*shape.center, *shape.half) for shape in shapes(task, "wall") if shape.color == name]
        np.testing.assert_allclose(sorted(walls), sorted(found), atol=1e-12)
    ground, *patches = scenes.draw_scene(Figure().add_subplot(), TASKS[task]).patches
    np.testing.assert_allclose(ground.get_bbox().get_points(), [centre - half, centre + half])
    colors = {patch.get_facecolor()[:3] for patch in patches}
    assert colors == {to_rgb(scenes.RED), to_rgb(scenes.BLUE)}


def test_stacking_is_that_of_the_environment(models):
    site, (target,) = models["stacking"].site("target"), shapes("stacking", "target")
    np.testing.assert_allclose([site.pos[:2], site.size[:2]], [target.center, target.half])


@pytest.mark.parametrize("task", [task for task in TASKS if TASKS[task].objects and TASKS[task].source in CONVERTERS])
def test_bodies_have_the_sizes_and_colours_of_the_environment(task, models):
    model, bodies = models[task], scenes.bodies_of(TASKS[task], len(TASKS[task].objects))
    assert len(bodies) == len(TASKS[task].objects)
    for name, body in zip(TASKS[task].objects, bodies, strict=True):
        if name == "target":
            assert body.still
            np.testing.assert_allclose(model.site("target_base").size[:2], body.half)
            continue
        geom = int(model.body(name).geomadr[0])
        assert not body.still and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_allclose(model.geom_size[geom][:2], body.half)
        if task != "aligning":
            assert np.argmax(to_rgb(body.color)) == np.argmax(model.geom_rgba[geom][:3])


@pytest.mark.parametrize("task", TASKS)
def test_every_start_lies_inside_the_picture(task):
    axes = scenes.draw_scene(Figure().add_subplot(), TASKS[task])
    if TASKS[task].objects:
        contexts = draw_contexts(task, 200, 0)
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        assert ((contexts[..., :2] > low + 0.04) & (contexts[..., :2] < high - 0.04)).all()


@pytest.mark.parametrize("number", [3, 21])
def test_orientation_is_drawn(number):
    """Outlines with a thick far side, of many the centre and a line to the far side."""
    axes, bodies = Figure().add_subplot(), scenes.bodies_of(get_task("aligning"), 2)
    contexts = np.tile([[0.5, -0.2, 0.0], [0.5, 0.3, np.pi / 2]], (number, 1, 1))
    scenes.draw_starts(axes, contexts, bodies)
    lines = [line for item in axes.collections if hasattr(item, "get_segments") for line in item.get_segments()]
    if number == 3:
        assert [len(line) for line in lines] == [5] * 3 + [2] * 3 + [5] * 3 + [2] * 3
        np.testing.assert_allclose(lines[3], [[0.55, -0.15], [0.45, -0.15]])
    else:
        assert len(lines) == 42
        np.testing.assert_allclose(lines[0], [[0.5, -0.2], [0.5, -0.15]])
        np.testing.assert_allclose(lines[21], [[0.5, 0.3], [0.45, 0.3]], atol=1e-12)


@pytest.mark.parametrize(("end", "limit"), [(0.9, 1), (1.2, 1.236), (4, 1.5)])
def test_a_panel_is_widened_by_half_at_most(end, limit):
    axes, path = Figure().add_subplot(), np.array([[0.0, 0.5], [end, 0.5]])
    axes.set(xlim=(0, 1), ylim=(0, 1))
    scenes.keep_inside(axes, [path])
    assert axes.get_xlim()[1] == pytest.approx(limit) and axes.get_ylim() == (0, 1)
    free = Figure().add_subplot()
    scenes.keep_inside(free, [path])
    assert free.get_xlim() == pytest.approx((-0.03 * end, 1.03 * end))


def test_ends_of_bodies_are_dots_and_those_of_failures_crosses():
    position = np.stack([np.full((8, 1, 2), 0.1), np.full((8, 1, 2), 0.2)])
    paths = scenes.body_paths({"object_position": position, "length": [5, 3]})
    assert [len(path) for path in paths] == [6, 4]  # with the last state
    axes = Figure().add_subplot()
    scenes.draw_bodies(axes, paths, None, [True, False])
    _, dots, crosses = axes.collections
    assert (dots.get_offsets().tolist(), crosses.get_offsets().tolist()) == ([[0.1, 0.1]], [[0.2, 0.2]])


def test_objects_of_an_unknown_task_are_grey():
    bodies = scenes.bodies_of(None, 5)
    assert len(bodies) == 5 and {body.color for body in bodies} == {scenes.MUTED}
    assert scenes.bodies_of(get_task("stacking"), 2) == bodies[:2]


def test_bad_contexts():
    with pytest.raises(ValueError, match=r"'context' must have shape \[any, 2, 3\], got \[4, 2\]"):
        scenes.draw_starts(Figure().add_subplot(), np.zeros((4, 2)), scenes.bodies_of(get_task("aligning"), 2))
