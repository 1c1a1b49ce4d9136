"""Make the pictures of docs/ that matplotlib draws.

    python docs/make_pictures.py

arm.png shows the default run, from the samples of the FMU, with the arm drawn from its meshes as seen from above.
plot.png shows three gains; first.png, steered.png and gantry.png the runs of the tutorial, by its own commands; map.png
and load.png the sweeps in docs/gains.md. Needs the extras 'view', 'sweep' and 'native'.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Arc, Patch

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import twodof  # noqa: E402
from twodof.plots.figure import drawn  # noqa: E402
from twodof.plots.runs import plot  # noqa: E402
from twodof.plots.sweeps import drawing  # noqa: E402
from twodof.simulation.sampled_loop import spectral_radius  # noqa: E402

LINK = 0.15  # m
LINK_COLOURS = {"link1": (0.33, 0.40, 0.49), "link2": (0.96, 0.55, 0.14)}
INK, GREY, BLUE, ORANGE = "#1f2933", "#8a94a0", "#0060a8", "#f58c24"
WINDOW = (-0.110, 0.470, -0.148, 0.236)  # m: left, right, bottom, top
WIDTH = 1200  # pixels
GAINS = (20, 50, 400)  # 1/s²
RED, HATCHES = "#d62728", "///"
OVERSAMPLING = 3
LIGHT = np.array([-0.45, 0.60, 0.66])
STEP_IN_DEPTH = 0.0012  # m: an edge is drawn where the depth jumps by more


def main() -> None:
    """Make all pictures."""
    plt.rcParams.update({"font.family": "DejaVu Sans", "text.color": INK})
    with tempfile.TemporaryDirectory() as folder:
        fmu = twodof.build_fmu(Path(folder) / "TwoDof.fmu")
        samples = list(twodof.samples(fmu))
        draw_tutorial(Path(folder))
        draw_plot(fmu, ROOT / "docs" / "plot.png")
        native = twodof.build_fmu(Path(folder) / "TwoDof-native.fmu", twodof.FmuOptions(native=True))
        gains = {"Kp": np.linspace(10, 200, 20), "Kd": np.linspace(5, 80, 16)}
        draw_map(native, gains, {}, ROOT / "docs" / "map.png")
        loads = {"Kp": np.linspace(250, 5000, 20), "payload": np.linspace(0.024, 0.264, 11)}
        draw_map(native, loads, {"Kd": 80.0, "limit_effort": True}, ROOT / "docs" / "load.png")
        draw_sampled(Path(folder), ROOT / "docs" / "sampled.png")
    draw_arm(samples, ROOT / "docs" / "arm.png")


# --- the arm ---


def draw_arm(samples: list[twodof.Sample], path: Path) -> None:
    """Draw the arm at the start and at the end, with the path of its end effector."""
    left, right, bottom, top = WINDOW
    height = round(WIDTH * (top - bottom) / (right - left))
    figure = plt.figure(figsize=(WIDTH / 150, height / 150), dpi=150)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")
    first, last = samples[0], samples[-1]
    draw_scale(axes)
    for sample, opacity in ((first, 0.30), (last, 1.0)):
        image = render(triangles(sample.q), height)
        image[..., 3] *= opacity
        axes.imshow(image, extent=WINDOW, interpolation="none", zorder=2 + opacity)
    draw_path(axes, samples)
    figure.savefig(path, pil_kwargs={"optimize": True}, metadata={"Software": None})
    plt.close(figure)


def draw_scale(axes: plt.Axes) -> None:
    """Draw scales in metres with the base at 0, and the circle of the arm's reach."""
    reach = 2 * LINK
    axes.add_patch(Arc((0, 0), 2 * reach, 2 * reach, color=GREY, lw=1.4, ls=(0, (6, 4)), zorder=1))
    left, _, bottom, _ = WINDOW
    x, y = left + 0.040, bottom + 0.025
    axes.plot([0, 0.3], [y, y], color=INK, lw=1.2)
    axes.plot([x, x], [-0.1, 0.2], color=INK, lw=1.2)
    text = {"fontsize": 11}
    for tick in (0.0, 0.1, 0.2, 0.3):
        axes.plot([tick, tick], [y - 0.003, y + 0.003], color=INK, lw=1.2)
        axes.text(tick, y - 0.007, f"{tick:g}", ha="center", va="top", **text)
    for tick in (-0.1, 0.0, 0.1, 0.2):
        axes.plot([x - 0.003, x + 0.003], [tick, tick], color=INK, lw=1.2)
        label = f"{tick:g}".replace("-", "\N{MINUS SIGN}")
        axes.text(x - 0.006, tick, label, ha="right", va="center", **text)
    axes.text(0.309, y, "x in m", va="center", **text)
    axes.text(x, 0.209, "y in m", ha="center", va="bottom", **text)


