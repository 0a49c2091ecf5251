# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests SortingEnv: parity with recordings of the original, contexts, success, order, numbers of boxes."""

import numpy as np
import pytest
import torch
from env_test_base import ContextTestBase, act, contexts_of, recordings_of, replay, start_recorded
from torchrl.envs.utils import check_env_specs

from torchrl_koap.envs import SortingEnv
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.sorting import BIN_X, BIN_Y
from torchrl_koap.tasks.sorting import box_colours

SENSITIVE = (1, 2)  # episodes in which a change of 1e-8 rad grows to millimetres
INTO_BOXES = torch.tensor([0.001, 0.010], dtype=torch.float64)


class TestSortingEnv(ContextTestBase):
    ENV = SortingEnv
    PUSH = INTO_BOXES.tolist()


def packed(mode):
    """The byte the original shows: unfilled entries are -1, which packs as 1; four more bits are 0."""
    return int(np.packbits(np.append(np.asarray(mode) != 0, np.zeros(4, bool)))[0])


def test_parity_with_the_original_from_its_state():
    recorded = recordings_of("sorting")
    env = SortingEnv(4, max_steps=1000, dtype=torch.float64)
    env.reset(contexts=contexts_of(recorded, 4))
    start_recorded(env, recorded)
    touched = [False] * 4
    worst = {"tcp": np.zeros(4), "objects": np.zeros(4)}

    def check(i, k, out, where):
        touched[i] |= bool(recorded[f"ep{i}_robot_touches_object"][k])
        if not (i in SENSITIVE and touched[i]):
            tcp = np.abs(env.sims.tcp_position[i] - recorded[f"ep{i}_c_pos"][k]).max()
            objects = np.abs(env.sims.data[i].qpos[:28] - recorded[f"ep{i}_qpos"][k][:28]).max()
            worst["tcp"][i], worst["objects"][i] = max(worst["tcp"][i], tcp), max(worst["objects"][i], objects)
            observed = np.abs(out["observation"][i, 2:].numpy() - recorded[f"ep{i}_obs_step"][k])
            wanted = recorded[f"ep{i}_obs_step"][k]
            assert (observed < 1e-6 * (1 + wanted**2)).all(), where  # recorded in float32; the tangent has poles
        assert out["done"][i].item() == bool(recorded[f"ep{i}_done"][k]), where
        assert out["success"][i].item() == bool(recorded[f"ep{i}_success"][k - 1] if k else False), where
        assert packed(out["mode"][i]) == recorded[f"ep{i}_mode"][k], where
        third = recorded[f"ep{i}_min_inds"][k]  # there blue boxes count from 3
        assert env._noted[i].tolist() == np.where(third >= 3, third - 1, third)[:4].tolist(), where

    replay(env, recorded, check, 2)
    assert worst["tcp"].max() < 1e-9, worst  # 1e-6 mm
    assert worst["objects"].max() < 1e-6, worst  # 1e-3 mm
    assert env._seen[:, 0].tolist() == [bool(recorded[f"ep{i}_success"][-1]) for i in range(4)]
    assert touched[:3] == [True, True, True]


@pytest.mark.parametrize("num_boxes", [2, 4, 6])
def test_all_numbers_of_boxes(num_boxes):
    table = evaluation_contexts("sorting" if num_boxes == 4 else f"sorting_{num_boxes}")[:2]
    env = SortingEnv(2, num_boxes=num_boxes, dtype=torch.float64)
    check_env_specs(env)
    first = env.reset(contexts=table)
    assert first["observation"].shape == (2, 4 + 3 * num_boxes)
    assert first["mode"].shape == (2, num_boxes) and (first["mode"] == -1).all()
    boxes = first["observation"][:, 4:].reshape(2, num_boxes, 3)
    torch.testing.assert_close(boxes[..., :2], torch.as_tensor(table[..., :2]), rtol=0, atol=1e-4)
    torch.testing.assert_close(boxes[..., 2], torch.as_tensor(np.tan(table[..., 2])), rtol=1e-3, atol=1e-3)
    for _ in range(30):
        out = act(env, torch.zeros(2))
    np.testing.assert_allclose(
        env.sims.object_poses[..., 2], 0.13, atol=5e-4
    )  # pushed out of the platform, as measured
    _, poses = env.raw_log()
    assert poses.shape == (2, num_boxes, 7)
    for index, pose in enumerate(poses.swapaxes(0, 1)):
        np.testing.assert_allclose(pose[:, :2], out["observation"][:, 4 + 3 * index : 6 + 3 * index], atol=1e-3)


@pytest.mark.parametrize("num_boxes", [0, 3, 8, "four"])
def test_other_numbers_of_boxes_are_refused(num_boxes):
    with pytest.raises(ValueError, match="num_boxes must be one of 2, 4, 6"):
        SortingEnv(1, num_boxes=num_boxes)


def put(env, places):
    """Writes box positions [num_boxes, 2] into environment 0 and looks at them without moving anything."""
    for index, place in enumerate(places):
        env.sims.data[0].qpos[7 * index : 7 * index + 2] = place
    env._update_mode(np.array([0]))
    return env._check(np.array([0]))[0].item(), env._mode[0].tolist()


def test_success_needs_every_box_in_its_own_bin_and_ignores_height():
    env = SortingEnv(1, dtype=torch.float64)
    env.reset()
    centres = [(BIN_X[colour], BIN_Y) for colour in box_colours(4)]
    edges = [((0.301, 0.221), True), ((0.499, 0.409), True), ((0.299, 0.3), False), ((0.501, 0.3), False)]
    edges += [((0.4, 0.219), False), ((0.4, 0.411), False), ((0.625, 0.32), False)]
    for place, inside in edges:
        assert put(env, [place, *centres[1:]])[0] is inside, place
    blue = [((0.526, 0.3), True), ((0.724, 0.3), True), ((0.524, 0.3), False), ((0.726, 0.3), False)]
    for place, inside in blue:
        assert put(env, [*centres[:3], place])[0] is inside, place
    env.sims.data[0].qpos[2] = 5.0
    assert put(env, centres)[0]


def test_one_arrival_per_step_nearest_first_and_never_taken_back():
    env = SortingEnv(2, dtype=torch.float64)
    env.reset()
    away = (0.3, -0.3)
    assert put(env, [away] * 4) == (False, [-1] * 4)
    red, blue = (0.41, 0.32), (0.625, 0.32)
    assert put(env, [red, away, away, blue]) == (False, [1, -1, -1, -1])  # the blue one lies nearer to its centre
    assert put(env, [red, away, away, blue])[1] == [1, 0, -1, -1]
    assert env._noted[0].tolist() == [3, 0, -1, -1]
    assert put(env, [away, (0.4, 0.215), (0.7, 0.40), away])[1] == [1, 0, -1, -1]  # the nearest is not inside: nothing
    assert put(env, [away, away, (0.7, 0.40), away])[1] == [1, 0, 1, -1]
    assert put(env, [away, (0.625, 0.32), away, away])[1] == [1, 0, 1, -1]  # red in the blue bin
    assert put(env, [away, red, away, away]) == (False, [1, 0, 1, 0])
    assert put(env, [red, red, blue, blue]) == (True, [1, 0, 1, 0])
    assert env.task.modes.index_of(torch.as_tensor(env._mode)).tolist() == [4, -1]
    env.set_state(1, env.get_state(0))
    assert env._noted[1].tolist() == [3, 0, 2, 1] and env._mode[1].tolist() == [1, 0, 1, 0]
    env.reset()
    assert env._mode.tolist() == [[-1] * 4] * 2 and env._noted.tolist() == [[-1] * 4] * 2
