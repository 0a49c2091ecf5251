# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the inverse dynamics model: inference, normalisers, keys, fitting, saving, composition."""

import inverse_dynamics_test_base as base
import pytest
import torch
from inverse_dynamics_test_base import InverseDynamicsTestBase
from tensordict import TensorDict

from torchrl_koap.modules import (
    FourierKernel,
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LatentActionMLP,
    LinearActionDecoder,
    Normalizer,
    make_koopman_inverse_dynamics,
    ridge,
)
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting
from torchrl_koap.modules.ridge import INPUT_NOISE

STATE_NORMALIZER = {"offset": torch.tensor([1.0, -2.0, 0.5]), "scale": torch.tensor([2.0, 0.1, 5.0])}
ACTION_NORMALIZER = {"offset": torch.tensor([0.3, -0.1]), "scale": torch.tensor([0.01, 3.0])}


def make_model(*, normalizers=True, seed=0, parts=None, **options):
    torch.manual_seed(seed)
    made = {
        "latent_action": LatentActionMLP(3, 4, hidden_dims=(8,), look_ahead=3, relative=True),
        "action_decoder": LinearActionDecoder(4, 2),
        "lifting": KoopmanLifting(3, 4, hidden_dims=(8,)),
        "operator": KoopmanOperator(4),
    } | (parts or {})
    if normalizers:
        options = {
            "state_normalizer": Normalizer(3, **STATE_NORMALIZER),
            "action_normalizer": Normalizer(2, **ACTION_NORMALIZER),
        } | options
    return KoopmanInverseDynamics(**made, **options)


def windows(*batch, num_frames=9):
    generator = torch.Generator().manual_seed(1)
    return torch.randn(*batch, num_frames, 3, generator=generator).cumsum(-2)


class TestKoopmanInverseDynamics(InverseDynamicsTestBase):
    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        network = LatentActionMLP(3, 4, hidden_dims=(8,), num_past=2, look_ahead=(2, 3), relative=True)
        return make_model(
            normalizers=False, parts={"latent_action": network}, seed=seed, **base.normalizers(), **options
        )


def test_parts_with_other_keys_in_a_model_with_other_keys():
    state, model = windows(4), make_model()
    parts = {
        "latent_action": LatentActionMLP(3, 4, hidden_dims=(8,), look_ahead=3, relative=True, in_key="x", out_key="u"),
        "action_decoder": LinearActionDecoder(4, 2, in_key="u", out_key="v"),
    }
    other = make_model(parts=parts)
    other.set_keys(state=("agent", "window"), action=("agent", "command"))
    other.load_state_dict(model.state_dict())
    td = other(TensorDict({"agent": {"window": state}}, [4]))
    torch.testing.assert_close(td["agent", "command"], model(state=state)[-1])
    assert set(td.keys()) == {"agent", "u"} and other.out_keys == ["u", ("agent", "command")]
    data = TensorDict({"agent": {"window": state, "command": torch.randn(4, 9, 2)}}, [4])
    assert other.fit_labels(data, torch.ones(4, 9, dtype=torch.bool))["labels_used"] == 4 * 5


# fitting


def test_parts_are_fitted_to_normalised_states(monkeypatch):
    model, state, seen = make_model(), windows(4), []
    for part in (model.lifting, model.latent_action):
        for name in ("prepare", "finish"):
            monkeypatch.setattr(part, name, seen.append)
    model.prepare(state)
    model.finish(state)
    assert len(seen) == 4 and all(torch.equal(each, model.normalize_state(state)) for each in seen)


def labelled(*batch, share=0.5):
    generator = torch.Generator().manual_seed(3)
    mask = torch.rand(*batch, 9, generator=generator) < share
    action = torch.randn(*batch, 9, 2, generator=generator)
    action = torch.where(mask.unsqueeze(-1), action, torch.nan)
    return TensorDict({"state": windows(*batch), "action": action}, batch), mask


