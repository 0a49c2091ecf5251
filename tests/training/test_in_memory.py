# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that fitting in memory does what `koap train` does, on data with missing labels."""

import numpy as np
import offline_runs
import pytest
import torch
from offline_runs import NAMES, few_labels
from tensordict import TensorDict

from torchrl_koap import ControllerConfig, PlannerConfig, RunConfig, TrainConfig, Trained, fit, train
from torchrl_koap.data import LabelBudget, cut_windows, make_demonstrations, save_demonstrations, select_state
from torchrl_koap.data.ted import load_ted
from torchrl_koap.files import DataError
from torchrl_koap.modules import StatePlanner, TemporalUnet
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting
from torchrl_koap.objectives import DiffusionPolicyLoss, KOAPLoss
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import WINDOW
from torchrl_koap.training import planner as planner_training

SMALL = {"batch_size": 8, "width": 8}


def record(number=6, **options):
    """States ``[40, 4]`` and actions of a robot of two joints, and where these are to go."""
    return offline_runs.record(number, joints=2, **options)


def fit_controller(data, task=None, *, steps=500, preset=None, columns=None, **options):
    section = {"steps": steps, "preset": preset, "columns": columns}
    return fit(data, task, planner=False, controller=section, progress=False, **options)


def same_weights(module, other):
    state, other = module.state_dict(), other if isinstance(other, dict) else other.state_dict()
    return state.keys() == other.keys() and all(torch.equal(state[name], other[name]) for name in state)


def test_the_weights_of_a_training_bit_for_bit(tmp_path):
    folder = save_demonstrations(tmp_path / "arm", **few_labels())
    sections = {"planner": PlannerConfig(steps=30, **SMALL), "controller": ControllerConfig(steps=20)}
    train(TrainConfig(dataset=str(folder), out=tmp_path / "run", run=RunConfig(seed=3), **sections))
    data, task = load_ted(folder / "ted")[0], make_demonstrations(name="arm", **few_labels())[1]
    before = torch.manual_seed(11).get_state()
    trained = fit(data, task, planner={"steps": 30, **SMALL}, controller={"steps": 20}, seed=3, progress=False)
    assert torch.equal(torch.get_rng_state(), before)
    assert same_weights(trained.planner, load_tensors(tmp_path / "run" / "planner.safetensors")[0])
    assert same_weights(trained.controller, load_tensors(tmp_path / "run" / "controller.safetensors")[0])
    loaded = Trained.load(tmp_path / "run")
    assert loaded.hide_labels(loaded.data())[1].seed == 3


def test_commands_are_hidden_where_their_changes_are_as_on_disk(tmp_path):
    states, actions = [], []
    for frames, steps in zip(*record(), strict=True):
        states.append(np.hstack([frames, np.vstack([frames[:1, :2], frames[:1, :2] + steps[:-1].cumsum(0)])]))
        actions.append(np.vstack([steps[:15], np.full((10, 2), np.nan), steps[25:]]))
    roles = {"state_names": [*NAMES, "c1", "c2"], "robot": NAMES[:2], "command": ["c1", "c2"]}
    given, few = {"states": states, "actions": actions, "control_hz": 30} | roles, {"steps": 1, **SMALL}
    folder = save_demonstrations(tmp_path / "arm", **given)
    train(TrainConfig(dataset=str(folder), out=tmp_path / "run", method="mpc", planner=PlannerConfig(**few)))
    trained = fit(*make_demonstrations(name="arm", **given), method="mpc", planner=few, progress=False)
    assert same_weights(trained.controller, load_tensors(tmp_path / "run" / "controller.safetensors")[0])


def test_short_windows_hold_their_label_on_the_frame_that_counts(monkeypatch):
    batches = []
    monkeypatch.setattr(KOAPLoss, "forward", observed(KOAPLoss.forward, batches))
    data, task = make_demonstrations(**few_labels())
    data, _ = LabelBudget(count=20, unit="transition").apply(data)
    fit_controller(data, task, steps=2, preset="scene")
    assert [each["state"].shape[:2] for each in batches] == [(512, 10)] * 2  # one frame before, look-ahead of 8
    assert all(each["has_action"][:, 1].sum() == 0.75 * 512 for each in batches)


def observed(forward, batches):
    return lambda self, batch: batches.append(batch) or forward(self, batch)


