# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests contexts: ranges, repeatability, the shipped table, D3IL's files, errors of wrong ones."""

import hashlib
import json
import math
import pickle

import numpy as np
import pytest

from torchrl_koap.envs import contexts
from torchrl_koap.envs.contexts import (
    check_contexts,
    draw_contexts,
    evaluation_contexts,
    load_contexts,
    poses_of,
    yaw_quaternions,
)
from torchrl_koap.tasks import TASKS, get_task

PLACED = sorted(name for name, task in TASKS.items() if task.objects)
# sha256 of the shipped table: results quoted anywhere belong to exactly these contexts
TABLE_CHECKSUM = "381450b15196a1bff4612c1c05c96cfea7dbfe72ae4560eae62620df1ff4ad5c"
ALIGNING = {"box": ((0.4, 0.6), (-0.25, -0.1)), "target": ((0.4, 0.6), (0.2, 0.35))}
STACKING = {
    "red": ((0.35, 0.45), (-0.25, -0.15)),
    "green": ((0.35, 0.45), (-0.1, 0.0)),
    "blue": ((0.55, 0.6), (-0.2, 0.0)),
}


@pytest.mark.parametrize(("task", "ranges"), [("aligning", ALIGNING), ("stacking", STACKING)])
def test_draws_fill_the_ranges_of_the_task(task, ranges):
    drawn = draw_contexts(task, 4000, 0)
    assert drawn.shape == (4000, len(ranges), 3) and drawn.dtype == np.float64
    for index, region in enumerate(ranges.values()):
        for axis, (low, high) in enumerate((*region, (-math.pi / 2, math.pi / 2))):
            values = drawn[:, index, axis]
            assert low <= values.min() < low + 0.01 * (high - low)
            assert high - 0.01 * (high - low) < values.max() <= high
            assert abs(values.mean() - (low + high) / 2) < 0.02 * (high - low)  # 4 standard errors
    assert np.abs(np.corrcoef(drawn.reshape(4000, -1).T) - np.eye(3 * len(ranges))).max() < 0.08


@pytest.mark.parametrize("task", ["sorting_2", "sorting", "sorting_6"])
def test_sorting_assigns_six_regions_at_random(task):
    drawn = draw_contexts(task, 600, 1)
    right, row = drawn[..., 0] > 0.525, np.digitize(drawn[..., 1], (-0.075, 0.025))
    region = 3 * right + row
    assert all(len(set(of_one)) == region.shape[1] for of_one in region.tolist())  # no region holds two boxes
    shares = np.stack([(region == number).mean(0) for number in range(6)])
    assert np.abs(shares - 1 / 6).max() < 0.07  # every box comes to lie everywhere
    x, y = drawn[..., 0], drawn[..., 1]
    assert ((x >= np.where(right, 0.55, 0.4)) & (x <= np.where(right, 0.65, 0.5))).all()
    low = np.array([-0.15, -0.05, 0.05])[row]
    assert ((y >= low) & (y <= low + 0.05)).all()


@pytest.mark.parametrize("task", PLACED)
def test_draws_repeat_from_their_seed_and_nothing_else(task):
    np.random.seed(0)  # noqa: NPY002
    first = draw_contexts(task, 5, 7)
    np.random.seed(1)  # noqa: NPY002
    np.testing.assert_array_equal(draw_contexts(task, 5, 7), first)
    np.testing.assert_array_equal(draw_contexts(get_task(task), 9, np.random.default_rng(7))[:5], first)
    assert np.abs(draw_contexts(task, 5, 8) - first).max() > 1e-3


@pytest.mark.parametrize("task", PLACED)
def test_the_table_holds_60_contexts_inside_the_ranges(task):
    table = evaluation_contexts(task)
    assert table.shape == (60, len(get_task(task).objects), 3)
    np.testing.assert_array_equal(check_contexts(get_task(task), table), table)
    assert np.abs(table[..., 2]).max() <= math.radians(TASKS[task].scene.start_yaw[1])
    assert len(np.unique(table.reshape(60, -1), axis=0)) == 60
    np.testing.assert_array_equal(evaluation_contexts(task), table)
    table[:] = 0  # what is handed out is a copy
    assert evaluation_contexts(task).any()


def test_the_table_is_the_one_that_results_refer_to():
    assert hashlib.sha256(contexts.TABLE.read_bytes()).hexdigest() == TABLE_CHECKSUM
    stored = json.loads(contexts.TABLE.read_text())
    for task, seed in stored["seeds"].items():
        np.testing.assert_allclose(stored["contexts"][task], draw_contexts(task, 60, seed), rtol=0, atol=1e-6)