def test_decoder_is_fitted_on_the_labelled_frames_that_count():
    model = make_model()
    data, mask = labelled(30)
    result = model.fit_labels(data.set("episode", torch.arange(30) // 3), mask)
    rows = [(i, t) for i in range(30) for t in range(1, 6) if mask[i, t]]
    assert result["labels_used"] == len(rows)
    model.eval()
    latent = torch.stack([model.infer(data["state"])[i, t] for i, t in rows])
    target = torch.stack([model.normalize_action(data["action"][i, t]) for i, t in rows])
    number = torch.tensor([i // 3 for i, _ in rows])
    expected = ridge(latent, target, groups=number, input_noise=INPUT_NOISE)
    assert result["penalty"] == expected.penalty
    assert result["held_out_error"] == pytest.approx(expected.error, rel=1e-4)
    decoder = model.action_decoder.linear
    torch.testing.assert_close(decoder.weight, expected.weight.float(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(decoder.bias, expected.bias.float(), rtol=1e-3, atol=1e-4)


def test_fitting_takes_any_batch_and_leaves_the_mode_alone():
    flat, nested = make_model(), make_model()
    data, mask = labelled(4, 6)
    data["episode"] = (torch.arange(24) // 6).reshape(4, 6)
    flat.fit_labels(data.reshape(-1), mask.reshape(24, 9, 1))  # a mask may have a trailing 1
    nested.fit_labels(data, mask)
    windowed = make_model()
    every = dict(data.items()) | {"episode": data["episode"].unsqueeze(-1).expand(4, 6, 9)}
    windowed.fit_labels(TensorDict(every, [4, 6, 9]), mask)
    for name, value in flat.state_dict().items():
        assert torch.equal(value, nested.state_dict()[name]) and torch.equal(value, windowed.state_dict()[name])
    assert nested.training and nested.latent_action.training
    nested.eval().fit_labels(data, mask)
    assert not nested.latent_action.training


@pytest.mark.parametrize("kept", ["sharp", "smooth"])
def test_labels_choose_the_kernel_of_their_function_and_its_decoder(kept):
    """Actions are those of a network with one of the kernels, so only this one decodes held-out trajectories."""
    kernels = {"sharp": FourierKernel(10.0, 1.0, 0.5), "smooth": FourierKernel(10.0, 1.0, 8.0)}

    def make(seed):
        torch.manual_seed(seed)
        return make_koopman_inverse_dynamics(2, 2, num_features=256, num_past=0, look_ahead=2, kernels=kernels)

    truth, model = make(1), make(2)
    truth.latent_action.choose(kept)
    states = torch.randn(60, 12, 2, generator=torch.Generator().manual_seed(0)).cumsum(-2) / 4
    data = TensorDict({"state": states}, [60])
    data["action"], data["episode"] = truth(data.clone())["action"].detach(), torch.arange(60) // 6
    fit = model.fit_labels(data, torch.ones(60, 12, dtype=torch.bool))
    assert fit["block"] == kept
    alone = make_koopman_inverse_dynamics(2, 2, num_features=256, num_past=0, look_ahead=2, kernels={"": kernels[kept]})
    alone.latent_action.load_state_dict(model.latent_action.state_dict(), strict=False)
    alone.fit_labels(data, torch.ones(60, 12, dtype=torch.bool))
    with pytest.raises(ValueError, match="no labelled frame"):
        model.fit_labels(data, torch.zeros(60, 12, dtype=torch.bool))  # kernel and decoder stay
    torch.testing.assert_close(model(data.clone())["action"], alone(data.clone())["action"])


@pytest.mark.parametrize(("trajectories", "fitted"), [(2, ["sharp"]), (3, ["sharp", "smooth"])])
def test_fewer_than_three_labelled_trajectories_fit_only_the_first_kernel(trajectories, fitted, monkeypatch):
    kernels = {"sharp": FourierKernel(), "smooth": FourierKernel(0.3, 3.0, 4.0)}
    model = make_koopman_inverse_dynamics(3, 2, num_past=0, look_ahead=2, kernels=kernels, penalty=0.3)
    compared = []

    def last(errors):
        compared.extend(errors)
        return compared[-1]

    monkeypatch.setattr(model.latent_action, "best_block", last)
    data, mask = labelled(6)
    fit = model.fit_labels(data.set("episode", torch.arange(6) % trajectories), mask)
    assert fit["block"] == fitted[-1] and compared == fitted
    assert (fit["penalty"] == 0.3) == (trajectories == 2)


def test_selected_entries_are_written_under_their_names():
    model, data = make_model(), labelled(4)[0].select("state")
    whole = model(data.clone())
    for name in ("latent_action", "action"):
        chosen = make_model().select_out_keys(name)
        written = chosen(data.clone())
        assert torch.equal(written[name], whole[name]) and chosen.out_key == "action"
        assert set(written.keys()) == {"state", name}
    swapped = make_model().select_out_keys("action", "latent_action")(data.clone())
    assert torch.equal(swapped["latent_action"], whole["latent_action"])


def test_bad_fits_are_explained():
    model = make_model()
    data, mask = labelled(4)
    with pytest.raises(ValueError, match=r"no labelled frame lies in frames 1\.\.5 of any window"):
        model.fit_labels(data, mask & (torch.arange(9) > 5))
    with pytest.raises(ValueError, match=r"mask must be bool \[4, 9, 1\] or \[4, 9\], got torch.bool \[4, 8\]"):
        model.fit_labels(data, mask[:, 1:])
    with pytest.raises(ValueError, match=r"got torch.float32 \[4, 9\]; cast it with .bool\(\)"):
        model.fit_labels(data, mask.float())
    with pytest.raises(ValueError, match="got None: hand in 'has_action'"):
        model.fit_labels(data, None)
    with pytest.raises(KeyError, match=r"reads 'action'; there are \['state'\]; rename with set_keys\(action="):
        model.fit_labels(data.select("state"), mask)
    with pytest.raises(ValueError, match=r"'action' must have the batch and frames \[4, 9\] .*, got \[4, 8, 2\]"):
        model.fit_labels(data.clone().set("action", data["action"][:, 1:]), mask)
    with pytest.raises(ValueError, match=r"weights are \[2, \d+\] \[action, latent\], those of the labels \[1, "):
        make_model(normalizers=False).fit_labels(data.clone().set("action", data["action"][..., :1]), mask)
    with pytest.raises(ValueError, match="a window of 4 frames is too short"):
        model.fit_labels(data[:, :4] if data.batch_dims > 1 else data.apply(lambda x: x[:, :4]), mask[:, :4])


def one_axis_still(num: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Windows that move along the first axis only, and actions by one filter, x_{t+3} - x_{t+2}, on both."""
    state = torch.randn(num, 16, 2, generator=torch.Generator().manual_seed(2)).cumsum(1) * 0.01
    state[..., 1] = 0.5 + 1e-6 * state[..., 1]
    return state, torch.cat([state[:, 3:] - state[:, 2:-1], torch.zeros(num, 3, 2)], 1)


def test_an_axis_with_too_few_labels_is_decoded_like_the_other():
    sizes = torch.tensor([0.01, 0.04])
    spread = torch.randn(500, 16, 2, generator=torch.Generator().manual_seed(3)).cumsum(1) * sizes
    answers = {}
    for axes in ((), (0, 1)):
        torch.manual_seed(0)
        model = make_koopman_inverse_dynamics(
            2,
            2,
            state_normalizer=Normalizer.fit(spread, mode="standard"),
            action_normalizer=Normalizer(2, scale=torch.full((2,), 0.01)),
        )
        model.prepare(spread)
        state, action = one_axis_still(200)
        mask = torch.ones(200, 16, dtype=torch.bool)
        model.fit_labels(TensorDict({"state": state, "action": action}, [200]), mask, axes=axes)
        frame = model.num_past
        decoded = model(TensorDict({"state": spread}, [500]))["action"][:, frame, 1]
        true = spread[:, frame + 3, 1] - spread[:, frame + 2, 1]
        answers[axes] = (decoded - true).square().mean().sqrt() / true.square().mean().sqrt()
    assert answers[()] > 0.9  # nothing was learned about the second axis
    assert answers[0, 1] < 0.4


def test_the_shared_filter_reads_raw_steps_in_the_units_of_the_actions():
    model, state, axes = (
        make_koopman_inverse_dynamics(3, 2, num_features=4, **base.normalizers()),
        torch.randn(20, 10, 3),
        [2, 0],
    )
    model.prepare(state)
    latent = model.infer(state, range(4, 5))[:, 0].double()
    basis = model._shared_filter(latent.shape[-1], axes, *model.latent_action.axis_features(axes)).basis
    steps = torch.einsum("nm,sam->nsa", latent, basis) * base.ACTION["scale"]
    read = state[:, [0, 1, 2, 3, 4, 6, 7, 8, 9]].double()
    torch.testing.assert_close(steps, read.diff(dim=1)[..., axes], rtol=1e-4, atol=1e-5)


def test_guessed_axes_are_used_only_where_held_out_labels_agree():
    state = torch.randn(300, 16, 2, generator=torch.Generator().manual_seed(3)).cumsum(1) * 0.01
    ahead = torch.cat([state[:, 3:] - state[:, 2:-1], torch.zeros(300, 3, 2)], 1)
    mask = torch.zeros(300, 16, dtype=torch.bool)
    mask[:8] = True
    for action, agrees in ((ahead, True), (ahead.flip(-1), False)):
        data, found = TensorDict({"state": state, "action": action, "episode": torch.arange(300) // 2}, [300]), {}
        for name, options in {"known": {}, "guessed": {"guessed": True}, "none": {"axes": ()}}.items():
            torch.manual_seed(0)
            model = make_koopman_inverse_dynamics(2, 2, num_features=8)
            model.prepare(state)
            model.fit_labels(data, mask, **({"axes": (0, 1)} | options))
            found[name] = model.action_decoder.linear.weight
        assert torch.equal(found["guessed"], found["known" if agrees else "none"])
        assert not torch.equal(found["known"], found["none"])


def test_axes_must_be_one_per_action_and_are_left_out_where_steps_are_not_held():
    windows = TensorDict({"state": torch.randn(8, 16, 2), "action": torch.randn(8, 16, 2)}, [8])
    mask = torch.ones(8, 16, dtype=torch.bool)
    with pytest.raises(ValueError, match="one state column per action entry"):
        make_koopman_inverse_dynamics(2, 2).fit_labels(windows, mask, axes=(0,))
    paper = make_koopman_inverse_dynamics(2, 2, preset="paper", latent_dim=8, hidden_dim=8)
    assert paper.latent_action.axis_features((0, 1)) is None
    plain = paper.fit_labels(windows, mask)
    assert paper.fit_labels(windows, mask, axes=(0, 1)) == plain


# parts, saving, types


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"latent_action": LatentActionMLP(3, 5)}, "sizes of a latent action differ: {'latent_action': 5"),
        ({"action_decoder": LinearActionDecoder(7, 2)}, "'action_decoder': 7"),
        ({"operator": KoopmanOperator(4, input_dim=9)}, "'operator input': 9"),
        ({"lifting": KoopmanLifting(3, 6)}, "latent_dim differs: lifting 6, operator 4"),
        ({"lifting": KoopmanLifting(2, 4)}, "state_dim differs: latent_action 3, lifting 2"),
    ],
)
def test_parts_that_do_not_fit_are_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        make_model(normalizers=False, parts=parts)
    with pytest.raises(TypeError, match=r"must be a LinearActionDecoder; .* got Linear"):
        make_model(parts={"action_decoder": torch.nn.Linear(4, 2)})


def test_parts_are_called_with_tensors_as_well():
    model, state = make_model(), windows(4)
    lifted, latent = model.lifting(state), model.latent_action(state)
    torch.testing.assert_close(lifted, model.lifting.encode(state))
    torch.testing.assert_close(model.operator(lifted, latent), model.operator.step(lifted, latent))
    torch.testing.assert_close(model.action_decoder(latent_action=latent), model.decode(latent))
    compact = CompactLifting(3, 4)
    torch.testing.assert_close(compact(state=state), compact.encode(state))


def test_the_inference_path_compiles():
    torch._dynamo.reset()
    model, state = make_model(), windows(4)
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    td = TensorDict({"state": state}, [4])
    torch.testing.assert_close(compiled(td.clone())["action"], model(td)["action"])