def test_how_it_was_made_is_kept():
    data, task = make_demonstrations(**few_labels())
    trained = fit_controller(data, task, steps=5, columns="all")
    assert trained.task is task and trained.method.name == "koap" and trained.columns == (0, 1, 2, 3)
    assert trained.results["decoder_fit"]["labels_used"] == 68 and trained.results["controller_updates"] == 5
    assert not trained.controller.training and trained.planner is None


def test_a_planner_is_shared():
    data, task = make_demonstrations(**few_labels())
    first = fit(data, task, method="linear", planner={"steps": 2, "frames": 1, **SMALL}, progress=False)
    other = fit(data, task, method="koap_untrained", planner=first.planner, progress=False)
    assert other.planner is first.planner
    built = {name: getattr(other.config.planner, name) for name in ("network", "width", "octaves", "frames")}
    assert built == {"network": "mlp", "width": 8, "octaves": 0, "frames": 1}


def test_one_trajectory_is_told_to_be_too_few_to_hold_any_out(monkeypatch):
    monkeypatch.setattr(planner_training, "BLIND", 3)
    states, actions = record(1)
    data, task = make_demonstrations(**few_labels(states=states, actions=actions))
    with pytest.warns(UserWarning, match=r"one trajectory is too few .* trains for 3 updates, and overfitting"):
        trained = fit(data, task, method="linear", planner={"steps": 9, **SMALL}, progress=False)
    assert trained.held_out == () and "held_out_score" not in trained.results["planner"]


def test_a_planner_learns_nothing_of_what_is_held_out_and_a_controller_all_labels():
    data, task = make_demonstrations(**few_labels(6))
    options = {"method": "linear", "planner": {"steps": 2, **SMALL}, "progress": False}
    trained, other = fit(data, task, **options), data.clone()
    held_out = torch.isin(data["episode"], torch.tensor(trained.held_out))
    other["observation"][held_out] += 9.0
    moved = fit(other, task, **options)
    assert moved.held_out == trained.held_out and held_out.any()
    assert same_weights(moved.planner, trained.planner) and not same_weights(moved.controller, trained.controller)


def test_a_policy_without_plans_sees_trajectories_with_labels_alone():
    data, task = make_demonstrations(**few_labels())
    data["has_action"][9], data["action"][9] = False, torch.nan
    data["action"] += 50
    options = {"method": "dp", "planner": {"steps": 2, **SMALL}, "progress": False}
    trained, other = fit(data, task, **options), data.clone()
    other["observation"][data["episode"] > 1] += 9.0
    assert same_weights(fit(other, task, **options).controller, trained.controller)
    assert not trained.controller.training and trained.planner is None
    assert (trained.controller.action_normalizer.offset - 50).abs().max() < 5


def test_a_policy_without_plans_learns_from_the_last_steps_too_and_from_augmented_windows(monkeypatch):
    def moved(task, states, *, actions):
        assert actions
        return lambda batch: batch.update({"state": batch["state"] + 1000})

    monkeypatch.setattr("torchrl_koap.training.controller.augmentation", moved)
    batches, line = [], np.arange(41.0)[:, None]
    monkeypatch.setattr(DiffusionPolicyLoss, "forward", observed(DiffusionPolicyLoss.forward, batches))
    data, task = make_demonstrations([line] * 2, [line[:-1]] * 2, control_hz=10, action_kind="raw")
    fit(data, task, method="dp", planner={"steps": 2, "width": 8, "batch_size": 512}, progress=False)
    first = torch.cat([batch["action"][:, 1] for batch in batches])
    assert first.unique().tolist() == [*range(39)]  # steps that another one follows
    assert min(batch["state"].min() for batch in batches) == 1000


def test_a_teacher_predicts_targets_if_actions_are_targets():
    states = [50 + rows for rows in record()[0]]
    targets = [states[0][1:, :2], *[None] * 5]
    data, task = make_demonstrations(**few_labels(states=states, actions=targets), action_kind="absolute")
    options = {"planner": {"steps": 1, **SMALL}, "controller": {"steps": 1}, "progress": False}
    learned = fit(data, task, method="vpt", **options).controller.action_normalizer  # of all actions, most a teacher's
    assert (learned.offset - 50).abs().max() < 5 and learned.scale.max() < 5