def draw_path(axes: plt.Axes, samples: list[twodof.Sample]) -> None:
    """Draw the path of the end effector with a dot every half second, its target, and the notes."""
    x = np.array([sample.x for sample in samples])
    target = np.array([samples[0].inputs[f"x_des[{k}]"] for k in (1, 2)])
    axes.plot(*x.T, color="white", lw=5.5, zorder=4, solid_capstyle="round")
    axes.plot(*x.T, color=BLUE, lw=2.6, zorder=5, solid_capstyle="round")
    axes.plot(*x[::50].T, "o", color=BLUE, ms=6.5, mec="white", mew=1.2, zorder=6)
    axes.plot(*target, "+", color="white", ms=25, mew=5.0, zorder=7)
    axes.plot(*target, "+", color=INK, ms=22, mew=2.2, zorder=8)
    reach = 2 * LINK * np.array([np.cos(-0.22), np.sin(-0.22)])
    end = f"end, at the target\n({target[0]:g}, {target[1]:g})"
    for point, gap, text, colour in (
        (x[0], 0.016, "start", BLUE),
        (0.5 * (x[0] + x[50]), 0.006, "path of the end effector,\na dot every 0.5 s", BLUE),
        (target, 0.018, end, INK),
        (reach, 0.004, "reach of the arm", "#5b6570"),
    ):
        axes.plot([point[0] + gap, 0.309], [point[1]] * 2, color=colour, lw=0.8, zorder=3.5)
        axes.text(0.314, point[1], text, color=colour, fontsize=12, va="center")


def triangles(q: tuple[float, ...]) -> list[tuple[np.ndarray, tuple[float, float, float]]]:
    """Return each link's triangles at the angles q, n × 3 × 3 in m, and its colour."""
    elbow = (LINK * np.cos(q[0]), LINK * np.sin(q[0]), 0.0)
    poses = {"link1": (q[0], (0.0, 0.0, 0.0)), "link2": (q[0] + q[1], elbow)}
    placed = []
    for link, (angle, origin) in poses.items():
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        placed.append((read_stl(ROOT / "meshes" / f"{link}.stl") @ turn.T + origin, link))
    return [(corners, LINK_COLOURS[link]) for corners, link in placed]


