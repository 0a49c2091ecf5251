# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the label budget reports the labels it keeps and hides all others from later steps."""

import json
import math
from dataclasses import asdict

import counted_windows
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, flatten_trajectories, make_window_buffer, select_state
from torchrl_koap.data.label_budget import hide_commands, subsample_trajectories
from torchrl_koap.keys import validate
from torchrl_koap.modules import Normalizer

UNITS = ("trajectory", "window", "transition")
COMMAND = slice(0, 2)


def demonstrations(lengths=(20, 33, 16, 40), seed=0):
    """Observations [command, measured] whose command differences are the actions."""
    generator = torch.Generator().manual_seed(seed)
    frames = [torch.randn(length + 1, 4, generator=generator).double() for length in lengths]
    return flatten_trajectories(frames, [torch.diff(f[:, :2], dim=0) for f in frames], dtype=torch.float64)


def budget_of(amount, **options):
    return LabelBudget(**{"count" if isinstance(amount, int) else "fraction": amount}, **options)


def spent(data, seed=0, **options):
    return LabelBudget(seed=seed, **options).apply(data)[0]["has_action"].squeeze(-1)


def same_bits(left, right):
    if isinstance(left, torch.Tensor):
        assert left.dtype == right.dtype and left.shape == right.shape
        assert left.numpy().tobytes() == right.numpy().tobytes()
        return
    for key in left.keys(True, True) if isinstance(left, TensorDictBase) else left:
        same_bits(left[key], right[key])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(16, 40), min_size=1, max_size=12),
    st.sampled_from(UNITS),
    st.one_of(st.integers(1, 60), st.floats(0.01, 1.0)),
    st.integers(0, 5),
)
def test_the_report_counts_the_labels(lengths, unit, amount, seed):
    data = demonstrations(lengths)
    totals = {"trajectory": len(lengths), "window": sum(n - 15 for n in lengths), "transition": sum(lengths)}
    expected = amount if isinstance(amount, int) else math.floor(amount * totals[unit] + 0.5)
    if not 1 <= expected <= totals[unit]:
        with pytest.raises(ValueError, match=f"{totals[unit]}"):
            budget_of(amount, unit=unit, seed=seed).apply(data)
        return
    labelled, report = budget_of(amount, unit=unit, seed=seed).apply(data)
    validate(labelled)
    kept = labelled["has_action"].squeeze(-1)
    assert report.selected_units == expected and report.total_units == totals[unit]
    assert report.labelled_transitions == int(kept.sum())
    assert report.total_transitions == sum(lengths)
    assert report.trajectories_touched == len(data["episode"][kept].unique())
    assert report.total_trajectories == len(lengths)
    assert (report.available_units, report.available_transitions) == (totals[unit], sum(lengths))
    same_bits(labelled["action"][kept], data["action"][kept])
    assert labelled["action"][~kept].isnan().all()
    if unit == "trajectory":
        assert report.trajectories_touched == expected
        assert set(data["episode"][kept].tolist()).isdisjoint(data["episode"][~kept].tolist())
    elif unit == "transition":
        assert report.labelled_transitions == expected
    else:
        assert 14 <= report.labelled_transitions <= 14 * expected
        assert not kept[data["step_count"] == 0].any()  # no window has frame 0 as an inner frame
        assert not kept[data["next", "done"].squeeze(-1)].any()
    assert json.loads(json.dumps(asdict(report))) == asdict(report)


@pytest.mark.parametrize("unit", UNITS)
def test_the_input_is_untouched(unit):
    data = demonstrations()
    before = data.clone()
    labelled, _ = LabelBudget(count=2, unit=unit).apply(data, command=COMMAND)
    labelled.apply_(lambda value: value.zero_())
    assert (data == before).all()


@pytest.mark.parametrize("unit", UNITS)
def test_the_seed_alone_decides(unit):
    data, draws = demonstrations(), []
    for number in range(2):
        torch.manual_seed(number), np.random.seed(number)
        state = torch.get_rng_state()
        draws.append(spent(data, count=2, unit=unit))
        assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(*draws)
    assert len({tuple(spent(data, seed, count=2, unit=unit).tolist()) for seed in range(8)}) > 2