def test_labels_marked_missing_or_found():
    data, task = make_demonstrations(**few_labels())
    expected = fit_controller(data, task, method="linear").controller
    unmarked = data.exclude("has_action")
    assert same_weights(fit_controller(unmarked, task, method="linear").controller, expected)
    full, _ = make_demonstrations(**few_labels(6))
    budgeted, _ = LabelBudget(episodes=[0, 1]).apply(full)
    assert same_weights(fit_controller(budgeted, task, method="linear").controller, expected)
    with_state = select_state(data, task.state_of)
    assert same_weights(fit_controller(with_state, task, method="linear").controller, expected)


def test_without_a_task_every_column_is_the_robots():
    data, _ = make_demonstrations(**few_labels())
    trained = fit(data, method="linear", planner={"steps": 2, **SMALL}, progress=False)
    assert trained.planner.state_dim == 4 and trained.task.robot == ()
    assert fit_controller(select_state(data, (0, 1)), method="linear").task.observation_dim == 2


def errors_of(method, task, data):
    """Action errors on trajectories that were not in the data, as shares of the actions."""
    states, actions = record(4, seed=9)
    windows = torch.from_numpy(np.stack(states)[..., :2]).float()
    controller = fit_controller(data, task, method=method, steps=0).controller
    with torch.no_grad():
        decoded = controller(TensorDict({"state": windows}, [len(windows)]))["action"][:, 4:-12]
    true = torch.from_numpy(np.stack(actions)).float()[:, 4:-12]
    return ((decoded - true).square().mean((0, 1)) / true.square().mean((0, 1))).sqrt().max().item()


def test_the_decoder_beats_a_ridge_on_a_lagging_robot():
    data, task = make_demonstrations(**few_labels(3))
    koap, ridge = (errors_of(method, task, data) for method in ("koap", "linear"))
    assert koap < 0.08 and koap < 0.75 * ridge, (koap, ridge)


def test_refusals():
    data, task = make_demonstrations(**few_labels())
    with pytest.raises(ValueError, match="unknown option of PlannerConfig 'widht'; did you mean 'width'"):
        fit(data, task, planner={"widht": 8})
    with pytest.raises(ValueError, match="unknown option of ControllerConfig 'width'"):
        fit(data, task, controller={"width": 8})
    with pytest.raises(ValueError, match="unknown method 'kaop'; did you mean 'koap'"):
        fit(data, task, method="kaop")
    unlabelled, _ = make_demonstrations(**few_labels(0, actions=None, action_dim=2))
    with pytest.raises(ValueError, match="none of the 234 steps has an action: there are no labels to select"):
        fit(unlabelled, task)
    with pytest.raises(ValueError, match="'state' has 3 columns, task 'robot' has 4"):
        fit(select_state(data, (0, 1, 2)), task)
    wrong = data.clone()
    wrong["has_action"][-1] = True
    with pytest.raises(DataError, match="a labelled 'action' is not finite in 1 steps"):
        fit(wrong, task)
    planner = fit(data, task, method="linear", planner={"steps": 1, **SMALL}, progress=False).planner
    with pytest.raises(ValueError, match="method 'dp' samples actions and has no planner"):
        fit(data, task, method="dp", planner=planner)
    with pytest.raises(ValueError, match="planner: it plans 2 columns, states of the data have 4"):
        fit(data, task, planner=StatePlanner(TemporalUnet(2, 4), state_dim=2))
    with pytest.raises(
        ValueError, match="planner must be a StatePlanner, a mapping of options, None or False, got int"
    ):
        fit(data, task, planner=3)


@pytest.mark.parametrize(
    ("method", "steps", "asked"),
    [("koap", 3, [(3, 4)]), ("koap_labelled_only", 3, [(3, 1)]), ("koap_untrained", 3, []), ("koap", 0, [])],
)
def test_a_lifting_starts_from_isomap_for_as_many_updates_as_it_is_trained_and_on_the_same_trajectories(
    monkeypatch, method, steps, asked
):
    seen = []

    def pretrain(lifting, windows, updates, progress):
        seen.append((updates, len(windows)))

    monkeypatch.setattr(CompactLifting, "pretrain", pretrain)
    walks = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(4)]
    wide = [np.tanh(walk @ np.random.default_rng(9).normal(size=(2, 20)) / 4) for walk in walks]
    data, task = make_demonstrations(wide, [np.diff(walks[0], axis=0), None, None, None], control_hz=30)
    fit_controller(data, task, method=method, preset="semi_supervised", steps=steps)
    own = len(cut_windows(select_state(data, task.state_of), WINDOW, pad_before=8)) // 4  # of a trajectory
    assert [(updates, round(windows / own)) for updates, windows in seen] == asked


