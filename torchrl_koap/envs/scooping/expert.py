# This source code is licensed under the MIT license found in the LICENSE file.
"""A scripted expert for both embodiments: over the bowl, down, along its floor, nose up, out; repeats if empty.

The Panda that holds the spoon moves by inverse kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_koap.envs.scooping.simulation import ScoopingSimulations, scooping_model
from torchrl_koap.tasks.scooping import FRAME_HZ, START_HEIGHT, STARTS


@dataclass(frozen=True)
class Habits:
    """Speeds, paths and heights of an embodiment that moves the spoon."""

    speed: float  # of the spoon in the air (m/s)
    drag: float  # of the spoon in the bowl (m/s)
    headings: tuple[float, ...]  # direction of the stroke from each start position (rad)
    heading_sigma: float  # standard deviation of the heading (rad)
    wander: float  # typical deviation from the planned path (m)
    tilt: float  # typical roll of the spoon (rad)
    above: float  # height of the spoon over the bowl (m)


HABITS = {
    "robot": Habits(0.16, 0.07, (-0.8, 0.0, 0.8), 0.12, 0.004, 0.02, 0.13),
    "hand": Habits(0.26, 0.08, (-1.1, 0.35, 1.1), 0.2, 0.005, 0.04, 0.16),
}
_STROKE = (-0.025, 0.034)  # begin and end of the stroke in the bowl, along the heading (m)
_NOSE_DOWN, _NOSE_UP = 0.22, -0.5  # rad
_FLOOR = -0.01  # commanded height in the bowl (m): below the table, so that the spoon scrapes along it

REST = np.array([0.0, 0.1, 0.0, -2.3, 0.0, 2.4, 0.785])  # rad; joints are pulled towards this pose
_DAMPING, _PULL = 1e-4, 0.05


def rotation_of(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Computes the axes of a spoon ``[3, 3]``, in columns.

    It is turned by yaw, by pitch about the turned y (positive: nose down), then by roll about the turned x (rad).
    """
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


class SpoonKinematics:
    """Inverse kinematics of the spoon; prefers joints near the present ones and a rest pose."""

    def __init__(self):
        self._model = scooping_model("robot", pieces=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site("spoon").id
        self.low, self.high = self._model.jnt_range.T + np.array([[0.02], [-0.02]])
        self._jacobian = np.zeros((6, 7))

    def solve(
        self, position: np.ndarray, rotation: np.ndarray, joints: np.ndarray = REST, *, iterations: int
    ) -> np.ndarray:
        """Finds joints ``[7]`` (rad) for a position ``[3]`` (m) and a rotation ``[3, 3]`` of the spoon.

        Starts at ``joints`` and takes at most ``iterations`` steps.
        """
        for _ in range(iterations):
            self._data.qpos[:] = joints
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_comPos(self._model, self._data)
            now = self._data.site_xmat[self._site].reshape(3, 3)
            turn = 0.5 * np.cross(now.T, rotation.T).sum(0)
            error = np.concatenate([position - self._data.site_xpos[self._site], turn])
            mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._site)
            weighted = self._jacobian.T @ np.linalg.inv(self._jacobian @ self._jacobian.T + _DAMPING * np.eye(6))
            rest = _PULL * (REST - joints)
            change = weighted @ error + rest - weighted @ (self._jacobian @ rest)
            joints = np.clip(joints + np.clip(change, -0.2, 0.2), self.low, self.high)
            if np.abs(error).max() < 2e-4 and np.abs(change).max() < 2e-3:
                break
        return joints