@pytest.mark.parametrize("unit", UNITS)
def test_larger_budgets_contain_smaller_ones(unit):
    kept = [spent(demonstrations(), 4, count=count, unit=unit) for count in (1, 2, 4)]
    for small, large in zip(kept[:-1], kept[1:], strict=True):
        assert (large | ~small).all() and large.sum() > small.sum()


@pytest.mark.parametrize(
    ("amount", "total", "expected"),
    [(0.02, 96, 2), (0.005, 100, 1), (0.145, 100, 15), (0.01, 96, 1), (1.0, 7, 7), (1, 7, 1), (0.5, 3, 2), (0.3, 5, 2)],
)
def test_shares_are_rounded_half_up(amount, total, expected):
    assert budget_of(amount).apply(demonstrations((2,) * total))[1].selected_units == expected


@pytest.mark.parametrize("total", [3, 7, 30, 96])
def test_selecting_nothing_names_a_fraction_that_works(total):
    data = demonstrations((3,) * total)
    with pytest.raises(ValueError, match=f"none of the {total} trajectories") as error:
        LabelBudget(fraction=0.49 / total).apply(data)
    least = float(str(error.value).split()[-1])
    assert LabelBudget(fraction=least).apply(data)[1].selected_units == 1
    assert least <= 0.5 / total * 1.001


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"count": count}, "count .* whole number of at least 1") for count in (0, -1, 2.0, "3")),
        *(
            ({"fraction": fraction}, r"labels: fraction must be in \(0, 1\]")
            for fraction in (0, -0.5, 1.5, math.nan, math.inf, "0.1")
        ),
        ({"count": 1, "unit": "windows"}, "unknown unit of labels 'windows'"),
        ({"fraction": 0.1, "count": 1}, "give one of fraction, count and episodes, got fraction and count"),
        ({"count": 3, "episodes": (1, 2)}, "got count and episodes"),
        ({"episodes": []}, "one or more different numbers"),
        ({"episodes": [1, 1]}, "one or more different numbers"),
        ({"episodes": (1, 2), "unit": "window"}, "labels: episodes are trajectories, got unit 'window'"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        LabelBudget(**options)


def test_commands_hide_with_the_actions():
    data = demonstrations()
    labelled, _ = LabelBudget(count=2, unit="trajectory", seed=1).apply(data, command=COMMAND)
    kept = labelled["has_action"].squeeze(-1)
    for key in ("observation", ("next", "observation")):
        assert labelled[key][~kept][:, COMMAND].isnan().all()
        same_bits(labelled[key][kept], data[key][kept])
        same_bits(labelled[key][:, 2:].contiguous(), data[key][:, 2:].contiguous())
    validate(labelled, command=COMMAND)
    # with single labels no trajectory is complete, and no command may be seen: their differences are sums of actions
    labelled, _ = LabelBudget(fraction=0.5, unit="transition").apply(data, command=COMMAND)
    assert labelled["observation"][:, COMMAND].isnan().all()
    assert labelled["next", "observation"][:, COMMAND].isnan().all()
    again, report = LabelBudget(count=1).apply(LabelBudget(count=2).apply(data, command=COMMAND)[0], command=COMMAND)
    assert report.selected_units == 1 and again["has_action"].any()  # data that lack labels are spent as well
    full, _ = LabelBudget(fraction=1.0).apply(data, command=COMMAND)
    assert (full == data).all()
    assert (hide_commands(data, COMMAND) == data).all()


@pytest.mark.parametrize("told", [True, False])
def test_a_smaller_budget_takes_the_commands_of_labels_away_too(told):
    whole, report = LabelBudget(fraction=1.0).apply(demonstrations(), command=COMMAND, tell_commands=True)
    assert not whole["label_command"].isnan().any() and report.commands_told == 0  # the observation holds them
    less, report = LabelBudget(count=3, unit="transition").apply(whole, command=COMMAND, tell_commands=told)
    assert ("label_command" in less.keys()) == told
    assert report.commands_told == (3 if told else 0)
    if told:
        assert torch.equal(~less["label_command"].isnan().any(-1), less["has_action"].squeeze(-1))
        again, _ = LabelBudget(fraction=1.0).apply(less, command=COMMAND, tell_commands=True)
        same_bits(again, less)  # what is blank in the observation by now is still told


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("amount", [1, 0.4])
def test_nothing_outside_the_budget_leaks(unit, amount):
    """Poison all actions and commands outside the budget: everything downstream is the same, bit for bit."""
    clean = demonstrations()
    budget = budget_of(amount, unit=unit, seed=2)
    kept = budget.apply(clean)[0]["has_action"].squeeze(-1)
    poisoned = clean.clone()
    poisoned["action"][~kept] = 1e6
    complete = torch.tensor([bool(kept[clean["episode"] == e].all()) for e in clean["episode"]])
    for key in ("observation", ("next", "observation")):
        poisoned.get(key)[~complete, COMMAND] = -1e6
    results = []
    for data in (clean, poisoned):
        labelled, report = budget.apply(data, command=COMMAND)
        labelled = select_state(labelled, (2, 3))
        state = Normalizer.fit(labelled["state"])
        action = Normalizer.fit(labelled["action"], mode="standard", mask=labelled["has_action"])
        buffer = make_window_buffer(labelled, 16, 32, labelled_share=0.5)
        torch.manual_seed(0)
        batches = [buffer.sample() for _ in range(3)]
        results.append((report, labelled, state.state_dict(), action.state_dict(), *batches))
    left, right = results
    assert left[0] == right[0]
    for one, other in zip(left[1:], right[1:], strict=True):
        same_bits(one, other)


def test_given_episodes_are_labelled_and_no_others():
    data = flatten_trajectories([torch.rand(6, 4)] * 5, [torch.rand(5, 2)] * 5)
    data["episode"] = data["episode"] * 10  # numbers, not positions
    labelled, report = LabelBudget(episodes=[40, 10]).apply(data)
    shown = labelled["has_action"].squeeze(-1)
    assert labelled["episode"][shown].unique().tolist() == [10, 40] and int(shown.sum()) == 10
    assert report.selected_units == 2 and report.trajectories_touched == 2
    with pytest.raises(ValueError, match=r"no episodes \[3\] to label; the data have 0 to 40"):
        LabelBudget(episodes=[10, 3]).apply(data)


def partly(lengths, shown, seed=0):
    data = demonstrations(lengths, seed)
    kept = torch.isin(data["episode"], torch.tensor(shown)).unsqueeze(-1)
    return data.set("has_action", kept).set("action", torch.where(kept, data["action"], math.nan))


@pytest.mark.parametrize("unit", UNITS)
def test_a_smaller_budget_of_the_same_draw_is_what_it_would_have_been(unit):
    data = demonstrations((20, 33, 16, 40, 25, 18))
    some, _ = LabelBudget(count=4, unit=unit, seed=3).apply(data)
    again, report = LabelBudget(count=2, unit=unit, seed=3).apply(some)
    direct, plain = LabelBudget(count=2, unit=unit, seed=3).apply(data)
    if unit != "window":  # overlapping windows share labels: others can have some, too
        assert report.selected_units == 2 and report.available_units == 4
        assert torch.equal(again["has_action"], direct["has_action"])
        same_bits(again["action"], direct["action"])
    assert report.available_transitions == int(some["has_action"].sum()) and plain.available_transitions == 152
    assert (some["has_action"] | ~again["has_action"]).all()
    validate(again)


def test_missing_labels_are_the_budget():
    data = partly((20, 33, 16, 40), shown=(1, 3))
    everything, report = LabelBudget(fraction=1.0).apply(data)
    assert torch.equal(everything["has_action"], data["has_action"])
    assert str(report).endswith("2 of 4 trajectories touched; the data came with 73 labels, on 2 trajectories")
    assert {int(LabelBudget(count=1, seed=s).apply(data)[0]["has_action"].sum()) for s in range(8)} == {33, 40}
    assert LabelBudget(fraction=0.25).apply(data)[1].selected_units == 1  # of all four
    assert LabelBudget(count=5, unit="transition").apply(data)[1].labelled_transitions == 5
    windows, report = LabelBudget(fraction=1.0, unit="window").apply(data)
    assert report.available_units == report.selected_units == 18 + 25 and report.labelled_transitions == 31 + 38
    episodes, _ = LabelBudget(episodes=[3]).apply(data)
    assert int(episodes["has_action"].sum()) == 40
    holes = data.clone()
    holes["has_action"][25], holes["action"][25] = False, math.nan
    assert LabelBudget(count=2).apply(holes)[1].labelled_transitions == 72


PARTLY = partly((20, 33, 16, 40), shown=(1, 3))


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (demonstrations(), {"count": 9}, "9 labelled trajectories asked for, there are 4"),
        (demonstrations((12, 3)), {"count": 1, "unit": "window"}, "longest: 12"),
        (PARTLY, {"count": 3}, "3 labelled trajectories asked for, only 2 of 4 have a label"),
        (PARTLY, {"fraction": 0.75}, "3 labelled trajectories asked for, only 2 of 4 have a label"),
        (
            PARTLY,
            {"episodes": [2, 3]},
            r"episodes \[2\] are to be labelled, but the data hold no actions for them; .* file names: added",
        ),
        (partly((20, 33), shown=()), {"count": 1}, "none of the 53 steps has an action: there are no labels to select"),
        (PARTLY.exclude("has_action", "action"), {"count": 1}, "no entry 'action', and thus no labels"),
    ],
)
def test_a_budget_that_cannot_be_spent_is_named(data, options, message):
    with pytest.raises(ValueError, match=message):
        LabelBudget(**options).apply(data)


