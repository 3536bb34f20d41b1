"""Draw the robot's parts for the documentation: needs build123d and matplotlib.

python -m tools.render_parts
"""

import io
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from knode_cosserat_hardware.cad import load_dimensions
from knode_cosserat_hardware.cad.parts import make_parts, place_parts

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
ROBOT = "delrin-routed-tendon-robot"
#: colours by the beginning of a body's name
COLOURS = {
    "rod": "#e8e4da", "rib": "#f2a541", "base": "#4f7cac", "motor-plate": "#c9b18c", "spool": "#d1495b",
    "load-cell-mount": "#7a8b99", "load-cell": "#9fd0d6", "motor-bracket": "#66a182", "motor": "#4a4e57",
    "tendon": "#30343c", "leg": "#b9bec6",
}  # fmt: skip
LIGHT = np.array([-0.35, 0.45, 0.82])


def colour_of(name: str) -> np.ndarray:
    """RGB of a body."""
    key = max((key for key in COLOURS if name.startswith(key)), key=len)
    return np.array(matplotlib.colors.to_rgb(COLOURS[key]))


def meshes(bodies):
    """Triangles and colour of each body."""
    found = []
    for name, solid in bodies:
        points, triangles = solid.tessellate(0.05, 0.15)
        xyz = np.array([[p.X, p.Y, p.Z] for p in points])
        found.append((xyz[np.array(triangles)], colour_of(name)))
    return found


def camera(azimuth: float, elevation: float) -> np.ndarray:
    """Rows: right, up, towards the viewer."""
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def fill(corners, depth, index, number):
    """Draw one triangle into the depth buffer and the buffer of triangle numbers."""
    low = np.maximum(np.floor(corners[:, :2].min(0)).astype(int), 0)
    high = np.minimum(np.ceil(corners[:, :2].max(0)).astype(int) + 1, depth.shape[::-1])
    if (high <= low).any():
        return
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if abs(area) < 1e-12:
        return
    x, y = np.arange(low[0], high[0]) + 0.5, (np.arange(low[1], high[1]) + 0.5)[:, None]
    u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
    v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
    z = az + u * (bz - az) + v * (cz - az)
    block = np.s_[low[1] : high[1], low[0] : high[0]]
    seen = (u >= 0) & (v >= 0) & (u + v <= 1) & (z > depth[block])
    depth[block][seen] = z[seen]
    index[block][seen] = number


def render(bodies, view, size, scale, middle, fine=2):
    """Picture of bodies with outlines, on a transparent ground.

    Args:
        bodies: triangles and colours.
        view: rows of the camera.
        size: width and height in pixels.
        scale: pixels in a millimetre.
        middle: point in the middle of the picture.
        fine: samples of a pixel along each side.
    """
    width, height = size[0] * fine, size[1] * fine
    depth, index = np.full((height, width), -np.inf), np.full((height, width), -1)
    triangles = np.concatenate([mesh for mesh, _ in bodies])
    colours = np.concatenate([np.tile(colour, (len(mesh), 1)) for mesh, colour in bodies])
    owner = np.concatenate([np.full(len(mesh), k) for k, (mesh, _) in enumerate(bodies)])
    seen = (triangles - np.asarray(middle)) @ view.T
    screen = seen * (scale * fine) * np.array([1, -1, 1]) + np.array([width / 2, height / 2, 0])
    for number, corners in enumerate(screen):
        fill(corners, depth, index, number)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = LIGHT / np.linalg.norm(LIGHT)
    facing = (normals @ view.T) @ light
    shade = 0.62 + 0.42 * facing.clip(-0.6, 1.0)
    rgb = np.ones((height, width, 4))
    rgb[..., 3] = 0.0
    hit = index >= 0
    rgb[hit, :3] = (colours * shade[:, None]).clip(0, 1)[index[hit]]
    rgb[hit, 3] = 1.0
    outline = edges(
        depth, np.where(hit, owner[index], -1), np.where(hit[..., None], normals[index], 0.0), fine
    )
    rgb[outline, :3] = 0.35 * rgb[outline, :3] * hit[outline, None]
    rgb[outline, 3] = 1.0
    rgb[..., :3] *= rgb[..., 3:]
    small = rgb.reshape(size[1], fine, size[0], fine, 4).mean((1, 3))
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return small.clip(0, 1)


def edges(depth, owner, normals, fine):
    """True where neighbouring samples belong to other bodies, or to faces at an angle."""
    found = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        here, there = [np.s_[:-1, :], np.s_[:, :-1]][axis], [np.s_[1:, :], np.s_[:, 1:]][axis]
        finite = np.isfinite(depth[here]) & np.isfinite(depth[there])
        jump = np.zeros(finite.shape, bool)
        jump[finite] = np.abs(depth[here][finite] - depth[there][finite]) > 12 * fine
        differ = (owner[here] != owner[there]) | jump
        differ |= finite & ((normals[here] * normals[there]).sum(-1) < 0.8)
        found[here] |= differ
    return found


def save(figure, name):
    """Write a figure with 256 colours."""
    data = io.BytesIO()
    figure.savefig(data, dpi=100, facecolor="white")
    plt.close(figure)
    path = IMAGES / f"hardware-{name}.png"
    with Image.open(data) as image:
        image.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size // 1000} kB")


