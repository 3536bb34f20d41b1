"""Model of a released clamped silicone beam: its rod, its parameters, and the motion of its markers.

The frame is the recordings' (`recordings.beam`): x upwards, z along the beam. The held beam is the
equilibrium under a vertical force of the hand at the tip that reproduces the measured height of the tip. At
the release this force vanishes.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.rods.viscoelastic_rod import ViscoelasticRod
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory
from studies.beam_recordings import THRESHOLD, BeamRecording, tip_drop

#: the beam of srl-ethz/diffPD_sim2real (RA-L 2022, arXiv 2201.12560): m, m, kg/m³
LENGTH, WIDTH, DENSITY, POISSON = 0.1, 0.03, 1070.0, 0.499
GRAVITY = 9.81
#: markers 0 to 2 from the centre of the end face (m)
MARKERS = np.array([[0.021, 0.0, 0.0], [0.009, 0.021, 0.0], [-0.009, -0.021, 0.0]])
#: the load hangs at the upper edge of the end face
UPPER_EDGE = (WIDTH / 2, 0.0, 0.0)
#: in time: at 2.5 ms the beam's fastest motion that is seen (8 Hz) is damped by less than 0.1 % of critical
TIME = "bdf-alpha"
#: time of a prediction (s) beyond that of the recording after the threshold
LEAD = 0.1
#: terms of the series of the torsion constant
TERMS = 20


class Numerics(NamedTuple):
    """Numerical settings: nodes along the rod, and time step (s)."""

    nodes: int = 11
    dt: float = 2.5e-3


#: settings of the studies
DEFAULT = Numerics()


@dataclasses.dataclass(frozen=True)
class Beam:
    """Parameters of the beam and of its rig; the identification fits them."""

    #: Young's modulus at rest (Pa)
    youngs_modulus: float
    #: Kelvin-Voigt damping over stiffness (s)
    damping_time: float
    #: stiffness of the Maxwell branch over that at rest, and its relaxation time (s)
    branch_stiffness: float = 0.0
    relaxation_time: float = 0.1
    #: the clamped end points down by this angle (rad)
    tilt: float = 0.0
    #: height (m) of the unloaded tip over the mean of the base's markers; None: where it was held
    level: float | None = None


def shear_factor(poisson: float = POISSON) -> float:
    """Return the shear correction factor of a rectangle, 10 (1 + ν) / (12 + 11 ν) (Cowper 1966)."""
    return 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson)


def torsion_constant(width: float = WIDTH) -> float:
    """Torsion constant of a square section (m⁴), Saint-Venant's series: 0.1406 times the fourth power."""
    odd = 2.0 * np.arange(TERMS) + 1.0
    series = float(np.sum(np.tanh(odd * np.pi / 2.0) / odd**5))
    return width**4 * (1.0 / 3.0 - 64.0 / np.pi**5 * series)


def beam_rod(beam: Beam, load: float, nodes: int) -> ViscoelasticRod:
    """Return the rod of a beam with a load (kg); its control is the vertical force of the hand (N).

    The rod's own section is round. Its radius gives the square's area; its rotary inertia is 4.5 % less than
    the square's, and stiffness and damping are given as matrices.
    """
    E, G = beam.youngs_modulus, beam.youngs_modulus / (2.0 * (1.0 + POISSON))
    area, second_moment = WIDTH**2, WIDTH**4 / 12.0
    shear = shear_factor() * G * area
    Kse = np.diag([shear, shear, E * area])
    Kbt = np.diag([E * second_moment, E * second_moment, G * torsion_constant()])
    half = 0.5 * beam.tilt
    return ViscoelasticRod(
        length=LENGTH, radius=WIDTH / np.sqrt(np.pi), density=DENSITY, youngs_modulus=E, shear_modulus=G,
        shear_stiffness=Kse, bending_stiffness=Kbt, shear_damping=beam.damping_time * Kse,
        bending_damping=beam.damping_time * Kbt, branch_stiffness=beam.branch_stiffness,
        relaxation_time=beam.relaxation_time, gravity=(-GRAVITY, 0.0, 0.0), nodes=nodes,
        base_end=Clamped(orientation=(np.cos(half), 0.0, -np.sin(half), 0.0)),
        loads=(
            AttachedMass(mass=load, offset=UPPER_EDGE),
            PointWrench(force=(1.0, 0.0, 0.0), controlled=True),
        ),
    )  # fmt: skip


