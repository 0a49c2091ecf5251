# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that a search for a newcomer's question finds a page that answers it."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
# page: words of the questions that it answers
QUESTIONS = {
    "howto/prepare_data": (
        "how many recordings actions 50 label 5 delta absolute targets LeRobot --action-kind robot command leader"
        " follower gripper width 0 or 1 rate Hz window 16 frames resample irregular missing NaN shorter pauses length"
        " two arms mobile base hand several tasks language quaternions angles wrap normalise units goals objects"
        " state speed operator another sign heading sine norm rotation vectors roll"
    ),
    "howto/choose_method": "choose method noisy clean recorded command joints",
    "howto/train_faster": "faster GPU cuda minutes loss memory good relative_plan_error",
    "howto/cameras": "camera frames embed pictures run time",
    "howto/control_loop": "signs quaternions limits stop safety speed driver delay sensor actuator slow plans ROS 2",
    "howto/find_failures": "jerk plans oscillation symptom cause remedy fails first",
    "howto/no_simulator": "action error good ridge mean",
    "limits": "fine-tuning more data pretrained another robot hosted issues help cite licence MIT D3IL",
    "reference/versions": "Docker Jetson Windows macOS PyPI TorchRL torchrl>= minor versions",
    "index": "independent authors Bi et al.",
    "howto/torchrl": (
        "reuse SliceSampler DiffusionActor DiffusionBCLoss LeRobotExperienceReplay MinariExperienceReplay CEMPlanner"
        " MPCPlannerBase VecNormV2 Trainer check_env_specs reset in parts ParallelEnv CPU torch.compile vmap CUDA"
        " graphs nested keys set_keys log-probability fine-tuning set_exploration_type noise transform stability"
        " public changelog 1.0"
    ),
}


def text_of(page: str) -> str:
    return " ".join((DOCS / f"{page}.md").read_text().lower().split())


@pytest.mark.parametrize("page", QUESTIONS)
def test_questions_of_newcomers_are_answered_on_a_page_that_their_words_find(page):
    missing = [word for word in QUESTIONS[page].split() if word.lower() not in text_of(page)]
    assert not missing, f"{page}.md does not hold {missing}"


def test_every_page_is_in_the_navigation():
    """By the tables of contents, or in a folder that is outside of it."""
    listed = set()
    for page in DOCS.rglob("*.md"):
        for body in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL):
            lines = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
            listed |= {(page.parent / line).resolve().relative_to(DOCS) for line in lines}
    pages = {page.relative_to(DOCS).with_suffix("") for page in DOCS.rglob("*.md")}
    outside = {page for page in pages if page.parts[0] in ("appendix", "generated")}
    assert pages - outside - listed == {Path("index")}