def draw_parts(part):
    """All parts, each in its own scale."""
    made = make_parts(part)
    captions = {
        "rib": f"rib, 4 pieces\nØ {2 * part.rib.outer_radius:g} mm",
        "spool": f"spool, 4 pieces\nØ {2 * part.spool.flange_radius:g} mm",
        "base": f"base\nØ {2 * part.base.flange_radius:g} mm, height {part.base.height:g} mm",
        "motor-plate": f"motor plate\nØ {2 * part.plate.radius:g} mm",
        "load-cell": f"load-cell beam, 4 pieces\n{part.cell.length:g} × {part.cell.width:g} × "
        f"{part.cell.thickness:g} mm",
        "load-cell-mount": f"load-cell mount, 4 pieces\n{part.mount.length:g} × {part.mount.width:g} × "
        f"{part.mount.height:g} mm",
        "motor-bracket": "motor bracket, 4 pieces\n"
        f"{part.bracket.right - part.bracket.left:g} × {part.bracket.foot_length:g} × "
        f"{part.bracket.height:g} mm",
    }
    views = {"spool": (60, -25), "motor-bracket": (-60, -22), "base": (35, 28), "rib": (30, 42)}
    figure, axes = plt.subplots(2, 4, figsize=(10, 5.6))
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (name, caption) in zip(axes.flat, captions.items(), strict=False):
        view = camera(*views.get(name, (35, 38)))
        body = meshes([(name, made[name])])
        flat = body[0][0].reshape(-1, 3) @ view.T
        low, high = flat.min(0), flat.max(0)
        scale = 212 / max(high[:2] - low[:2])
        ax.imshow(render(body, view, (245, 225), scale, view.T @ ((low + high) / 2)))
        ax.set_title(caption, fontsize=9.5, y=-0.17)
    figure.subplots_adjust(0.005, 0.07, 0.995, 0.99, 0.02, 0.16)
    save(figure, "parts")


def annotate(ax, text, to, at):
    """Label with a line from its text to a point of the picture."""
    ax.annotate(
        text,
        to,
        at,
        fontsize=10,
        va="center",
        ha="center",
        arrowprops={"arrowstyle": "-", "color": "#333333", "lw": 0.9, "shrinkB": 0},
        bbox={"boxstyle": "round,pad=0.25", "fc": "white", "ec": "#999999", "lw": 0.6},
    )


def draw_robot(part, bodies):
    """The whole robot, lying, with its base on the left."""
    mesh = meshes(bodies)
    bottom = -part.base.height - part.plate.thickness - part.leg_length
    view = camera(20, 14)
    view = np.stack([-view[1], view[0], view[2]])
    view[0] *= -1
    view[1] *= -1
    size, scale = (1000, 300), 1.24
    middle = (0, 0, (part.rod_length + bottom) / 2)
    figure = plt.figure(figsize=(10, 3.0))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.imshow(render(mesh, view, size, scale, middle))
    ax.set_axis_off()

    def at(x, y, z):
        point = view @ (np.array([x, y, z]) - middle)
        return size[0] / 2 + scale * point[0], size[1] / 2 - scale * point[1]

    annotate(ax, "rod", at(0, 0, 290), (430, 60))
    annotate(ax, "rib", at(0, 20, part.rib_heights[1]), (555, 255))
    annotate(ax, "tendon", at(*part.plate.passages[1], 420), (650, 60))
    annotate(ax, "base", at(0, 0, -50), (285, 60))
    annotate(ax, "motor plate", at(0, 70, -part.base.height), (260, 265))
    save(figure, "robot")


def draw_drive(part, bodies):
    """The drive from below, without legs and ribs. Labels are placed by hand: look at the picture."""
    mesh = meshes([(name, solid) for name, solid in bodies if not name.startswith(("leg", "rib"))])
    below = -part.base.height - part.plate.thickness
    view, size, scale = camera(62, -34), (800, 560), 3.55
    middle = (0, 0, below - 2)
    figure = plt.figure(figsize=(8, 5.6))
    ax = figure.add_axes((0, 0, 1, 1))
    near = [
        (np.stack([tri[..., 0], tri[..., 1], np.minimum(tri[..., 2], 2.0)], axis=-1), colour)
        for tri, colour in mesh
    ]
    ax.imshow(render(near, view, size, scale, middle))
    ax.set_axis_off()
    annotate(ax, "motor plate", (125, 250), (90, 100))
    annotate(ax, "load-cell mount", (600, 205), (705, 95))
    annotate(ax, "load-cell beam", (503, 230), (640, 40))
    annotate(ax, "gear motor", (570, 270), (735, 425))
    annotate(ax, "spool", (505, 350), (705, 490))
    annotate(ax, "motor bracket", (385, 455), (250, 535))
    save(figure, "drive")


def main() -> None:
    part = load_dimensions(ROBOT)
    bodies = place_parts(part)
    draw_parts(part)
    draw_robot(part, bodies)
    draw_drive(part, bodies)


if __name__ == "__main__":
    main()
