# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that rollouts depend on their seed alone, and the numbers computed from them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from toy_policies import (
    CountingPlanner,
    EchoController,
    EpisodesOfRandomLength,
    PlannedStep,
    episode_of,
    numbered_modes,
    wandering_planner,
)

from torchrl_koap import EvalConfig, evaluate
from torchrl_koap.envs.avoiding import AvoidingEnv
from torchrl_koap.envs.transforms import EndEffectorNoise
from torchrl_koap.evaluation import InspectConfig, inspect
from torchrl_koap.evaluation.latency import measure_latency
from torchrl_koap.evaluation.rollouts import roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import score
from torchrl_koap.modules import make_policy
from torchrl_koap.runs.device import torch_as_before
from torchrl_koap.tasks import Action, get_task
from torchrl_koap.training.trained import Trained

SEEDS = [100, 101, 102, 103, 104, 105, 106, 107]
KEYS = ({}, {"history_key": "frames"})


def toy_rollouts(seeds, batch_size=None, **options):
    policy = make_policy(wandering_planner(), PlannedStep(), state_of=(2, 3))
    return roll_out(policy, AvoidingEnv, seeds, max_steps=90, batch_size=batch_size, **options)


@pytest.fixture(scope="module")
def together():
    return toy_rollouts(SEEDS)


def facts(episodes, seeds=SEEDS):
    rows = score(episodes, seeds, get_task("avoiding").modes)["episode"]
    return [(row["seed"], row["outcome"], row["mode"], row["steps"]) for row in rows]


def test_the_compared_episodes_differ(together):
    outcomes = [outcome for _, outcome, _, _ in facts(together)]
    assert {"success", "collision"} <= set(outcomes), outcomes
    assert len({steps for *_, steps in facts(together)}) >= 4
    assert len({mode for _, _, mode, _ in facts(together)}) >= 3


@pytest.mark.parametrize("batch_size", [3, 1])
def test_results_do_not_depend_on_the_batch_size(together, batch_size):
    finished = []
    apart = toy_rollouts(SEEDS, batch_size=batch_size, progress=finished.append)
    assert facts(apart) == facts(together)
    for one, other in zip(apart, together, strict=True):
        assert (one["observation"] - other["observation"]).abs().max() < 1e-4
        assert (one["next", "observation"] - other["next", "observation"]).abs().max() < 1e-4
        assert (one["plan"] - other["plan"]).abs().max() < 1e-3
    assert finished == [min(done, 8) for done in range(batch_size, 8 + batch_size, batch_size)]


def test_observation_noise_of_an_episode_depends_on_its_seed_alone():
    def noisy(num_envs):
        return TransformedEnv(AvoidingEnv(num_envs), EndEffectorNoise("avoiding", sigma=0.003))

    policy = make_policy(wandering_planner(), PlannedStep(), state_of=(2, 3))
    paths = [
        roll_out(policy, noisy, SEEDS[:3], max_steps=12, batch_size=size)[2]["observation"] for size in (None, 2, 1)
    ]
    assert torch.equal(paths[0], paths[1]) and torch.equal(paths[0], paths[2])
    clean = roll_out(policy, AvoidingEnv, SEEDS[2:3], max_steps=12)[0]["observation"]
    assert 1e-4 < (paths[0][0] - clean[0])[2:].abs().max() < 0.02


def test_rollouts_depend_on_the_seed_not_on_batch_position_or_global_generator(together):
    torch.manual_seed(123)
    before = torch.get_rng_state()
    other = toy_rollouts([107, 7, 100])
    assert torch.equal(torch.get_rng_state(), before)
    for new, old in ((other[0], together[7]), (other[2], together[0])):
        assert len(new) == len(old)
        assert (new["next", "observation"] - old["next", "observation"]).abs().max() < 1e-4
    assert not any(len(other[1]) == len(e) and torch.allclose(other[1]["action"], e["action"]) for e in together)


def test_an_environment_that_draws_its_own_starts_is_seeded():
    class Drawn(EpisodesOfRandomLength):
        def _set_seed(self, seed):
            self.generator = np.random.default_rng(seed)

        def _reset(self, tensordict):
            seen = torch.tensor(self.generator.normal(size=(2, 3))).float()
            return super()._reset(tensordict).set("observation", seen)

    def starts(seeds, **options):
        policy = make_policy(wandering_planner(), EchoController(), state_of=(1, 2))
        episodes = roll_out(policy, lambda num: Drawn(num, [[1]] * num), seeds, max_steps=2, **options)
        return torch.stack([episode[0]["observation"] for episode in episodes])

    assert torch.equal(starts([5, 6]), starts([5, 6])) and not torch.equal(starts([5, 6]), starts([7, 8]))
    assert torch.equal(starts([5, 6, 7, 8], batch_size=2)[2:], starts([7, 8])), "not as those of the first batch"


def test_one_episode_per_environment_even_if_some_end_early():
    """The first to finish are not over-represented: short and long episodes count once each."""
    lengths = ((3, 3, 3, 3), (9,), (1,), (30,))
    policy = make_policy(CountingPlanner(), EchoController(), state_of=(1, 2))
    episodes = roll_out(policy, lambda n: EpisodesOfRandomLength(n, lengths), [0, 1, 2, 3], max_steps=12)
    assert [len(episode) for episode in episodes] == [3, 9, 1, 12]
    for episode in episodes:  # from its beginning on, no reset inside
        assert episode["observation"][:, 1].diff().tolist() == [1.0] * (len(episode) - 1)
    assert not episodes[3]["next", "done"].any()