class ScoopingExpert:
    """Expert of one episode; it acts in simulation ``row`` of a batch and reads pieces and spoon there."""

    embodiments = tuple(HABITS)

    def __init__(self, sims: ScoopingSimulations, row: int, start: int, seed):
        self.sims, self.row = sims, row
        self.habits = HABITS[sims.embodiment]
        self._generator = np.random.default_rng(seed)
        self._arm = SpoonKinematics() if sims.embodiment == "robot" else None
        self._start, self.attempts, self._wander = start, 0, np.zeros(3)
        self._bowl = sims.bowl_positions[row]
        self._pose = np.array([*sims.spoon_position[row], 0.0, 0.0, 0.0])  # x, y, z, yaw, pitch, roll
        self._way = self._frames()
        self._tilt = self.habits.tilt * self._generator.standard_normal()
        self._hurry = math.exp(0.12 * self._generator.standard_normal())
        self.finished = False

    def _plan(self) -> list[tuple[np.ndarray, float]]:
        """Returns the way points of one attempt, each with the speed towards it (m/s)."""
        draw, habits = self._generator, self.habits
        heading = habits.headings[self._start] + habits.heading_sigma * draw.standard_normal()
        ahead = np.array([math.cos(heading), math.sin(heading)])
        aside = np.array([-ahead[1], ahead[0]])
        pieces = self.sims.piece_positions[self.row]
        places = pieces[pieces[:, 2] < 0.05, :2] - self._bowl
        local = np.stack([places @ ahead, places @ aside], 1)
        offsets = np.linspace(-0.02, 0.02, 9)
        ahead_of = local[local[:, 0] > _STROKE[0] + 0.01]
        caught = [(np.abs(ahead_of[:, 1] - offset) < 0.015).sum() for offset in offsets]
        offset = offsets[int(np.argmax(np.array(caught) + 0.5 * draw.random(len(offsets))))]

        def at(along, height, pitch):
            x, y = self._bowl + along * ahead + offset * aside
            return np.array([x, y, height, heading, pitch, self._tilt])

        reach = _STROKE[1] - 0.3 * abs(offset) + 0.003 * draw.standard_normal()
        above = habits.above + 0.008 * draw.standard_normal()
        leave = self._bowl + 0.5 * (np.array(list(STARTS.values())[self._start]) - self._bowl)
        self.attempts += 1
        return [
            (at(_STROKE[0], above, _NOSE_DOWN), habits.speed),
            (at(_STROKE[0], _FLOOR, _NOSE_DOWN), 0.8 * habits.speed),
            (at(reach, _FLOOR, 0.6 * _NOSE_DOWN), habits.drag),
            (at(reach - 0.004, 0.02, _NOSE_UP), habits.drag),
            (at(0.2 * reach, 0.14, _NOSE_UP), 0.5 * habits.speed),
            (np.array([*leave, START_HEIGHT, 0.7 * heading, _NOSE_UP, self._tilt]), habits.speed),
        ]

    def _frames(self) -> Iterator[bool]:
        """Moves the spoon's pose along the way points of all attempts, by a frame per iteration."""
        while not self.attempts or (self.attempts < 4 and not self.sims.success[self.row]):
            way = self._plan()
            for end, speed in way:
                if end is way[-1][0] and self.attempts < 4 and not self.sims.pieces_on_spoon(self.row):
                    break  # the spoon is empty: next attempt
                begin = self._pose
                length = np.linalg.norm(end[:3] - begin[:3]) + 0.06 * np.abs(end[3:] - begin[3:]).max()
                steps = max(round(1.5 * length / (speed * self._hurry) * FRAME_HZ), 2)
                for frame in range(1, steps + 1):
                    share = frame / steps
                    self._pose = begin + (end - begin) * share**3 * (10 - 15 * share + 6 * share**2)
                    yield True

    def target(self) -> np.ndarray:
        """Returns targets of the next frame ``[nu]``: joints (rad), or position (m) and angles (rad) of the hand."""
        self.finished = not next(self._way, False)
        self._wander = 0.85 * self._wander + 0.53 * self.habits.wander * self._generator.standard_normal(3)
        pose = self._pose.copy()
        free = np.clip((pose[2] - 0.03) / 0.1, 0, 1)  # small deviations in the bowl
        pose[:3] += np.array([0.3 + 0.7 * free, 0.3 + 0.7 * free, free]) * self._wander
        if self._arm is None:
            return pose
        return self._arm.solve(pose[:3], rotation_of(*pose[3:]), self.sims.commands[self.row], iterations=12)


def start_episodes(sims: ScoopingSimulations, rows: np.ndarray, contexts: np.ndarray, arm: SpoonKinematics) -> None:
    """Starts episodes in contexts ``[len(rows), bodies, 3]``.

    The first row of a context holds the position of the spoon, x, y (m), and the layout of the pieces (rad); a second
    row, if there is one, the position of the bowl.
    """
    positions = [np.array([x, y, START_HEIGHT]) for x, y in contexts[:, 0, :2]]
    if sims.embodiment == "hand":
        joints = [np.array([*position, 0.0, 0.0, 0.0]) for position in positions]
    else:
        joints = [arm.solve(position, np.eye(3), iterations=80) for position in positions]
    sims.reset(rows, np.stack(joints), contexts[:, 0, 2], contexts[:, 1, :2] if contexts.shape[1] > 1 else None)
