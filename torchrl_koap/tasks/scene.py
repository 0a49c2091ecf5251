# This source code is licensed under the MIT license found in the LICENSE file.
"""How a task looks from above, in plain numbers: what stands still, and the bodies that a context places."""

from __future__ import annotations

from dataclasses import dataclass

Region = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Shape:
    """A circle, rectangle or line that stands still (lengths in m).

    Args:
        kind (str): ``"circle"``, ``"rectangle"`` (sides along x and y) or ``"line"``.
        center (tuple of float): x, y of its centre.
        half (tuple of float): half its extent along x and y; of a circle the radius, twice; of a line the way from its
            centre to its end.
        role (str): what it is: ``"obstacle"``, ``"clearance"``, ``"finish"``, ``"region"``, ``"platform"``,
            ``"wall"``, ``"zone"`` or ``"target"``.
        color (str, optional): ``"red"``, ``"green"``, ``"blue"`` or ``"#rrggbb"``. Default: that of the role.
        label (str): a word drawn beside it.

    Raises:
        ValueError: for another kind.
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
    """A body that a context places: what tells its pose, where it may start, and how it looks from above.

    Args:
        name (str): its name in contexts and messages.
        position (str): part of the observation that begins with its x, y (m).
        yaw (str): part of the observation that tells its yaw: a quaternion (w, x, y, z) or ``tan(yaw)``; empty where
            nothing does, its yaw is then 0.
        starts (tuple): regions, x range and y range (m) each, in any of which it may start.
        label (str): its name in legends; bodies of the same label share an entry.
        color (str): ``"red"``, ``"green"``, ``"blue"``, ``"grey"`` or ``"#rrggbb"``.
        half (tuple of float): half its width and half its depth (m).
        front (bool): its far side is emphasised, where its orientation matters.
        still (bool): it stays where it starts.
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
    """What stands in a task and where the rest of it starts, and the part of the plane that pictures show.

    Args:
        shapes (tuple of Shape): what stands still, in the order in which it is drawn.
        bodies (tuple of Body): what starts elsewhere in every episode.
        shared_starts (tuple): regions that the bodies get at random, each to one at most, instead of
            ``Body.starts``; there may be more of them than bodies.
        start_yaw (tuple of float): least and greatest yaw of a body (deg).
        x (tuple of float): least and greatest x of a picture (m); None shows what is drawn.
        y (tuple of float): likewise for y.
        caption (str): what the report adds to the picture of the rollouts.
        camera (str, optional): camera of the simulator that shows the task best; None where there is none to film with.

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
        """Whether bodies start elsewhere in every episode, so that there are contexts."""
        return any(self.starts_of(index) for index in range(len(self.bodies)))

    def starts_of(self, index: int) -> tuple[Region, ...]:
        """Regions in one of which body ``index`` starts."""
        return self.shared_starts or self.bodies[index].starts