def test_episodes_that_are_over_are_neither_planned_nor_counted():
    policy = make_policy(CountingPlanner(), EchoController(), state_of=(1, 2), ranges=[(0.0, 0.0)] * 4)
    roll_out(policy, lambda n: EpisodesOfRandomLength(n, ((9,), (1,), (3,))), [0, 1, 2], max_steps=12)
    assert policy.limited.tolist() == [13, 13]  # every action of an episode was held in its range
    assert [len(states) for states in policy.planner.calls] == [3, 1, 1]


class Placed(EpisodesOfRandomLength):
    """Shows in its last column where an episode began."""

    def _reset(self, tensordict=None, contexts=None):
        first = super()._reset(tensordict)
        first["observation"][:, 2] = torch.as_tensor(contexts)
        return first


@pytest.mark.parametrize(("batch_size", "parts"), [(None, [(0, 3)]), (2, [(0, 2), (2, 3)])])
def test_every_episode_begins_in_its_own_context_and_is_handed_what_is_its_own(batch_size, parts):
    asked = []

    def given(part):
        asked.append((part.start, part.stop))
        return TensorDictModule(lambda: torch.zeros(part.stop - part.start, 6, 2), in_keys=[], out_keys=["noise"])

    policy = make_policy(CountingPlanner(), EchoController(), state_of=(0, 1))
    options = {"max_steps": 3, "batch_size": batch_size, "contexts": [5.0, 6.0, 7.0]}
    episodes = roll_out(policy, lambda n: Placed(n, ((9,),) * n), [0, 1, 2], given=given, **options)
    assert asked == parts and [episode["observation"][0, 2].item() for episode in episodes] == options["contexts"]
    with pytest.raises(ValueError, match="one context per seed is needed, got 3 and 2"):
        roll_out(policy, lambda n: Placed(n, ((9,),) * n), [0, 1], **options)


def test_a_policy_may_read_its_history_from_another_entry():
    policies = [make_policy(CountingPlanner(), EchoController(), state_of=(1, 2), **keys) for keys in KEYS]
    first, second = (
        roll_out(policy, lambda n: EpisodesOfRandomLength(n, ((5,),)), [0], max_steps=6)[0] for policy in policies
    )
    assert torch.equal(first["action"], second["action"]) and len(first) == 5


COUNTED = replace(get_task("avoiding"), modes=numbered_modes(4), actions={"x": Action(), "y": Action()}, robot=(1, 0))


def test_pictures_get_padded_paths_and_the_plans_that_were_made():
    episodes = [episode_of(6, success=True, mode=1), episode_of(3, collision=True, mode=-1, start=50.0)]
    tensors = rollouts_to_tensors(episodes, COUNTED, interval=4)
    assert tensors["length"].tolist() == [6, 3] and tensors["outcome"].tolist() == [1, 2]
    assert tensors["mode"].tolist() == [1, -1]
    assert tensors["position"].shape == (2, 7, 2)
    assert tensors["position"][0, :, 0].tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert tensors["position"][1, :4, 0].tolist() == [50, 51, 52, 53]
    assert tensors["position"][1, 4:].isnan().all()
    assert tensors["plan"].shape == (2, 2, 14, 2) and tensors["plan_step"].tolist() == [[0, 4], [0, -1]]
    assert tensors["plan"][0, :, 0, 0].tolist() == [0, 4] and tensors["plan"][1, 0, 0, 0] == 50
    assert tensors["plan"][1, 1].isnan().all()
    tensors = rollouts_to_tensors(episodes, replace(COUNTED, env=None), interval=4)
    assert tensors["column"].tolist() == [1, 0] and tensors["state"].shape == (2, 7, 2)
    assert torch.equal(tensors["state"][0].flip(-1), tensors["position"][0]) and tensors["state"][1, 4:].isnan().all()
    assert torch.equal(tensors["state_plan"][0].flip(-1), tensors["plan"][0])
    plain = rollouts_to_tensors([episode_of(3, plans=False)], COUNTED, interval=4)
    assert plain["plan"].shape[:2] == (1, 0) and plain["plan_step"].shape == (1, 0)


def test_latency_is_measured_per_plan_and_per_step():
    class Slow(CountingPlanner):
        def sample(self, history, noise=None):
            torch.randn(400, 400) @ torch.randn(400, 400)
            return super().sample(history, noise)

    planner = Slow()
    policy = make_policy(planner, EchoController(), state_of=(1, 2))
    result = measure_latency(policy, 3)
    assert len(planner.calls) == 30 + 3  # one plan for two steps
    assert result["plan_ms"] > 0 and result["control_ms"] > 0
    assert result["control_hz"] == pytest.approx(1e3 / (result["control_ms"] + result["plan_ms"] / 4))
    assert math.isfinite(result["control_hz"])


@pytest.mark.parametrize(("run", "options"), [(evaluate, EvalConfig), (inspect, InspectConfig)])
@pytest.mark.parametrize(("given", "known", "taken"), [(None, None, 1), (3, None, 3), (None, "2", 2)])
def test_one_thread_is_the_default(run, options, given, known, taken, tmp_path, monkeypatch):
    """Two threads beside another program took twenty times as long."""
    threads = torch.get_num_threads()
    monkeypatch.setenv("OMP_NUM_THREADS", known) if known else monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    seen = []
    monkeypatch.setattr(Trained, "load", lambda *_, **__: seen.append(torch.get_num_threads()) or 1 / 0)
    with torch_as_before(), pytest.raises(ZeroDivisionError):
        torch.set_num_threads(2)
        run(str(tmp_path), options(threads=given))
    assert seen == [taken] and torch.get_num_threads() == threads
