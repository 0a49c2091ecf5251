# This source code is licensed under the MIT license found in the LICENSE file.
"""How a task looks from above, in plain numbers: what stands still, and the bodies that a context places.

Only sizes, places and the names of roles and colours; :mod:`torchrl_koap.reports.scenes` draws them.
"""

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

    Examples:
        >>> from torchrl_koap.tasks.scene import Shape
        >>> Shape("circle", (0.5, -0.1), (0.03, 0.03), "obstacle").half
        (0.03, 0.03)
    """

    kind: str
    center: tuple[float, float]
    half: tuple[float, float]
    role: str
    color: str | None = None
    label: str = ""

    def __post_init__(self):
        if self.kind not in ("circle", "rectangle", "line"):
            raise ValueError(f"a shape is a 'circle', 'rectangle' or 'line', got {self.kind!r}")


@dataclass(frozen=True)
class Body:
    """A body that a context places: where it may start, what tells its pose, and how it looks from above.

    Args:
        name (str): its name in contexts and messages.
        position (str): part of the observation that begins with its x, y (m).
        yaw (str): part of the observation that tells its yaw: a quaternion (w, x, y, z) or ``tan(yaw)``; empty where
            nothing does, its yaw is then 0.
        label (str): its name in legends; bodies of the same label share an entry.
        color (str): ``"red"``, ``"green"``, ``"blue"``, ``"grey"`` or ``"#rrggbb"``.
        half (tuple of float): half its width and half its depth (m).
        front (bool): its far side is emphasised, where its orientation matters.
        still (bool): it stays where it starts.

    Examples:
        >>> from torchrl_koap.tasks.scene import Body
        >>> Body("mug", position="mug_xy", color="blue").label
        'mug'
    """

    name: str
    position: str
    yaw: str = ""
    label: str = ""
    color: str = "grey"
    half: tuple[float, float] = (0.03, 0.03)
    front: bool = False
    still: bool = False

    def __post_init__(self):
        object.__setattr__(self, "label", self.label or self.name)


@dataclass(frozen=True)
class Scene:
    """What stands still in a task, and the part of the plane that pictures show.

    Args:
        shapes (tuple of Shape): in the order in which they are drawn.
        x (tuple of float): least and greatest x of a picture (m); None shows what is drawn.
        y (tuple of float): likewise for y.
        caption (str): what the report adds to the picture of the rollouts.
        camera (str, optional): camera of the simulator that shows the task best; None where there is none to film with.

    Examples:
        >>> from torchrl_koap.tasks.scene import Scene
        >>> Scene(x=(0.0, 1.0), y=(0.0, 1.0)).shapes
        ()
    """

    shapes: tuple[Shape, ...] = ()
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    caption: str = ""
    camera: str | None = None


@dataclass(frozen=True)
class StartRegions:
    """Where the bodies of a context may start.

    Args:
        regions (tuple): x range and y range (m) of every body, in their order.
        dealt (bool): the regions are dealt out to the bodies at random, each to one at most; there may be more of them.
        yaw (tuple of float): least and greatest yaw (deg).
        whose (tuple of int, optional): number of the body that each region is for, where a body has several of them, in
            any of which it may start. Default: one each, or dealt.

    Raises:
        ValueError: if ``whose`` names another number of regions, or they are dealt besides.

    Examples:
        >>> from torchrl_koap.tasks.scene import StartRegions
        >>> left, right, ahead = (((x, x + 0.1), (0.0, 0.1)) for x in (0.2, 0.6, 0.4))
        >>> starts = StartRegions((left, right, ahead), whose=(0, 0, 1))
        >>> starts.of(0) == (left, right), starts.of(1) == (ahead,)
        (True, True)
    """

    regions: tuple[Region, ...]
    dealt: bool = False
    yaw: tuple[float, float] = (-90.0, 90.0)
    whose: tuple[int, ...] | None = None

    def __post_init__(self):
        if self.whose is not None and (self.dealt or len(self.whose) != len(self.regions)):
            fault = "dealt out too" if self.dealt else f"{len(self.regions)}, not {len(self.whose)}"
            raise ValueError(f"whose says which body each region is for, but the regions are {fault}")

    def of(self, index: int) -> tuple[Region, ...]:
        """Regions in one of which body ``index`` starts."""
        if self.whose is not None:
            return tuple(region for region, body in zip(self.regions, self.whose, strict=True) if body == index)
        return self.regions if self.dealt else self.regions[index : index + 1]
