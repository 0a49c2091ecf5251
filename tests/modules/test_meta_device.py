# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks built without storage, under ``torch.device("meta")``, and then loaded are those that were saved."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import (
    PRESETS,
    DiffusionPolicy,
    LinearInverseDynamics,
    MLPDenoiser,
    NonlinearInverseDynamics,
    Normalizer,
    QuantizedInverseDynamics,
    StatePlanner,
    SupervisedInverseDynamics,
    TemporalUnet,
    VariationalInverseDynamics,
    make_koopman_inverse_dynamics,
)

PLANNERS = {
    "unet": lambda: StatePlanner(TemporalUnet(2, 4, channels=(8,)), state_dim=2),
    "mlp": lambda: StatePlanner(MLPDenoiser(2, 4, horizon=14), state_dim=2),
    "policy": lambda: DiffusionPolicy(TemporalUnet(2, 4, channels=(8,)), state_dim=2, action_dim=2),
    "linear": lambda: LinearInverseDynamics(2, 2),
}
CONTROLLERS = {
    **{preset: partial(make_koopman_inverse_dynamics, preset=preset) for preset in PRESETS},
    "supervised": SupervisedInverseDynamics,
    "variational": VariationalInverseDynamics,
    "quantized": QuantizedInverseDynamics,
    "nonlinear": NonlinearInverseDynamics,
}


def make(name, fitted):
    if name in PLANNERS:
        return PLANNERS[name]().eval()
    normalizer = (lambda: Normalizer.fit(torch.randn(9, 2))) if fitted else (lambda: Normalizer(2))
    return CONTROLLERS[name](2, 2, state_normalizer=normalizer(), action_normalizer=normalizer()).eval()


@pytest.mark.parametrize("assign", [True, False])
@pytest.mark.parametrize("name", [*PLANNERS, *CONTROLLERS])
def test_built_on_meta_and_loaded_equals_what_was_saved(name, assign):
    torch.manual_seed(0)
    saved = make(name, fitted=True)
    with torch.device("meta"):
        model = make(name, fitted=False)
    model = model if assign else model.to_empty(device="cpu")
    model.load_state_dict(saved.state_dict(), assign=assign)
    assert not [key for key, value in (*model.named_parameters(), *model.named_buffers()) if value.is_meta]
    data = {"history": torch.randn(3, 2, 2), "noise": torch.randn(3, 14, 2), "state": torch.randn(3, 20, 2)}
    with torch.no_grad():
        one, other = (network(TensorDict(data, [3])) for network in (saved, model))
    assert one[saved.out_keys[-1]].isfinite().all()
    assert torch.equal(one[saved.out_keys[-1]], other[saved.out_keys[-1]])