def read_stl(path: Path) -> np.ndarray:
    """Return the triangles of a binary STL, n × 3 × 3."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    return np.frombuffer(path.read_bytes(), record, offset=84)["corners"].astype(float)


def render(parts: list[tuple[np.ndarray, tuple[float, float, float]]], height: int) -> np.ndarray:
    """Return an RGBA image of triangles seen from above: a depth buffer, shading and drawn edges."""
    rows, columns = height * OVERSAMPLING, WIDTH * OVERSAMPLING
    left, right, _, top = WINDOW
    scale = columns / (right - left)
    depth = np.full((rows, columns), -1.0)
    image = np.zeros((rows, columns, 4))
    for corners, colour in parts:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        pixels = np.stack([(corners[..., 0] - left) * scale, (top - corners[..., 1]) * scale], axis=-1)
        for (a, b, c), z, normal in zip(pixels, corners[..., 2], normals, strict=True):
            if normal[2] > 1e-6:
                fill(depth, image, (a, b, c), z, shade(colour, normal))
    edges = np.zeros((rows, columns), dtype=bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > STEP_IN_DEPTH
        pair = (jump[:-1], jump[1:]) if axis == 0 else (jump[:, :-1], jump[:, 1:])
        inner = (slice(1, -1), slice(None)) if axis == 0 else (slice(None), slice(1, -1))
        edges[inner] |= pair[0] | pair[1]
    image[edges] = (0.10, 0.13, 0.17, 1.0)
    image[..., :3] *= image[..., 3:]
    blocks = image.reshape(height, OVERSAMPLING, WIDTH, OVERSAMPLING, 4).mean(axis=(1, 3))
    blocks[..., :3] /= np.maximum(blocks[..., 3:], 1e-9)
    return blocks


def shade(colour: tuple[float, float, float], normal: np.ndarray) -> np.ndarray:
    """Return diffuse light from the upper left and a soft highlight."""
    light = LIGHT / np.linalg.norm(LIGHT)
    diffuse = max(0.0, float(normal @ light))
    half = light + np.array([0.0, 0.0, 1.0])
    highlight = max(0.0, float(normal @ half / np.linalg.norm(half))) ** 30
    return np.clip(np.array(colour) * (0.45 + 0.75 * diffuse) + 0.10 * highlight, 0.0, 1.0)


def fill(
    depth: np.ndarray,
    image: np.ndarray,
    corners: tuple[np.ndarray, np.ndarray, np.ndarray],
    z: np.ndarray,
    colour: np.ndarray,
) -> None:
    """Draw one triangle, corners in pixels, where it is nearer than the pixels so far."""
    a, b, c = corners
    low = np.maximum(np.floor(np.min(corners, axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(np.max(corners, axis=0)).astype(int) + 1, depth.shape[::-1])
    area = (b[1] - c[1]) * (a[0] - c[0]) + (c[0] - b[0]) * (a[1] - c[1])
    if area == 0.0 or (high <= low).any():
        return
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    u = ((b[1] - c[1]) * (x - c[0]) + (c[0] - b[0]) * (y - c[1])) / area
    v = ((c[1] - a[1]) * (x - c[0]) + (a[0] - c[0]) * (y - c[1])) / area
    w = 1.0 - u - v
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    new = u * z[0] + v * z[1] + w * z[2]
    seen = (u >= -1e-9) & (v >= -1e-9) & (w >= -1e-9) & (new > depth[window])
    depth[window][seen] = new[seen]
    image[window][seen] = (*colour, 1.0)


# --- the plot ---


def draw_plot(fmu: Path, path: Path) -> None:
    """Draw three runs of the default arm that differ in their gain."""
    bags = [fmu.parent / f"Kp{gain}" for gain in GAINS]
    for gain, bag in zip(GAINS, bags, strict=True):
        run = twodof.experiment(fmu, settings={"Kp": gain})
        twodof.simulate(run, twodof.Bag(bag))
    figure = plot(*bags)
    figure.savefig(path, dpi=135, pil_kwargs={"optimize": True}, metadata={"Software": None})


def draw_tutorial(folder: Path) -> None:
    """Draw the runs of the tutorial by its own commands: the first run, the steered one and the gantry."""
    page = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    wanted = [block for block in blocks if re.search("-o my_bag|-o steered|gantry.urdf", block)]
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    for block in wanted:
        subprocess.run(["bash", "-ec", block], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
    for bag, name in (("my_bag", "first.png"), ("steered", "steered.png"), ("gantry", "gantry.png")):
        figure = plot(folder / bag)
        figure.savefig(ROOT / "docs" / name, dpi=90, pil_kwargs={"optimize": True}, metadata={"Software": None})
        plt.close(figure)


def draw_map(fmu: Path, grid: dict, settings: dict, path: Path) -> None:
    """Draw a map of the default arm."""
    table = fmu.with_name(path.stem)
    twodof.sweep(fmu, grid=grid, settings=settings, output=table)
    figure = drawn(drawing(twodof.read_sweep(table), path.stem))
    figure.savefig(path, dpi=120, pil_kwargs={"optimize": True}, metadata={"Software": None})


AS_IT_IS = {
    "q_des": (0.9, 0.8),
    "friction": 0.05,
    "control_delay": 0.002,
    "q_resolution": 2.0 * np.pi / 4096,
    "v_from_q": True,
    "max_step": 0.002,
}


def draw_sampled(folder: Path, path: Path) -> None:
    """Draw where the joints of a sampled arm with friction end, over gains and at two rates."""
    fmu = twodof.build_fmu(folder / "Joint.fmu", twodof.FmuOptions(control="joint", native=True))
    grid = {"Kp": np.geomspace(10, 30000, 36), "Kd": np.geomspace(5, 500, 24)}
    figure, all_axes = plt.subplots(1, 2, figsize=(10, 4.7), sharey=True, layout="constrained")
    for axes, T in zip(all_axes, (0.001, 0.01)):
        settings = {**AS_IT_IS, "control_period": T}
        table = folder / f"sampled {T}"
        twodof.sweep(fmu, grid=grid, settings=settings, stop_time=3.0, step=0.01, output=table)
        rows = twodof.read_sweep(table).sort_values(["Kp", "Kd"])
        Kp, Kd = (np.unique(rows[name]) for name in grid)
        error, chatter = (rows[m].to_numpy().reshape(len(Kp), len(Kd)) for m in ("final_joint_error", "chatter"))
        drawn_errors = axes.pcolormesh(Kd, Kp, error, norm=LogNorm(1e-3, 1.0), cmap="viridis", shading="nearest")
        axes.contourf(Kd, Kp, chatter, levels=[1.0, np.inf], colors="none", hatches=[HATCHES])
        radius = [[spectral_radius(p, d, T, AS_IT_IS["control_delay"], differences=True) for d in Kd] for p in Kp]
        axes.contour(Kd, Kp, radius, levels=[1.0], colors=RED, linewidths=2)
        axes.set(xscale="log", yscale="log", xlabel="Kd, 1/s", title=f"{1.0 / T:g} Hz")
    all_axes[0].set_ylabel("Kp, 1/s²")
    figure.colorbar(drawn_errors, ax=all_axes, label="largest joint error after 3 s, rad")
    hatched = Patch(facecolor="none", edgecolor="black", hatch=HATCHES, label="chatter above 1 N·m")
    limit = Line2D([], [], color=RED, lw=2, label="stability limit without friction")
    figure.legend(handles=[hatched, limit], loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=120, pil_kwargs={"optimize": True}, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