@pytest.mark.parametrize("method", ["koap", "dd"])
def test_data_in_double_precision_are_fitted_like_others(method):
    data, task = make_demonstrations(**few_labels())
    wide = data.clone()
    for key in ("observation", ("next", "observation"), "action"):
        wide[key] = data[key].double()
    fitted = [fit_controller(each, task, method=method, steps=2) for each in (data, wide)]
    assert same_weights(*(each.controller for each in fitted))
    assert wide["observation"].dtype == torch.float64


def test_commands_stay_in_the_range_of_the_labels_in_memory_and_in_a_file(tmp_path):
    """Changes of one unit share their range; targets may be wherever a demonstration was."""
    states, actions = record()
    largest = max(np.abs(rows).max() for rows in actions[:2])
    data, task = make_demonstrations(**few_labels())
    trained = fit_controller(data, task, steps=0)
    assert trained.results["command_ranges"] == [pytest.approx([-largest, largest], rel=1e-6)] * 2
    targets = [np.concatenate([rows[1:, :2], rows[-1:, :2]]) if n < 2 else None for n, rows in enumerate(states)]
    data, task = make_demonstrations(**few_labels() | {"actions": targets}, action_kind="absolute")
    trained = fit(data, task, planner={"steps": 1, "held_out": 0.0, **SMALL}, controller={"steps": 0}, progress=False)
    low, high = np.concatenate(states)[:, 0].min(), np.concatenate(states)[:, 0].max()
    assert trained.results["command_ranges"][0] == pytest.approx([low, high], rel=1e-6)
    loaded = Trained.load(trained.save(tmp_path / "arm.safetensors"))
    wider = pytest.approx([low - 0.5 * (high - low), high + 0.5 * (high - low)], rel=1e-5)
    assert loaded.policy().limits.ends[0].tolist() == wider


def drawn_to_a_goal():
    """Three joints that go 0.4 % of the way to one goal in every frame, and the changes that do it."""
    random = np.random.default_rng(0)
    goal, starts = random.uniform(-1, 1, 3), random.uniform(-1, 1, (12, 3))
    states = [goal + 0.996 ** np.arange(300)[:, None] * (start - goal) for start in starts]
    return states, [np.diff(rows, axis=0) for rows in states]


def test_plans_of_smooth_motions_at_a_high_rate_do_not_grow_in_a_loop():
    """Where velocity follows from position, their difference must not tell how far a window was displaced."""
    states, actions = drawn_to_a_goal()
    data, task = make_demonstrations(states, actions[:4] + [None] * 8, control_hz=500)
    options = {"planner": {"network": "mlp", "frames": 2, "steps": 2, **SMALL}, "controller": {"steps": 0}}
    planner = fit(data, task, **options, progress=False).planner
    frames = torch.tensor(np.stack([rows[[0, 0]] for rows in states]), dtype=torch.float32)
    with torch.no_grad():
        for _ in range(60):
            following = planner.sample(frames, torch.zeros(len(frames), *planner.noise_shape))[:, :1]
            frames = torch.cat([frames[:, 1:], following], 1)
    assert frames.diff(dim=1).abs().max() < 3 * max(np.abs(rows).max() for rows in actions)


def test_wrong_arguments_are_named():
    states = few_labels()["states"]
    data, task = make_demonstrations(**few_labels())
    for wrong in (states, (data, task)):
        with pytest.raises(
            TypeError, match=f"data must be the data of make_demonstrations.*got {type(wrong).__name__}"
        ):
            fit(wrong)
    with pytest.raises(ValueError, match="planner.steps must be a number >= 1, got '500'"):
        fit(data, task, planner={"steps": "500"})
    with pytest.raises(ValueError, match=r"planner.steps must be a whole number, got 2\.5"):
        fit(data, task, planner={"steps": 2.5})
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="device 'cuda' was asked for"):
            fit(data, task, device="cuda")
    options = {"device": torch.device("cpu"), "seed": np.int64(3)}
    assert fit(data, task, planner=False, controller={"steps": 2.0}, progress=False, **options).config.run.seed == 3


def test_sections_of_a_training_are_of_their_classes():
    with pytest.raises(TypeError, match="planner must be a PlannerConfig, got {'steps': 5}"):
        TrainConfig(out="run", planner={"steps": 5})
