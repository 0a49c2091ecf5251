# This source code is licensed under the MIT license found in the LICENSE file.
"""Base class of tests for loss modules: ``class TestMyLoss(LossTestBase)`` inherits the tests.

A subclass builds its loss and a batch, and lists the defaults. Batches must hold all random values (noise, times), so
that a loss is a function of its input.
"""

import copy
import inspect
import pickle

import pytest
import torch
from tensordict import TensorDict


class LossTestBase:
    """Tests of a loss module; a subclass overrides the class attributes, ``make_loss`` and ``make_batch``."""

    default_keys: dict = {}  # name in set_keys -> default entry
    in_names: tuple = ()  # names (as in set_keys) of mandatory entries, in the order of in_keys
    out_keys: tuple = ()
    coefficients: dict = {}  # coefficient -> key of the loss that it scales
    learning_rate = 3e-3
    decrease = 0.7  # largest allowed ratio of the value after 60 steps of Adam to the first

    def make_loss(self, seed: int = 0, **options):
        """Returns the loss; equal seeds give equal losses."""
        raise NotImplementedError

    def make_batch(self, *batch: int) -> TensorDict:
        """Returns a float32 batch of that shape, always the same."""
        raise NotImplementedError

    def counted(self, batch: TensorDict, key: str, elements: torch.Tensor) -> int:
        """Returns the number of elements in the mean of a loss."""
        return elements.numel()

    def entry(self, name: str):
        return self.default_keys[name]

    def total(self, result) -> torch.Tensor:
        return sum(value.sum() for key, value in result.items() if key.startswith("loss_"))

    def assert_same(self, left, right, **tolerance) -> None:
        assert set(left.keys()) == set(right.keys())
        for key, value in left.items():
            if tolerance:
                torch.testing.assert_close(value, right[key], **tolerance)
            else:
                assert torch.equal(value, right[key]), key

    # keys

    def test_default_keys(self):
        loss = self.make_loss()
        accepted = {name: getattr(loss.tensor_keys, name) for name in loss._AcceptedKeys.__dataclass_fields__}
        assert accepted == self.default_keys
        assert list(loss.in_keys) == [self.entry(name) for name in self.in_names]
        assert list(loss.out_keys) == list(self.out_keys)

    @pytest.mark.parametrize("nested", [False, True])
    def test_keys_are_renamed_one_by_one_and_back(self, nested):
        loss, batch = self.make_loss(), self.make_batch(4)
        expected = loss(batch)
        for name, old in self.default_keys.items():
            new = ("some", "where", name) if nested else f"renamed_{name}"
            renamed = batch.clone()
            if old in renamed.keys(True):
                renamed.rename_key_(old, new)
            loss.set_keys(**{name: new})
            assert getattr(loss.tensor_keys, name) == new
            assert list(loss.in_keys) == [new if other == name else self.entry(other) for other in self.in_names]
            self.assert_same(loss(renamed), expected)
            if name in self.in_names:
                with pytest.raises(KeyError, match=name):
                    loss(batch)
            loss.set_keys(**{name: None})
            assert getattr(loss.tensor_keys, name) == old
        self.assert_same(loss(batch), expected)

    # input and output

    def test_the_input_is_not_changed(self):
        loss, batch = self.make_loss(), self.make_batch(4)
        before = batch.clone()
        loss(batch)
        assert set(batch.keys(True)) == set(before.keys(True))
        for key, value in before.items(True, True):
            torch.testing.assert_close(batch[key], value, rtol=0, atol=0, equal_nan=True)

    def test_it_returns_its_out_keys_and_they_have_gradients(self):
        loss = self.make_loss()
        result = loss(self.make_batch(4))
        assert set(result.keys()) == set(self.out_keys)
        for key in self.out_keys:
            if key.startswith("loss_"):
                assert result[key].shape == () and result[key].requires_grad and result[key] > 0, key
        self.total(result).backward()
        gradients = [p.grad for p in loss.parameters() if p.requires_grad and p.grad is not None]
        assert gradients and all(gradient.isfinite().all() for gradient in gradients)

    def test_keywords_give_what_a_tensordict_gives(self):
        loss = self.make_loss()
        batch = self.make_batch(4).select(*loss.in_keys)
        torch.manual_seed(1)
        expected = loss(batch)
        torch.manual_seed(1)
        values = loss(**{key: batch[key] for key in loss.in_keys})
        values = values if isinstance(values, tuple) else (values,)
        for key, value in zip(self.out_keys, values, strict=True):
            assert torch.equal(value, expected[key])

    def test_a_missing_entry_is_named(self):
        loss = self.make_loss()
        for name in self.in_names:
            with pytest.raises(KeyError, match=f"{name}.*there are"):
                loss(self.make_batch(4).exclude(self.entry(name)))

    def test_a_network_of_another_kind_is_refused(self):
        loss = self.make_loss()
        wanted = f"{type(loss).__name__} trains a .*, got Sequential; pass the module inside it"
        with pytest.raises(TypeError, match=wanted):
            type(loss)(torch.nn.Sequential(loss.network))
        with pytest.raises(TypeError, match="got Linear$"):
            type(loss)(torch.nn.Linear(2, 2))

    # labels

    @property
    def reads_labels(self) -> bool:
        return "has_action" in self.in_names

    def test_hidden_actions_reach_neither_value_nor_gradient(self):
        if not self.reads_labels:  # the loss reads no labels at all
            batch = self.make_batch(6)
            return self.assert_same(self.make_loss()(batch), self.make_loss()(batch.exclude("action", "has_action")))
        results = []
        for stored in (0.0, 1e30, torch.inf, torch.nan):
            loss, batch = self.make_loss(), self.make_batch(6)
            batch["action"] = torch.where(batch["has_action"], batch["action"], stored)
            found = loss(batch)
            self.total(found).backward()
            gradients = {name: value.grad for name, value in loss.named_parameters() if value.grad is not None}
            results.append({**found, **gradients})
        for result in results[1:]:
            for name, value in result.items():
                assert value.isfinite().all() and torch.equal(value, results[0][name]), name

    def test_without_labels_the_loss_of_actions_and_its_gradients_are_exactly_zero(self):
        if not self.reads_labels:
            return
        loss, batch = self.make_loss(), self.make_batch(6)
        batch["has_action"] = torch.zeros_like(batch["has_action"])
        batch["action"] = torch.full_like(batch["action"], torch.nan)
        value = loss(batch)[self.out_keys[-1]]
        assert value == 0 and value.requires_grad  # part of the graph, as distributed training needs
        value.backward()
        assert all((value.grad == 0).all() for value in loss.parameters() if value.grad is not None)

    # reductions and shapes

    def test_reductions_agree(self):
        batch = self.make_batch(5)
        elements = self.make_loss(reduction="none")(batch)
        mean, total = self.make_loss(reduction="mean")(batch), self.make_loss(reduction="sum")(batch)
        for key in self.out_keys:
            if key.startswith("loss_"):
                assert elements[key].shape[0] == 5
                torch.testing.assert_close(total[key], elements[key].sum())
                torch.testing.assert_close(mean[key], elements[key].sum() / self.counted(batch, key, elements[key]))
        self.assert_same(self.make_loss()(batch), mean)  # the default
        with pytest.raises(ValueError, match="reduction must be 'none', 'mean' or 'sum', got 'median'"):
            self.make_loss(reduction="median")

    def test_extra_and_absent_batch_dimensions(self):
        batch = self.make_batch(2, 3, 2)
        nested, flat = (self.make_loss(reduction="none")(data) for data in (batch, batch.reshape(-1)))
        single = self.make_loss(reduction="none")(batch[1, 2, 0])
        for key in self.out_keys:
            if key.startswith("loss_"):
                assert nested[key].shape[:3] == (2, 3, 2)
                torch.testing.assert_close(nested[key].flatten(0, 2), flat[key])
                torch.testing.assert_close(nested[key][1, 2, 0], single[key])

    def test_an_empty_batch_gives_zero(self):
        loss = self.make_loss(reduction="sum")
        assert self.total(loss(self.make_batch(2)[:0])) == 0

    def test_float64(self):
        batch = self.make_batch(4)
        single = self.make_loss()(batch)
        double = self.make_loss().double()(batch.apply(lambda x: x.double() if x.is_floating_point() else x))
        for key, value in double.items():
            assert value.dtype == torch.float64
            torch.testing.assert_close(value.float(), single[key], rtol=1e-3, atol=1e-5)

    def test_moving_the_loss_moves_its_network_and_copies_have_their_own(self):
        loss = self.make_loss()
        for moved in (loss.double(), copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
            assert (moved.network is loss.network) == (moved is loss)
            for name, value in (*moved.network.named_parameters(), *moved.network.named_buffers()):
                assert value.dtype == torch.float64 or not value.is_floating_point(), name
                assert value.data_ptr() == moved.network_params.flatten_keys(".")[name].data_ptr(), name

    # training

    def test_loss_decreases_on_a_fixed_batch(self):
        loss, batch = self.make_loss(), self.make_batch(16)
        optimizer = torch.optim.Adam(loss.parameters(), lr=self.learning_rate)
        values = []
        for _ in range(60):
            value = self.total(loss(batch))
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            values.append(float(value.detach()))
        assert values[-1] < self.decrease * values[0], values[::10]

    def test_coefficients_are_scheduled_in_place(self):
        loss, batch = self.make_loss(), self.make_batch(4)
        before = loss(batch)
        assert set(loss._schedulable_buffers) == set(self.coefficients)
        for name, key in self.coefficients.items():
            assert name in inspect.signature(type(loss).__init__).parameters
            buffer = getattr(loss, name)
            setattr(loss, name, 0.25)
            assert getattr(loss, name) is buffer and name in dict(loss.named_buffers())
            scaled = loss(batch)
            for other in self.out_keys:
                torch.testing.assert_close(scaled[other], before[other] * (0.25 if other == key else 1.0))
            setattr(loss, name, 1.0)
            self.assert_same(self.make_loss(**{name: 0.25})(batch), scaled)

    # saving

    def test_state_dict_round_trip(self):
        loss, other, batch = self.make_loss(), self.make_loss(seed=1), self.make_batch(4)
        expected = loss(batch)
        assert any(not torch.equal(value, expected[key]) for key, value in other(batch).items())
        other.load_state_dict(loss.state_dict())
        self.assert_same(other(batch), expected)

    # compilation

    def test_compiled_equals_eager(self):
        torch._dynamo.reset()  # TorchRL wraps all losses in one function, so they share its recompilation limit
        loss, batch = self.make_loss(), self.make_batch(4)
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        self.total(loss(batch)).backward()
        eager = {name: value.grad.clone() for name, value in loss.named_parameters() if value.grad is not None}
        loss.zero_grad()
        result = compiled(batch)
        self.assert_same(result, loss(batch), rtol=1e-5, atol=1e-6)
        self.total(result).backward()
        for name, gradient in eager.items():
            torch.testing.assert_close(loss.get_parameter(name).grad, gradient, rtol=1e-4, atol=1e-6)
        for name in self.coefficients:  # a scheduled coefficient reaches the compiled graph
            setattr(loss, name, 0.5)
        self.assert_same(compiled(batch), loss(batch), rtol=1e-5, atol=1e-6)
