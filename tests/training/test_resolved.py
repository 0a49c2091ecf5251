# This source code is licensed under the MIT license found in the LICENSE file.
"""What a run trains where nothing is asked for."""

from pathlib import Path

import pytest

from torchrl_koap.training.config import TrainConfig
from torchrl_koap.training.resolved import resolve


class TestTheTasksMethod:
    @pytest.mark.parametrize(
        "task, method",
        [
            ("avoiding", "koap"),
            ("stacking", "koap_mpc"),
            ("stacking_1", "koap_mpc"),
            ("stacking_unobserved_joints", "koap"),
        ],
    )
    def test_is_trained_unless_another_is_asked_for(self, task, method):
        resolved = resolve(TrainConfig(out=Path("run"), task=task))
        assert resolved.options.method == resolved.method.name == resolved.controller["method"] == method
        assert ("tracking" in resolved.controller) == (method == "koap_mpc")
        assert resolve(TrainConfig(out=Path("run"), task=task, method="linear")).options.method == "linear"

    def test_settings_of_the_first_public_code_are_its_own_method(self):
        assert resolve(TrainConfig(out=Path("run"), task="stacking", released_settings=True)).method.name == "koap"
