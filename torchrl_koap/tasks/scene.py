# This source code is licensed under the MIT license found in the LICENSE file.
"""Top view of a task in plain numbers: fixed shapes, and the bodies that a context places."""

from __future__ import annotations

from dataclasses import dataclass

Region = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Shape:
    """A fixed circle, rectangle or line (lengths in m).

    Args:
        kind (str): ``"circle"``, ``"rectangle"`` (sides along x and y) or ``"line"``.
        center (tuple of float): x, y of its centre.
        half (tuple of float): half its extent along x and y; for a circle the radius, twice; for a line the vector from
            its centre to its end.
        role (str): ``"obstacle"``, ``"clearance"``, ``"finish"``, ``"region"``, ``"platform"``, ``"wall"``, ``"zone"``
            or ``"target"``.
        color (str, optional): ``"red"``, ``"green"``, ``"blue"`` or ``"#rrggbb"``. Default: that of the role.
        label (str): text drawn beside it.

    Raises:
        ValueError: if ``kind`` is another one.
    """

    kind: str
    center: tuple[float, float]
    half: tuple[float, float]
    role: str
    color: str | None = None
    label: str = ""

    @classmethod
    def over(cls, region: Region, role: str) -> Shape:
        """Makes the rectangle that covers a region."""
        (left, right), (near, far) = region
        return cls("rectangle", ((left + right) / 2, (near + far) / 2), ((right - left) / 2, (far - near) / 2), role)

    def __post_init__(self):
        if self.kind not in ("circle", "rectangle", "line"):
            raise ValueError(f"a shape is a 'circle', 'rectangle' or 'line', got {self.kind!r}")


@dataclass(frozen=True)
class Body:
    """A body that a context places: its pose in the observation, its start regions, and its top view.

    Args:
        name (str): its name in contexts and messages; parts of the observation that begin with ``name_`` are its own.
        position (str): part of the observation that begins with its x, y (m).
        yaw (str): part of the observation with its yaw: a quaternion (w, x, y, z) or ``tan(yaw)``. Empty: the yaw is
            0.
        starts (tuple): regions in which it may start, x range and y range (m) each.
        label (str): its name in legends; bodies with the same label share an entry.
        color (str): ``"red"``, ``"green"``, ``"blue"``, ``"grey"`` or ``"#rrggbb"``.
        half (tuple of float): half its width and half its depth (m).
        front (bool): whether its far side is emphasised, to show its orientation.
        still (bool): whether it never moves.
    """

    name: str
    position: str
    yaw: str = ""
    starts: tuple[Region, ...] = ()
    label: str = ""
    color: str = "grey"
    half: tuple[float, float] = (0.03, 0.03)
    front: bool = False
    still: bool = False

    def __post_init__(self):
        object.__setattr__(self, "label", self.label or self.name)


@dataclass(frozen=True)
class Scene:
    """Fixed shapes and movable bodies of a task, where bodies start, and the area that pictures show.

    Args:
        shapes (tuple of Shape): fixed shapes in drawing order.
        bodies (tuple of Body): bodies with another start in every episode.
        shared_starts (tuple): regions that are assigned to the bodies at random, at most one body each, instead of
            ``Body.starts``; there may be more of them than bodies.
        start_yaw (tuple of float): range of a body's yaw at the start (deg).
        x (tuple of float, optional): range of x in pictures (m). None: that of the drawing.
        y (tuple of float, optional): likewise for y.
        caption (str): text that the report adds to the picture of the rollouts.
        camera (str, optional): camera of the simulator that shows the task best. None: there is no camera.

    Examples:
        >>> from torchrl_koap.tasks import Body, Scene
        >>> left, right = ((0.2, 0.3), (0.0, 0.1)), ((0.6, 0.7), (0.0, 0.1))
        >>> Scene(bodies=(Body("mug", "mug_xy", starts=(left, right)),)).starts_of(0) == (left, right)
        True
    """

    shapes: tuple[Shape, ...] = ()
    bodies: tuple[Body, ...] = ()
    shared_starts: tuple[Region, ...] = ()
    start_yaw: tuple[float, float] = (-90.0, 90.0)
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    caption: str = ""
    camera: str | None = None

    @property
    def varies(self) -> bool:
        """Whether starts of bodies vary over episodes, so that there are contexts."""
        return any(self.starts_of(index) for index in range(len(self.bodies)))

    def starts_of(self, index: int) -> tuple[Region, ...]:
        """Returns the regions that body ``index`` may start in."""
        return self.shared_starts or self.bodies[index].starts
