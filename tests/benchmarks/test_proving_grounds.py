# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations of others become data sets; rows of the table are those of the rollouts."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
from shared_data import SHARED
from tensordict import TensorDict

from torchrl_koap.data import open_dataset
from torchrl_koap.vision import Observer, cameras_of, load_backbone

OWN = "tiny_network:random_layer"


def test_the_angle_of_the_block_becomes_cosine_and_sine(benchmark_script):
    columns = benchmark_script("proving_grounds").six_columns(np.array([[1.0, 2.0, 3.0, 4.0, np.pi / 2]]))
    np.testing.assert_allclose(columns, [[1, 2, 3, 4, 0, 1]], atol=1e-6)


def test_missing_demonstrations_are_named(benchmark_script, monkeypatch, tmp_path):
    script = benchmark_script("proving_grounds")
    monkeypatch.setattr(script, "DATA", tmp_path / "pusht.npz")
    with pytest.raises(FileNotFoundError, match="pusht.npz is not there"):
        script.write_data_set(tmp_path / "data")


def test_push_t_becomes_a_data_set(benchmark_script, monkeypatch, tmp_path):
    data = SHARED / "proving_grounds" / "pusht_human_206.npz"
    if not data.is_file():
        pytest.skip(f"{data} is not there")
    script = benchmark_script("proving_grounds")
    monkeypatch.setattr(script, "DATA", data)
    script.write_data_set(tmp_path / "data")
    steps, task = open_dataset(str(tmp_path / "data"))
    assert len(steps["episode"].unique()) == 206 and len(steps) == 25_650 - 206
    assert task.targets == (0, 1) and task.robot == (0, 1) and task.state_dim == 6


def test_frames_of_recorded_states_become_columns(benchmark_script, monkeypatch, tmp_path):
    pytest.importorskip("gym_pusht")
    script = benchmark_script("proving_grounds")
    states = np.random.default_rng(0).uniform(150, 350, (3, 30, 5))
    monkeypatch.setattr(script, "read_episodes", lambda: (list(states), [frames[:, :2] for frames in states]))
    monkeypatch.setattr("torchrl_koap.vision.embedding.load_backbone", lambda network: load_backbone(OWN))
    script.write_pixels(tmp_path / "data")
    steps, task = open_dataset(str(tmp_path / "data"))
    assert len(steps) == 87 and task.robot == (0, 1) and task.targets == (0, 1) and task.state_dim == 2 + 64
    env, other = script.make_pixels(), script.make_pixels()
    env.reset(seed=3), other.reset(seed=1)
    for step in range(40):  # the agent runs into the block
        seen, *_ = env.step(np.array(env.unwrapped.block.position))
        agent, block = env.unwrapped.agent, env.unwrapped.block
        drawn = script.draw(other.unwrapped, np.array([*agent.position, *block.position, block.angle]))
        np.testing.assert_array_equal(drawn, seen["pixels"], str(step))
    frame = script.draw(other.unwrapped, states[1, 4])
    seen = Observer(task, cameras_of(tmp_path / "data"))({"state": states[1, 4, :2].astype(np.float32), "top": frame})
    torch.testing.assert_close(seen, steps["observation"][29 + 4], rtol=1e-4, atol=1e-4)


def test_a_row_is_the_mean_largest_reward(benchmark_script, monkeypatch, tmp_path):
    script, asked = benchmark_script("proving_grounds"), []

    class Ran:
        task, results = None, {"planner": {"best_held_out_score": 0.25, "kept_update": 700}}

    def episodes(policy, make_env, seeds, **options):
        asked.append(seeds)
        rewards = torch.tensor([[0.1], [0.4 if seeds[0] % 2 else 1.0]])
        return [TensorDict({"next": {"reward": rewards}}, [2]) for _ in seeds]

    monkeypatch.setattr(script, "write_data_set", lambda folder: folder.mkdir())
    monkeypatch.setattr(script, "train", lambda config: asked.append(config) or Ran)
    monkeypatch.setattr(script, "load_policy", lambda *args, **options: None)
    monkeypatch.setattr(script, "roll_out", episodes)
    table = tmp_path / "table.csv"
    for _ in range(2):  # the second finds everything done
        script.main(seeds=1, n=2, methods=("koap",), folder=tmp_path, results=table)
    assert [type(each).__name__ for each in asked] == ["TrainConfig", "list", "list", "list"]
    assert asked[0].labels.count == 10 and asked[1] == [100_000, 100_001]
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["execution"] for row in rows] == ["default", "open_loop_8", "temperature_1"]
    assert {(row["largest_reward"], row["successes"], row["kept_update"]) for row in rows} == {("1.0000", "2", "700")}
