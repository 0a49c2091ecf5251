# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests proving grounds: data sets, and rows of rollouts or of errors on recordings."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch
from proving_grounds import meta_world, pusht, run
from proving_grounds.ground import Ground
from tensordict import TensorDict

from torchrl_koap.data import open_dataset
from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch
from torchrl_koap.vision import Observer, load_backbone
from torchrl_koap.vision.encoder import cameras_of

OWN = "tiny_network:random_layer"
GROUNDS = run.grounds()


def needed(name):
    if lacks := GROUNDS[name].missing():
        pytest.skip(f"{name}: {lacks}")
    return GROUNDS[name]


# data set: recordings, steps, columns of the state, of the robot, targets
WRITTEN = {
    "pusht": (206, 25_650 - 206, 6, (0, 1), (0, 1)),
    "unitree_g1": (100, 35_865, 26, tuple(range(26)), tuple(range(26))),
    "adroit_door": (25, 6_729 - 25, 39, (*range(27), 29, 30, 31), ()),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_recordings_become_a_data_set(name, tmp_path):
    ground = GROUNDS[name]
    if not ground.data.exists():
        pytest.skip(ground.missing())
    ground.write(tmp_path / "data")
    steps, task = open_dataset(str(tmp_path / "data"))
    recordings = len(steps["episode"].unique())
    assert (recordings, len(steps), task.state_dim, task.robot, tuple(task.targets.values())) == WRITTEN[name]
    assert steps["has_action"].all()


def test_frames_of_recorded_states_become_columns(monkeypatch, tmp_path):
    pytest.importorskip("gym_pusht")
    states = np.random.default_rng(0).uniform(150, 350, (3, 30, 5))
    monkeypatch.setattr(pusht, "read_episodes", lambda: (list(states), [frames[:, :2] for frames in states]))
    monkeypatch.setattr("torchrl_koap.vision.embedding.load_backbone", lambda network: load_backbone(OWN))
    pusht.write_pixels(tmp_path / "data")
    steps, task = open_dataset(str(tmp_path / "data"))
    assert (
        len(steps) == 87
        and task.robot == (0, 1)
        and tuple(task.targets.values()) == (0, 1)
        and task.state_dim == 2 + 32
    )
    env, other = pusht.make_pixels(), pusht.make_pixels()
    env.reset(seed=3), other.reset(seed=1)
    for step in range(40):  # the agent runs into the block
        seen, *_ = env.step(np.array(env.unwrapped.block.position))
        agent, block = env.unwrapped.agent, env.unwrapped.block
        drawn = pusht.draw(other.unwrapped, np.array([*agent.position, *block.position, block.angle]))
        np.testing.assert_array_equal(drawn, seen["pixels"], str(step))
    frame = pusht.draw(other.unwrapped, states[1, 4])
    seen = Observer(task, cameras_of(tmp_path / "data"))({"state": states[1, 4, :2].astype(np.float32), "top": frame})
    torch.testing.assert_close(seen.float(), steps["observation"][29 + 4], rtol=1e-4, atol=1e-4)


def test_grounds_with_missing_data_or_packages_are_skipped_by_name(monkeypatch, capsys, tmp_path):
    (tmp_path / "half_simulator.py").write_text("import its_dependency")
    monkeypatch.syspath_prepend(tmp_path)
    away = Ground(lambda folder: None, "success", (5,), 1, data=tmp_path / "away.npz")
    lacking = {"bare": "no_such_simulator", "half": "half_simulator"}
    lacking = {
        name: Ground(lambda folder: None, "success", (5,), 1, package=package, install="pip install it")
        for name, package in lacking.items()
    }
    monkeypatch.setattr(run, "grounds", lambda: {"away": away} | lacking)
    run.main(results=tmp_path / "table.csv")
    one, *others = capsys.readouterr().out.splitlines()
    assert one.startswith("away is skipped: ") and "away.npz is not there" in one
    assert others == [
        "bare is skipped: No module named 'no_such_simulator': pip install it",
        "half is skipped: No module named 'its_dependency': pip install it",
    ]


@pytest.mark.parametrize("asked", [{"methods": ("koap", "kaop")}, {"executions": ("slow",)}], ids=str)
def test_unknown_names_end_with_a_sentence(asked, tmp_path):
    with pytest.raises(SystemExit, match="unknown"):
        run.main(results=tmp_path / "table.csv", **asked)


class Ran:
    folder, task, cameras, results = "run", None, None, {"planner": {"best_held_out_score": 0.25, "kept_update": 700}}


@pytest.fixture
def table_of(monkeypatch, tmp_path):
    """Runs a ground twice, of which the second finds everything done; returns what was asked for, and the rows."""

    def runs(score, **options):
        asked = []

        def episodes(policy, make_env, seeds, **options):
            asked.append(seeds)
            ends = {"reward": torch.tensor([[0.1], [1.0]]), "success": torch.tensor([[False], [seeds[0] % 2 == 0]])}
            return [TensorDict({"next": ends}, [2]) for _ in seeds]

        ground = Ground(lambda folder: (folder / "ted").mkdir(parents=True), score, (10,), 12, env="Toy-v0")
        if score == "errors":
            ground = Ground(ground.write, score, (10,), 12)
        monkeypatch.setattr(run, "grounds", lambda: {"toy": ground})
        monkeypatch.setattr(run, "train", lambda config: asked.append(config) or Ran)
        monkeypatch.setattr(run, "load_policy", lambda *args, **options: None)
        monkeypatch.setattr(run, "roll_out", episodes)
        outside = {"relative": 0.6, "ridge_relative": 0.8}
        errors = {"relative_plan_error": 0.5, "action_errors": {"outside_budget": outside}}
        monkeypatch.setattr(run, "evaluate", lambda folder, config: errors)
        for _ in range(2):
            run.main(("toy",), seeds=1, methods=("koap",), folder=tmp_path, results=tmp_path / "table.csv", **options)
        with (tmp_path / "table.csv").open() as file:
            return asked, list(csv.DictReader(file))

    return runs


def test_a_row_is_the_mean_largest_reward(table_of):
    asked, rows = table_of("reward", n=2, executions=("default", "open_loop_8"))
    assert [type(each).__name__ for each in asked] == ["TrainConfig", "list", "list"]
    assert asked[0].labels.count == 10 and asked[1] == [100_000, 100_001]
    assert [row["execution"] for row in rows] == ["default", "open_loop_8"]
    assert {(row["largest_reward"], row["successes"], row["kept_update"]) for row in rows} == {("1.0000", "2", "700")}


def test_a_row_counts_what_the_simulator_calls_success(table_of):
    _, (row,) = table_of("success")
    assert (row["successes"], row["n"], row["largest_reward"]) == ("12", "12", "")


def test_a_ground_scores_the_runs_of_another(monkeypatch, tmp_path):
    written, asked = [], []
    first = Ground(
        lambda folder: (written.append(folder.name), (folder / "ted").mkdir(parents=True)), "errors", (10,), 12
    )
    monkeypatch.setattr(run, "grounds", lambda: {"wide": first, "narrow": replace(first, runs_of="wide")})
    monkeypatch.setattr(run, "train", lambda config: asked.append(config) or Ran)
    monkeypatch.setattr(run, "judge", lambda trained: {})
    run.main(seeds=1, methods=("koap", "linear_steps"), folder=tmp_path, results=tmp_path / "table.csv")
    assert written == ["wide"] and asked[:2] == asked[2:]
    assert asked[3].planner.source == asked[0].out == tmp_path / "wide-koap-10-0"
    with (tmp_path / "table.csv").open() as file:
        assert [row["ground"] for row in csv.DictReader(file)] == ["wide", "wide", "narrow", "narrow"]


def test_a_row_has_errors_on_recordings_without_a_simulator(table_of):
    asked, (row,) = table_of("errors")
    assert len(asked) == 1 and (row["plan_error"], row["action_error"]) == ("0.5000", "0.7500")
    assert row["n"] == "2" and row["successes"] == ""  # those without labels


@pytest.mark.parametrize("name", [name for name, ground in GROUNDS.items() if ground.env and "pixels" not in name])
def test_simulators_give_the_columns_of_the_data(name, tmp_path, monkeypatch):
    ground = needed(name)
    monkeypatch.setattr(meta_world.record, "__defaults__", (2,))
    ground.write(tmp_path / "data")
    steps, task = open_dataset(str(tmp_path / "data"))
    env = GymnasiumBatch(ground.env, task, 1, max_steps=ground.max_steps)
    env.seed_episodes([0])
    assert env.reset()["observation"].shape == (1, steps["observation"].shape[-1])
