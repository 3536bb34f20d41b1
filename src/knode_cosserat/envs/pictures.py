"""Pictures and animations of an episode: robot, target and obstacles, from the side and from below."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from knode_cosserat._arguments import check_arguments
from knode_cosserat.envs.dynamics import EpisodeState
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.policy import Policy
from knode_cosserat.figures.animation import write_frames
from knode_cosserat.figures.style import require_matplotlib
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.wrapped import nominal_model

#: size (inches) and resolution of a picture
SIZE, DPI = (7.0, 3.5), 80


def picture(environment: Environment, state: EpisodeState) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture of an episode; it needs matplotlib, the extra `viz`."""
    require_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.image import imread
    from matplotlib.patches import Circle

    system = environment.system(state)
    points = np.asarray(Drawing.of(system).positions(state.history.y[0]))
    goal, t = state.goal, float(state.count) * environment.dt
    target = np.asarray(environment.task.target(goal, t))[:3]
    span = 1.1 * float(np.max(nominal_model(environment.robot).length))
    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 2), ((0, 2), (0, 1)), strict=True):
        axes.plot(points[:, a], points[:, b], color="C0", lw=2.5)
        for obstacle in getattr(nominal_model(system), "surroundings", ()):
            if (centre := getattr(obstacle, "center", None)) is not None:
                place = float(centre[a]), float(centre[b])
                axes.add_patch(Circle(place, float(obstacle.radius), color="0.6"))
        axes.plot(target[a], target[b], "x", color="C3", ms=9, mew=2)
        axes.set(xlim=(-span, span), aspect="equal", xlabel=f"{'xyz'[a]} (m)", ylabel=f"{'xyz'[b]} (m)")
        axes.set_ylim((-span, span))
    figure.suptitle(f"{environment.task.name}, t = {t:.2f} s")
    data = io.BytesIO()
    figure.savefig(data, format="png")
    data.seek(0)
    return (255 * imread(data)[:, :, :3]).round().astype(np.uint8)


def animate_episode(
    environment: Environment, policy: Policy, key: jax.Array | np.ndarray, path: str | Path
) -> Path:
    """Write a GIF or MP4 of a policy's episode in real time, and return its path.

    Args:
        environment: the environment.
        policy: what acts.
        key: of the episode.
        path: a name that ends in .gif or .mp4.

    Raises:
        ImportError: matplotlib is missing, the extra `viz`.
        ValueError: another name.
    """
    check_arguments(animate_episode, locals())
    require_matplotlib()
    from PIL import Image

    def frames() -> Iterator[Image.Image]:
        state, observation = environment.reset(jnp.asarray(key))
        yield Image.fromarray(picture(environment, state))
        for _ in range(environment.steps):
            state, after = environment.step(state, policy(np.asarray(observation)))
            yield Image.fromarray(picture(environment, state))
            if bool(after.terminated | after.truncated):
                return
            observation = after.observation

    return write_frames(frames(), Path(path), environment.dt)
