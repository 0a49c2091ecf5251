# This source code is licensed under the MIT license found in the LICENSE file.
"""What a run trains where nothing is asked for."""

from dataclasses import replace
from pathlib import Path

import pytest

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.tasks import get_task
from torchrl_koap.training.resolved import resolve


class TestTheTasksMethod:
    @pytest.mark.parametrize(
        "task, method",
        [
            ("avoiding", "koap"),
            ("stacking", "mpc"),
            ("stacking_1", "mpc"),
            ("stacking_unobserved_joints", "command_regression"),
        ],
    )
    def test_is_trained_unless_another_is_asked_for(self, task, method):
        resolved = resolve(TrainConfig(out=Path("run"), task=task))
        assert resolved.options.method == resolved.method.name == resolved.controller["method"] == method
        assert ("columns" in resolved.controller) == (method != "koap")
        assert resolve(TrainConfig(out=Path("run"), task=task, method="linear")).options.method == "linear"


class TestTheTasksPreset:
    def preset(self, **options):
        return resolve(TrainConfig(out=Path("run"), **options)).controller["preset"]

    def test_is_that_of_its_own_method_unless_another_is_asked_for(self):
        assert self.preset(task="po_sorting") == "semi_supervised"
        assert self.preset(task="po_sorting", preset="default") == "default"
        assert self.preset(task="sorting") == "default"

    @pytest.mark.parametrize(
        ("method", "own"), [("koap_untrained", "default"), ("koap_paper", "paper"), ("pca", "default")]
    )
    def test_is_not_that_of_other_methods(self, method, own):
        assert self.preset(task="po_sorting", method=method) == own

    def test_must_be_one_of_the_methods(self):
        task = get_task("po_sorting")
        task = replace(task, name="other", defaults=replace(task.defaults, method="pca"))
        with pytest.raises(ValueError, match="'other' asks for preset 'semi_supervised', method 'pca' has"):
            resolve(TrainConfig(out=Path("run"), task="po_sorting"), task)