def held_deflection(beam: Beam, recording: BeamRecording) -> float:
    """Return the height (m) of the held tip over that of the unloaded beam."""
    return 0.0 if beam.level is None else tip_height(recording) - beam.level


def tip_height(recording: BeamRecording) -> float:
    """Return the height (m) of the held end face over the mean of the base's markers."""
    return float(np.mean(recording.held[:, 0] - MARKERS[:, 0]) - np.mean(recording.base[:, 0]))


def held_beam(rod: ViscoelasticRod, load: float, deflection: float) -> Trajectory:
    """Return the equilibrium with the tip held at a height (m) over that of the unloaded beam.

    The height is so nearly linear in the hand's force that two forces give the third.
    """
    height = deflection + float(rod.rest(LENGTH)[0][0])
    weight = GRAVITY * load
    forces = [weight + part * GRAVITY * DENSITY * WIDTH**2 * LENGTH for part in (0.375, 0.25)]
    heights = [_settled(rod, force).tip_position[0, 0] for force in forces]
    slope = (forces[1] - forces[0]) / (heights[1] - heights[0])
    return _settled(rod, forces[0] + slope * (height - heights[0]))


def _settled(rod: ViscoelasticRod, force: float) -> Trajectory:
    return equilibrium(rod, np.array([force]))


def step_count(recordings: list[BeamRecording], dt: float) -> int:
    """Return the number of time steps that predicts each of several recordings: one program for all."""
    # the beam falls for 20 to 30 ms before it crosses the threshold
    longest = max(each.time[-1] - each.crossing for each in recordings) + LEAD
    return int(np.ceil(longest / dt))


def markers_of(motion: Trajectory) -> Float[np.ndarray, "T 3 3"]:
    """Return the displacements (m) of the markers from the first row."""
    p, h = np.asarray(motion.tip_position), np.asarray(motion.quaternion)[:, -1]
    positions = p[:, None] + np.einsum("tij,kj->tki", _matrices(h), MARKERS)
    return positions - positions[0]


def _matrices(h: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 3 3"]:
    import jax

    return np.asarray(jax.vmap(rotation_matrix)(h))


def predict_markers(
    beam: Beam, recording: BeamRecording, steps: int, numerics: Numerics = DEFAULT
) -> Float[np.ndarray, "T 3 3"]:
    """Return the markers' displacements (m) at the times of a recording; NaN before the release.

    The prediction is put on the recording's clock where both tips have dropped by `THRESHOLD`.
    """
    rod = beam_rod(beam, recording.load, numerics.nodes)
    held = held_beam(rod, recording.load, held_deflection(beam, recording))
    motion = simulate(
        rod, np.zeros((steps, 1)), numerics.dt, time=TIME, start="paper", initial=held, on_failure="return"
    )
    moved = markers_of(motion)
    drop, times = tip_drop(moved), np.arange(steps + 1) * numerics.dt
    row = int(np.argmax(drop > THRESHOLD))
    if not row:
        return np.full((len(recording.time), 3, 3), np.nan)
    crossing = np.interp(THRESHOLD, drop[row - 1 : row + 1], times[row - 1 : row + 1])
    at = recording.time - recording.crossing + crossing
    columns = moved.reshape(len(times), -1).T
    found = np.stack([np.interp(at, times, each, left=np.nan) for each in columns], axis=1)
    return found.reshape(-1, 3, 3)
