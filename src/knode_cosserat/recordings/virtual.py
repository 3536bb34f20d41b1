"""Recordings of a test robot in the paper's format, to test the whole pipeline without a robot.

Commands, in whole grams-force, reach the tendons through motors with a lag. The robot (`VirtualRobot`) is
simulated with finer steps and more nodes than models have. Motion capture tracks bodies with arbitrary axes,
loses frames and is noisy. Load cells are noisy and quantised. Every file states that it is simulated.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from knode_cosserat import controls
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.write import write_recording, writer_of
from knode_cosserat.rods.tendon_robots import TendonRod, VirtualRobot
from knode_cosserat.schemes.time import LIGHTLY_DAMPED
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: one gram-force (N)
GRAM = controls.TENSION_UNITS["gf"]
#: the paper's signals: rest tension, amplitude of sines, range of random ones (gf); rest durations (s)
REST, SWING, HIGHEST, RESTING, BEFORE_STEP = 500.0, 300.0, 700.0, 1.0, 2.0
#: period of commands, and hold time of random ones (s)
COMMANDED, HELD = 0.05, 0.4
#: the plant's time step (s) and number of nodes, and the time between its stored rows (s)
PLANT_STEP, PLANT_NODES, KEPT = 0.0025, 28, 0.01
LONGEST = 300.0


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Sensor errors and the motors' lag.

    Attributes:
        position_noise: standard deviation of a coordinate (m).
        turn_noise: standard deviation of an orientation about an axis (rad).
        lost: fraction of frames that motion capture loses.
        swap: time at which the axes of the third rib's body are swapped by a quarter turn (s), or None.
        tension_noise: standard deviation of a load cell (N).
        tension_step: quantisation step of a load cell (N).
        tension_period: sampling period of the load cells (s).
        lag: time constant of the motors (s).
    """

    position_noise: float = 0.15e-3
    turn_noise: float = 2e-3
    lost: float = 0.02
    swap: float | None = None
    tension_noise: float = 0.05
    tension_step: float = GRAM
    tension_period: float = 0.02
    lag: float = 0.06


def virtual_robot(nodes: int = PLANT_NODES) -> VirtualRobot:
    """Return the robot of virtual recordings: the paper's length, but softer, with tendons guided by ribs."""
    return VirtualRobot(
        length=0.635,
        radius=0.003175,
        density=1411.6751,
        youngs_modulus=1.0e9,
        bending_damping=0.01,
        drag=3e-3,
        tendon_offset=0.02,
        nodes=nodes,
    )


def record_virtual(
    path: str | Path,
    signal: str = "sine:1.0",
    seconds: float = 16.0,
    seed: int = 0,
    sensors: Sensors = Sensors(),
    robot: TendonRod | None = None,
) -> Trajectory:
    """Record a test robot: write its sensor data and return its true motion.

    Args:
        path: a bag (.bag, .mcap, .db3) or table (.csv, .parquet) for the paper's configuration.
        signal: `sine:PERIOD` (s), `step:HEIGHT` (N, tendons 3 and 4 after 2 s) or `random:SEED`, with the
            paper's rest tension and amplitudes; or any signal of `controls.parse`, after 1 s of rest.
        seconds: duration (s).
        seed: seed of the noise and of the rotations of the bodies' axes.
        sensors: noise and lag.
        robot: a robot with four tendons in the role of the real one; None: `virtual_robot()`.

    Returns:
        The plant's `Trajectory`, a row every 10 ms, starting in equilibrium at the first command.

    Raises:
        RecordingError: the path, a number or the robot is not allowed.
        ControlsError: the signal cannot be parsed.
        SimulationError: the simulation fails, for example at too large tensions.
    """
    path = Path(path)
    writer_of(path)
    if not 1.5 <= seconds <= LONGEST:
        raise RecordingError(f"seconds is {seconds:g}; allowed is 1.5 to {LONGEST:g} s")
    if not 0 <= seed < 2**32:
        raise RecordingError(f"seed is {seed}; allowed is a whole number from 0 to {2**32 - 1}")
    if robot is not None and robot.control_layout.size != 4:
        raise RecordingError(
            f"the robot has {robot.control_layout.size} controls; allowed is one with four tendons"
        )
    sent = commands(signal, seconds)
    truth = driven(sent, sensors.lag, virtual_robot() if robot is None else robot)
    poses, tension = simulated_sensors(truth, sent, seed, sensors)
    config = RecordingConfig.paper_robot().replace(simulated=True, description=f"a simulated robot: {signal}")
    write_recording(path, config, poses, tension, sent)
    return truth


# commands and tensions