def test_labels_that_are_no_numbers_are_named():
    data = demonstrations()
    data["action"][7] = math.nan
    with pytest.raises(ValueError, match="a labelled 'action' is not finite in 1 steps, first at step 7"):
        LabelBudget(count=1).apply(data)
    found, report = LabelBudget(fraction=1.0).apply(data.exclude("has_action"))  # without the column NaN means no label
    assert report.available_transitions == 108 and not found["has_action"][7]


LONGER = [20 + 3 * index for index in range(10)]


def numbered(labelled=2, seed=0):
    data = counted_windows.demonstrations(LONGER)
    return data if labelled is None else LabelBudget(count=labelled, seed=seed).apply(data)[0]


def kept_of(data, share):
    return set(subsample_trajectories(data, share)["episode"].tolist())


@pytest.mark.parametrize("seed", range(4))
def test_whole_trajectories_are_kept_in_their_order_with_all_labels(seed):
    data = numbered(3, seed)
    before = data.clone()
    kept = subsample_trajectories(data, 0.5)
    episodes = kept["episode"].unique_consecutive()
    assert len(episodes) == 5 and (episodes.diff() > 0).all()
    assert [int((kept["episode"] == episode).sum()) for episode in episodes] == [LONGER[e] for e in episodes]
    assert int(kept["has_action"].sum()) == int(data["has_action"].sum())
    assert (kept["observation"][:, 0] == kept["episode"]).all()
    same_bits(data, before)


def test_a_smaller_share_is_part_of_every_larger_one():
    data = numbered(1)
    shares = [kept_of(data, share / 10) for share in range(1, 11)]
    assert [len(share) for share in shares] == list(range(1, 11))
    assert all(small < large for small, large in zip(shares, shares[1:], strict=False))
    assert subsample_trajectories(data, 0.97) is data  # 9.7 of 10
    data["has_action"] = torch.zeros_like(data["has_action"])
    assert len(kept_of(data, 0.1)) == 1


@pytest.mark.parametrize(
    ("labelled", "fraction", "message"),
    [
        *((1, fraction, rf"must be in \(0, 1\], got {fraction}") for fraction in (0.0, 1.5, -0.1, math.nan)),
        (3, 0.2, "share of 0.2 of the trajectories keeps 2 of 10, but 3 have labels"),
        (None, 0.04, "share of 0.04 of the trajectories keeps 0 of 10"),
    ],
)
def test_an_impossible_share_is_named(labelled, fraction, message):
    with pytest.raises(ValueError, match=message):
        subsample_trajectories(numbered(labelled), fraction)