def test_variants_of_a_task_share_its_table():
    np.testing.assert_array_equal(evaluation_contexts("po_sorting"), evaluation_contexts("sorting"))
    np.testing.assert_array_equal(evaluation_contexts("stacking_1"), evaluation_contexts("stacking"))


def test_poses_are_rotations_about_z():
    poses = poses_of(np.array([[[0.5, -0.2, math.pi / 2], [0.4, 0.3, -math.pi / 3]]]), height=0.01)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(poses[0, 0], [0.5, -0.2, 0.01, half, 0, 0, half], atol=1e-15)
    np.testing.assert_allclose(poses[0, 1], [0.4, 0.3, 0.01, math.sqrt(0.75), 0, 0, -0.5], atol=1e-15)
    assert yaw_quaternions(np.zeros((2, 3))).shape == (2, 3, 4)


def d3il_context(placed):
    """One context as D3IL nests it: per object the pair of position (x, y in m, yaw in deg) and quaternion."""
    return [
        (np.array([x, y, math.degrees(yaw)]), yaw_quaternions(np.array(yaw)).astype(np.float32)) for x, y, yaw in placed
    ]


@pytest.mark.parametrize("task", ["aligning", "sorting", "stacking"])
@pytest.mark.parametrize("nesting", ["pairs", "flat"])
def test_reading_the_files_of_d3il(tmp_path, task, nesting):
    wanted = draw_contexts(task, 3, 5)
    stored = [d3il_context(context) for context in wanted]
    # D3IL's lists go on behind the objects of the task: Sorting's always name six, Stacking's end with the target
    stored = [context + d3il_context([(0.5, 0.2, 0.0)]) for context in stored] if task != "aligning" else stored
    if nesting == "flat":
        stored = [[array for pair in context for array in pair] for context in stored]
    file = tmp_path / "contexts.pkl"
    file.write_bytes(pickle.dumps(stored))
    np.testing.assert_allclose(load_contexts(file, task), wanted, rtol=0, atol=1e-12)


def test_files_with_other_contents_are_refused(tmp_path):
    file = tmp_path / "contexts.pkl"
    with pytest.raises(FileNotFoundError):
        load_contexts(file, "aligning")
    for content, message in (
        ({}, "wanted a list of contexts, got dict"),
        ([], "wanted a list of contexts, got list"),
        ([d3il_context([(0.5, -0.2, 0.0)])], "context 0 places 1 objects, task 'aligning' has 2"),
        ([d3il_context([(0.5, -0.2, 0.0), (0.5, 0.5, 0.0)])], r"contexts.pkl: context 0 puts 'target' at \(0.5, 0.5\)"),
    ):
        file.write_bytes(pickle.dumps(content))
        with pytest.raises(ValueError, match=message):
            load_contexts(file, "aligning")


def test_contexts_that_a_task_never_draws_are_named():
    task, good = get_task("aligning"), draw_contexts("aligning", 4, 0)
    for wrong in (good[0], good[:, :1], good[..., :2], good[:0]):
        with pytest.raises(ValueError, match=r"\[C, 2, 3\] .* for box, target\), got shape"):
            check_contexts(task, wrong)
    outside = good.copy()
    outside[2, 0, 1] = -0.0999
    with pytest.raises(ValueError, match=r"context 2 puts 'box' at .* outside its region: x 0.4..0.6, y -0.25..-0.1"):
        check_contexts(task, outside)
    missing = good.copy()
    missing[3, 1, 2] = np.nan
    with pytest.raises(ValueError, match="finite; row 3 is not"):
        check_contexts(task, missing)
    between = draw_contexts("sorting", 2, 0)
    between[1, 3, 0] = 0.525
    with pytest.raises(ValueError, match="context 1 puts 'blue_2'"):
        check_contexts(get_task("sorting"), between)
    crowded = draw_contexts("sorting", 3, 0)
    crowded[2, 1] = crowded[2, 3]  # one box upon another
    with pytest.raises(ValueError, match=r"context 2 puts 2 objects into one region: x 0.\d+..0.\d+, y "):
        check_contexts(get_task("sorting"), crowded)
    rounded = np.array([[(0.4, -0.25, 0.0), (0.6, 0.35, 0.0)]], dtype=np.float32)  # D3IL's precision at the very edge
    assert check_contexts(task, rounded).shape == (1, 2, 3)


def test_tasks_without_contexts_are_named():
    for call in (lambda: draw_contexts("avoiding", 1), lambda: evaluation_contexts("avoiding")):
        with pytest.raises(ValueError, match="'avoiding' has no contexts"):
            call()