def commands(signal: str, seconds: float) -> ControlRows:
    """Return the commands of a signal (see `record_virtual`): whole grams-force, in N, every 50 ms."""
    time = np.round(np.arange(0.0, seconds - 1e-9, COMMANDED), 9)
    grams = np.full((len(time), 4), REST)
    name, _, number = signal.partition(":")
    begin = BEFORE_STEP if name == "step" else RESTING
    moving = time > begin - 1e-9
    count = int(moving.sum())
    try:
        plain = float(number)
    except ValueError:
        plain = math.nan
    if count and name == "sine" and 0.0 < plain < math.inf:
        phase = 2 * np.pi * (time[moving] - begin) / plain
        turns = np.stack([np.cos(phase), np.sin(phase), -np.cos(phase), -np.sin(phase)], axis=1)
        grams[moving] += SWING * turns
    elif count and name == "step" and math.isfinite(plain):
        newtons = controls.step(
            plain, count, COMMANDED, base=REST * GRAM, at=0.0, tendons=(2, 3), sampled="end"
        )
        grams[moving] = newtons / GRAM
    elif count and name == "random" and number.isdecimal():
        hold = round(HELD / COMMANDED)
        grams[moving] = controls.random(count, low=REST, high=REST + HIGHEST, seed=int(number), hold=hold)
    else:
        newtons = controls.parse(
            signal, None if Path(signal).exists() else max(count, 1), COMMANDED, sampled="end"
        )
        used = newtons[:count]
        grams[len(time) - count : len(time) - count + len(used)] = used / GRAM
        grams[len(time) - count + len(used) :] = grams[len(time) - count + len(used) - 1]
    return ControlRows(time, np.round(grams) * GRAM, "", (("tension", 4),))


def lagged(sent: ControlRows, time: Float[np.ndarray, " n"], lag: float) -> Float[np.ndarray, "n 4"]:
    """Return tensions (N) at evenly spaced times (s): the held commands after a first-order lag.

    The result is exact if each command's time is one of these times.
    """
    if lag <= 0.0:
        return sent.values[np.searchsorted(sent.time, time + 1e-9, side="right") - 1]
    stays = np.exp(-(time[1] - time[0]) / lag)
    # the last command before an interval acts during it
    held = sent.values[np.searchsorted(sent.time, time - 1e-9, side="right").clip(1) - 1]
    followed = [held[0]]
    for target in held[1:]:
        followed.append(target + (followed[-1] - target) * stays)
    return np.array(followed)


def driven(sent: ControlRows, lag: float, robot: TendonRod) -> Trajectory:
    """Return the motion of a robot under commands, in rows 10 ms apart."""
    robot = robot.replace(nodes=PLANT_NODES)
    time = np.arange(round((sent.time[-1] + COMMANDED) / PLANT_STEP) + 1) * PLANT_STEP
    tension = lagged(sent, time, lag)
    still = equilibrium(robot, tension[0], space="lobatto4", with_stability=False)
    fine = simulate(
        robot, tension[1:], PLANT_STEP, time=LIGHTLY_DAMPED, start="paper", space="lobatto4", initial=still
    )
    rows = fine[:: round(KEPT / PLANT_STEP)]
    return dataclasses.replace(rows, settings=None)


# sensors


def simulated_sensors(
    truth: Trajectory, sent: ControlRows, seed: int, sensors: Sensors
) -> tuple[dict[str, Body], ControlRows]:
    """Return simulated motion capture (poses by the paper's marker names) and load cells of a motion."""
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng(seed)
    time = np.round(np.asarray(truth.time), 9)
    config = RecordingConfig.paper_robot()
    assert config.base is not None
    clamped_end = random.uniform([-0.5, -0.5, 0.8], [0.5, 0.5, 1.2])
    kept = random.uniform(size=len(time)) >= sensors.lost

    def seen(place: np.ndarray, turn: np.ndarray, swap: float | None) -> Body:
        """Return noisy poses of a body with randomly rotated axes, without its lost frames."""
        axes: Rotation = Rotation.from_quat(random.normal(size=4))
        # some frames are lost for one body only
        shown = kept & (random.uniform(size=len(time)) >= sensors.lost / 4)
        shaken = Rotation.from_rotvec(random.normal(0.0, sensors.turn_noise, (len(time), 3)))
        turned = shaken * Rotation.from_quat(turn, scalar_first=True) * axes
        late = time >= (np.inf if swap is None else swap)
        if late.any():
            quarter = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
            turned = Rotation.concatenate([turned[~late], turned[late] * quarter])
        position = place + random.normal(0.0, sensors.position_noise, place.shape)
        return Body(time[shown], position[shown], turned.as_quat(scalar_first=True)[shown])

    poses = {}
    for k, marker in enumerate(config.markers):
        node = round(marker.fraction * (np.shape(truth.y)[-2] - 1))
        place, turn = np.asarray(truth.position)[:, node], np.asarray(truth.quaternion)[:, node]
        poses[marker.name] = seen(place + clamped_end, turn, sensors.swap if k == 2 else None)
    above = clamped_end + np.array([0.0, 0.0, config.base.height])
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1))
    poses["base"] = seen(np.tile(above, (len(time), 1)), upright, None)
    stamps = np.round(np.arange(0.0, time[-1] - 1e-9, sensors.tension_period), 9)
    fine = np.round(np.arange(0.0, time[-1] + 1e-9, PLANT_STEP), 9)
    true = lagged(sent, fine, sensors.lag)[np.round(stamps / PLANT_STEP).astype(int)]
    noisy = true + random.normal(0.0, sensors.tension_noise, true.shape)
    step = sensors.tension_step
    return poses, ControlRows(stamps, np.round(noisy / step) * step if step > 0.0 else noisy)
