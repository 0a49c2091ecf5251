# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the scores of synthetic episodes against values computed by hand."""

import pytest
import torch
from toy_policies import episode_of, numbered_modes

from torchrl_koap.evaluation.scores import outcome_of, score, task_scores
from torchrl_koap.evaluation.statistics import bootstrap_interval, wilson_interval
from torchrl_koap.tasks import Modes, get_task


def test_outcomes():
    assert outcome_of(episode_of(3, success=True)) == "success"
    assert outcome_of(episode_of(3, collision=True)) == "collision"
    assert outcome_of(episode_of(3)) == "timeout"
    without = episode_of(3)
    del without["next", "collision"]
    assert outcome_of(without) == "timeout"
    counts = [score([each], [0], Modes()).get("collisions") for each in (without, episode_of(3))]
    assert counts == [None, 0]


def test_scores_by_hand():
    episodes = [
        episode_of(10, success=True, mode=0),
        episode_of(20, success=True, mode=0),
        episode_of(30, success=True, mode=1),
        episode_of(40, success=True, mode=2),
        episode_of(50, success=True, mode=-1),  # crossed the line without completing its mode
        episode_of(7, collision=True, mode=3),
        episode_of(90, mode=3),
        episode_of(8, collision=True, mode=-1),
    ]
    result = score(episodes, range(8), numbered_modes(4))
    rows = result.pop("episode")
    low, high = wilson_interval(5, 8)
    assert 0 <= result.pop("mode_entropy_low") < 0.75 < result.pop("mode_entropy_high") <= 1
    assert result == {
        "episodes": 8,
        "rates": {"success": {"rate": 0.625, "low": low, "high": high, "episodes": 8}},
        "mode_entropy": pytest.approx(0.75),
        "distinct_modes": 3,
        "collisions": 2,
        "mean_steps": pytest.approx(255 / 8),
    }
    assert rows[2] == {"seed": 2, "outcome": "success", "mode": 1, "steps": 30}
    assert rows[5]["outcome"] == "collision" and rows[6]["outcome"] == "timeout"
    with pytest.raises(ValueError, match="longer"):
        score(episodes, range(7), numbered_modes(4))


def test_entropy_per_context_by_hand():
    modes = [(0, 1), (1, 1), (-1, 0), (0, 0)]
    episodes = [episode_of(5, success=context < 3, mode=mode) for context in range(4) for mode in modes[context]]
    contexts = [context for context in range(4) for _ in range(2)]
    # entropies 1, 0, 0 (one of the two modes was not complete) of the contexts with success
    result = score(episodes, range(8), numbered_modes(2), contexts=contexts)
    assert result["mode_entropy"] == pytest.approx(1 / 3) and result["contexts"] == 4
    assert result["rates"]["success"]["rate"] == 6 / 8 and result["episode"][3]["context"] == 1
    assert result["pooled_mode_entropy"] == pytest.approx(0.9709505944546686)  # 2 of 0, 3 of 1
    assert 0 <= result["mode_entropy_low"] <= 1 / 3 <= result["mode_entropy_high"] <= 1
    result = score(episodes, range(8), numbered_modes(2, entropy="contexts"), contexts=contexts)
    assert result["mode_entropy"] == pytest.approx(1 / 4)


def test_one_rollout_per_context_has_no_entropy_per_context():
    episodes = [episode_of(5, success=True, mode=mode) for mode in (0, 1)]
    result = score(episodes, [7, 8], numbered_modes(2), contexts=[0, 1])
    assert result["mode_entropy"] is None and result["pooled_mode_entropy"] == pytest.approx(1.0)


def test_the_entropy_of_a_single_success_has_no_interval():
    episodes = [episode_of(5, success=success, mode=0) for success in (True, False)]
    result = score(episodes, range(2), numbered_modes(2))
    assert (result["mode_entropy"], result["mode_entropy_low"], result["mode_entropy_high"]) == (0.0, None, None)


@pytest.mark.parametrize("contexts", [None, [0, 0]])
def test_without_a_success_no_entropy_is_known(contexts):
    episodes = [episode_of(5, success=False, mode=mode) for mode in (0, 1)]
    result = score(episodes, [7, 8], numbered_modes(2), contexts=contexts)
    entropies = {name: value for name, value in result.items() if "entropy" in name}
    assert len(entropies) == (3 if contexts is None else 6) and set(entropies.values()) == {None}
    assert result["distinct_modes"] == 0


def stack_of(letters, success):
    episode = episode_of(4, success=success)
    letters = torch.tensor([*letters, -1, -1, -1])[:3]
    episode["next", "mode"] = letters.expand(4, 3).clone()
    return episode


def test_rates_of_stacking_join_the_success():
    episodes = [stack_of((0, 1, 2), True), stack_of((0, 2), False), stack_of((1,), False), stack_of((), False)]
    success = {"rates": {"success": {"rate": 0.25}}}
    found = task_scores(get_task("stacking"), success, episodes, [0, 0, 1, 1])
    assert list(found["rates"]) == ["success", "one box stacked", "two boxes stacked"]
    assert found["rates"]["one box stacked"]["rate"] == 0.75
    low, high = wilson_interval(2, 4)
    assert found["rates"]["two boxes stacked"] == {"rate": 0.5, "low": low, "high": high, "episodes": 4}


def test_without_modes_there_is_no_entropy():
    result = score([episode_of(4, success=True)], [0], Modes())
    assert result["rates"]["success"]["rate"] == 1.0 and not [name for name in result if "mode" in name]
    assert "mode" not in result["episode"][0]


def test_an_episode_in_which_the_environment_failed_is_no_success():
    failed = episode_of(2, success=True)
    failed["next", "failed"] = failed["next", "success"].clone()
    assert outcome_of(failed) == "error"
    assert score([failed], [0], Modes())["rates"]["success"]["rate"] == 0


def test_bootstrap_interval_covers_the_mean():
    values = [float(value) for value in range(100)]
    low, high = bootstrap_interval(values, lambda units: sum(units) / len(units))
    assert 40 < low < 49.5 < high < 59  # 49.5 +- 1.96 * 28.9 / 10
    low, high = bootstrap_interval([0.0, 1.0], lambda units: sum(units) / len(units))
    assert (low, high) == pytest.approx((0.0, 1.0), abs=0.05), "a statistic of 0 is one"
    assert bootstrap_interval([1.0] * 9, lambda units: sum(units) / len(units)) == (1.0, 1.0)
