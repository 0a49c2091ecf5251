# This source code is licensed under the MIT license found in the LICENSE file.
"""The arm of capsules that Scooping's camera sees, beside the Panda's detailed meshes: how alike are their outlines?

    python benchmarks/scooping_silhouette.py --folder runs/scooping

The meshes are those that gymnasium-robotics brings along (``kitchen_franka``). Postures are the robot's recorded joint
targets. The arm alone is drawn, against black, and its outlines are compared pixel by pixel: intersection over union.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure

from torchrl_koap.data.lerobot.images import read_image_episodes
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.scooping.scene import scooping_model
from torchrl_koap.tasks.scooping import IMAGE_SIZE

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).parent / "results" / "scooping_silhouette.csv"
PICTURE = ROOT / "docs" / "pictures" / "scooping_silhouette.png"
CAMERA, SHOWN = "third_person", 384  # pixels of the frames that are shown
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE


def meshes() -> Path:
    """Folder of the Panda's detailed meshes.

    Raises:
        SystemExit: if the package that brings them is not installed.
    """
    package = importlib.util.find_spec("gymnasium_robotics")
    if package is None or package.origin is None:
        raise SystemExit(
            "the detailed meshes come with a package that is not installed: pip install gymnasium-robotics"
        )
    return Path(package.origin).parent / "envs" / "assets" / "kitchen_franka" / "franka_assets" / "meshes" / "visual"


def models(folder: Path | None = None) -> dict[str, mujoco.MjModel]:
    """The scene without pieces twice, with the arm of capsules and with that of meshes; and each arm all alone.

    Args:
        folder (Path, optional): of the meshes. Default: :func:`meshes`.
    """
    folder, made = meshes() if folder is None else folder, {}
    with tempfile.TemporaryDirectory() as scratch:
        file = f"{scratch}/scene.xml"
        mujoco.mj_saveLastXML(file, scooping_model("robot", pieces=False))
        for arm in ("capsules", "meshes"):
            for alone in (False, True):
                spec = mujoco.MjSpec.from_file(file)
                if arm == "meshes":
                    _dress(spec, folder)
                if alone:
                    _undress(spec)
                made[f"{arm} alone" if alone else arm] = spec.compile()
    return made


def _links(spec: mujoco.MjSpec) -> list:
    return [spec.body("link0") or spec.worldbody, *(spec.body(f"link{number}") for number in range(1, 8))]


def _is_arm(geom, base: bool) -> bool:
    """Whether a shape of a link is part of the arm; in the world it is the only capsule."""
    return geom.type in (_CAPSULE, mujoco.mjtGeom.mjGEOM_MESH) if base else True


def _dress(spec: mujoco.MjSpec, folder: Path) -> None:
    """Takes the capsules of every link off and puts its mesh on."""
    for number, link in enumerate(_links(spec)):
        for geom in list(link.geoms):
            if geom.type == _CAPSULE:
                spec.delete(geom)
        spec.add_mesh(name=f"mesh{number}", file=str(folder / f"link{number}.stl"))
        link.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"mesh{number}",
            rgba=(0.93, 0.93, 0.93, 1),
            contype=0,
            conaffinity=0,
            mass=0.8,
        )


def _undress(spec: mujoco.MjSpec) -> None:
    """Makes everything but the arm invisible."""
    links = _links(spec)
    for body in [spec.worldbody, *spec.bodies]:
        base = body.name == links[0].name
        arm = base or body.name in {link.name for link in links}
        for geom in body.geoms:
            if not (arm and _is_arm(geom, base)):
                geom.rgba = (0, 0, 0, 0)


def draw(model: mujoco.MjModel, postures: np.ndarray, size: int) -> list[np.ndarray]:
    """Frames of a robot that stands still.

    Args:
        model (mujoco.MjModel): the scene.
        postures (np.ndarray): joints ``[N, 7]`` (rad).
        size (int): pixels, both ways.
    """
    data, renderer = mujoco.MjData(model), Renderer(model, size, size, shadows=False)
    frames = []
    for joints in postures:
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        frames.append(renderer.render(data, CAMERA))
    renderer.close()
    return frames


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two outlines ``[H, W]``; 1 where neither shows anything."""
    union = (one | other).sum()
    return float((one & other).sum() / union) if union else 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="of benchmarks/scooping.py")
    parser.add_argument("--postures", type=int, default=200)
    options = parser.parse_args()
    targets = np.concatenate([episode.action for episode in read_image_episodes(options.folder / "robot")])
    postures = targets[np.linspace(0, len(targets) - 1, options.postures).astype(int)]
    scenes = models()
    outlines = {
        arm: [frame.any(-1) for frame in draw(scenes[f"{arm} alone"], postures, IMAGE_SIZE)]
        for arm in ("capsules", "meshes")
    }
    found = np.array([overlap(*pair) for pair in zip(*outlines.values(), strict=True)])
    covered = {arm: np.mean([outline.mean() for outline in seen]) for arm, seen in outlines.items()}
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["postures", "pixels", "overlap_mean", "overlap_least", "share_capsules", "share_meshes"])
        figures = [found.mean(), found.min(), covered["capsules"], covered["meshes"]]
        writer.writerow([len(postures), IMAGE_SIZE, *(f"{value:.3f}" for value in figures)])
    print(TABLE.read_text())
    chosen = postures[[0, len(postures) // 2 + 7, len(postures) - 20]]
    drawn = [draw(scenes[name], chosen, SHOWN) for name in ("meshes", "capsules")]
    drawn.append(draw(scenes["capsules"], chosen, IMAGE_SIZE))
    figure = Figure(figsize=(6.3, 6.5), layout="constrained")
    titles = ("detailed meshes", "capsules", f"as the policy sees it, {IMAGE_SIZE} pixels")
    for row, (axes, frames) in enumerate(zip(figure.subplots(3, 3).T, drawn, strict=True)):
        for number, (part, frame) in enumerate(zip(axes, frames, strict=True)):
            part.imshow(frame)
            part.set_axis_off()
            if not number:
                part.set_title(titles[row], fontsize=9)
    figure.savefig(PICTURE, dpi=80, metadata={"Software": None})
    print(PICTURE, PICTURE.stat().st_size)


if __name__ == "__main__":
    main()
