# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that every file of the package has a test file at the same place, or is listed here with another."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE, TESTS = ROOT / "torchrl_koap", ROOT / "tests"
FILES = sorted(str(file.relative_to(PACKAGE)) for file in PACKAGE.rglob("*.py") if file.name != "__init__.py")

# file of the package: what tests it from above
COVERED_BY = {
    "data/roles.py": "data/test_demonstrations.py",
    "data/formats/pieces.py": "data/formats/test_columns.py",
    "commands/options.py": "commands/test_cli.py",
    "commands/doctor.py": "commands/test_cli.py",
    "commands/run_commands.py": "commands/test_eval.py",
    "commands/subcommands.py": "commands/test_cli.py",
    "data/formats/parquet.py": "data/formats/test_lerobot.py",
    "envs/experts/push_planning.py": "envs/experts/test_aligning.py",
    "envs/gymnasium_episode.py": "envs/test_gymnasium_batch.py",
    "envs/experts/recording.py": "envs/experts/test_demonstrations.py",
    "envs/experts/sorting_decision.py": "envs/experts/test_sorting.py",
    "envs/mujoco/kinematics.py": "envs/mujoco/test_controller.py",
    "envs/mujoco/simulation.py": "envs/mujoco/test_controller.py",
    "envs/scooping/expert.py": "envs/scooping/test_env.py",
    "envs/scooping/recording.py": "envs/scooping/test_env.py",
    "envs/scooping/simulation.py": "envs/scooping/test_env.py",
    "graphics.py": "envs/mujoco/test_rendering.py",
    "evaluation/closed_loop.py": "commands/test_eval.py",
    "evaluation/config.py": "commands/test_eval.py",
    "evaluation/inspection.py": "evaluation/test_diagnosis.py",
    "evaluation/latency.py": "commands/test_eval.py",
    "evaluation/policies.py": "evaluation/test_oracle.py",
    "modules/execution/factory.py": "modules/execution/test_policy.py",
    "modules/inverse_dynamics.py": "modules/koopman/test_inverse_dynamics.py",
    "modules/planning/sampler.py": "modules/planning/test_planner.py",
    "objectives/base.py": "objectives/test_koap.py",
    "reports/html.py": "reports/test_run_report.py",
    "reports/run_facts.py": "reports/test_run_report.py",
    "reports/style.py": "reports/test_run_report.py",
    "runs/config.py": "runs/test_config_files.py",
    "tasks/aligning.py": "tasks/test_registry.py",
    "tasks/avoiding.py": "tasks/test_registry.py",
    "tasks/scooping.py": "tasks/test_registry.py",
    "tasks/sorting.py": "tasks/test_registry.py",
    "tasks/stacking.py": "tasks/test_registry.py",
    "tasks/modes.py": "tasks/test_task.py",
    "tasks/scene.py": "reports/test_scenes.py",
    "training/checkpoints.py": "training/test_loop.py",
    "training/method.py": "training/test_methods.py",
    "vision/backbones.py": "vision/test_encoder.py",
}


def mirror_of(file: str) -> Path:
    path = Path(file)
    return TESTS / path.parent / f"test_{path.name}"


def test_every_file_has_its_test_or_stands_in_the_list():
    for file in FILES:
        assert mirror_of(file).exists() != (file in COVERED_BY), f"{file}: one of the two, not both"


def test_the_list_names_files_that_exist():
    for file, cover in COVERED_BY.items():
        assert (PACKAGE / file).exists() and (TESTS / cover).exists(), file
