"""Every public function that takes a robot takes a model, a model of a model, and a user's own system."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine.program import EngineError
from knode_cosserat.identification import evaluate
from knode_cosserat.learning import Residual
from knode_cosserat.learning.residual import Nothing, network
from knode_cosserat.learning.structured.residual import CURVED, LINEAR, Structured, expansion
from knode_cosserat.learning.terms import terms
from knode_cosserat.rods.parameters import value_at
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import cross, quaternion_rate, rotation_matrix
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point
from knode_cosserat.viewer import scene as drawing

DT, STEPS = 0.05, 12
#: the paper's network works in SI units, and nearly untrained it overturns a robot of some millinewtons
NETWORK = kc.FitConfig(
    residual=kc.learning.NetworkOptions(hidden=2, standardised=True), segments=kc.learning.Training(epochs=2)
)


class Cane(kc.System):
    """A rod of a user: the paper's equations in the general form, pushed across by two forces."""

    y_layout: ClassVar = kc.robots.Layout(
        ("p", 3, "m", "position"),
        ("h", 4, "1", "orientation"),
        ("n", 3, "N", "force", "h", "N/m"),
        ("m", 3, "N m", "moment", "h", "N"),
        ("q", 3, "m/s", "velocity"),
        ("w", 3, "rad/s", "spin"),
    )
    z_layout: ClassVar = kc.robots.Layout(("v", 3, "1", "stretch"), ("u", 3, "1/m", "curvature"))
    control_layout: ClassVar = kc.robots.Layout(("tension", 2, "N", "pulls along x and y"))
    base_unknowns: ClassVar = ("n", "m")
    mixed: ClassVar = False

    length: Any = kc.robots.parameter("m", "length", low=0.01, high=10.0)
    mass: Any = kc.robots.parameter("kg/m", "mass per length", low=1e-3, high=10.0)
    bending: Any = kc.robots.parameter("N m2", "EI", low=1e-6, high=1e3)
    damping: Any = kc.robots.parameter("N m2 s", "of bending", low=0.0, high=10.0, default=1e-3)

    def constitutive(self, s, t, y, y_t, control):
        R = rotation_matrix(self.y_layout.get(y, "h")).T
        stress = jnp.concatenate([R @ self.y_layout.get(y, "n"), R @ self.y_layout.get(y, "m")])
        K = jnp.concatenate([1e4 * jnp.ones(3), self.bending * jnp.ones(3)])
        B = jnp.concatenate([jnp.zeros(3), self.damping * jnp.ones(3)])
        return jnp.diag(K), jnp.diag(B), stress + K * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def balance(self, s, t, y, y_t, z, z_t, control):
        get = self.y_layout.get
        (v, u), (v_t, u_t), R = self.z_layout.split(z), self.z_layout.split(z_t), rotation_matrix(get(y, "h"))
        q, w, q_t, w_t = get(y, "q"), get(y, "w"), get(y_t, "q"), get(y_t, "w")
        push = jnp.concatenate([control, jnp.zeros(1)])
        f = [
            R @ v,
            quaternion_rate(get(y, "h"), u),
            self.mass * (R @ (cross(w, q) + q_t)) - push,
            1e-6 * w_t - cross(R @ v, get(y, "n")),
            v_t - cross(u, q) + cross(w, v),
            u_t - cross(u, w),
        ]
        return jnp.concatenate(f)

    def rest(self, s):
        p = jnp.stack([jnp.zeros(()), jnp.zeros(()), jnp.asarray(s, dtype=float)])
        y = jnp.concatenate([p, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(12)])
        return y, jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def tip(self, t, control, y, y_t):
        return jnp.concatenate([self.y_layout.get(y, "n"), self.y_layout.get(y, "m")])


def with_network(system: kc.System, seed: int) -> kc.KNODE:
    """Return a model with a small network, scaled so that it bends the rod a little."""
    options = kc.learning.NetworkOptions(hidden=3, convex=False)
    net = network(system, options, jax.random.key(seed))
    layout = kc.robots.Layout(*system.y_layout.fields, *system.z_layout.fields)
    size = np.concatenate([np.asarray(system.scales().y) / float(system.length), np.full(6, 1e-2)])
    size = np.where(np.isin(np.arange(25), layout.indices(("n", "m", "u"))), size, 0.0)
    return kc.KNODE(system, dataclasses.replace(net, output_scale=1e-2 * size))


ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5, bending_damping=0.02)
MODEL = with_network(ROBOT, 0)
CANE = Cane(length=0.5, mass=0.2, bending=0.1, damping=5e-3, nodes=5)
ROBOTS = {
    "robot": ROBOT, "model": MODEL, "model of a model": with_network(MODEL, 1), "own": CANE,
    "model of own": with_network(CANE, 2),
    "arm": kc.load_robot("three-chamber-arm").replace(nodes=5),
    "tubes": kc.load_robot("three-tube-robot").replace(nodes=13),
    "catheter": kc.load_robot("magnetic-catheter").replace(nodes=5),
    "fed catheter": kc.load_robot("fed-catheter").replace(nodes=5),
    "gripper": kc.load_robot("three-finger-gripper").replace(nodes=5),
}  # fmt: skip
#: means of the controls of robots whose controls are not the paper's four tensions
MEANS = {
    "own": [0.3, 0.1], "model of own": [0.3, 0.1], "arm": [2e4, 1.5e4, 1e4],
    "tubes": [1.0, 0.02, -0.5, 0.01, 0.3, 0.02],
    "gripper": [1.0, 1.5, 2.0, 0.8, 0.9, 1.0], "catheter": [2e-3, 1e-3, 3e-3],
    "fed catheter": [2e-3, 1e-3, 3e-3, 0.01],
}  # fmt: skip
#: identified parameters of robots of which it is not Young's modulus
PARAMETERS = {
    "own": "bending",
    "model of own": "bending",
    "arm": "effects.0.offset",
    "tubes": "tubes.1.curvature",
    "gripper": "rods.thumb.youngs_modulus",
}


class Made(NamedTuple):
    """A robot's controls, its equilibrium under the first of them, its motion, and measurements of that."""

    controls: np.ndarray
    rest: kc.Trajectory
    motion: kc.Trajectory
    seen: kc.recordings.Measurements

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        return 0.9 * self.controls.min(axis=0), 1.1 * self.controls.max(axis=0)


@functools.cache
def made(kind: str) -> Made:
    robot = ROBOTS[kind]
    mean = np.array(MEANS.get(kind, [6.0, 5.0, 4.0, 5.0]))
    controls = mean * (1.0 + 0.3 * np.sin(2.0 * np.pi * DT * np.arange(1, STEPS + 1) / 0.4)[:, None])
    rest = kc.equilibrium(robot, controls[0])
    motion = kc.simulate(robot, controls, DT, initial=rest)
    return Made(controls, rest, motion, kc.recordings.Measurements.of(motion, (0.5, 1.0)))


def name_of_a_parameter(robot: kc.System) -> str:
    kind = next(kind for kind, one in ROBOTS.items() if one is robot)
    return PARAMETERS.get(kind, "youngs_modulus")


def fitted(robot: kc.System, it: Made, config: kc.FitConfig) -> Any:
    model = kc.fit(robot, [it.motion], config)
    assert isinstance(model, kc.KNODE) and model.knowledge is robot
    return kc.simulate(model, it.controls[:2], DT, initial=it.rest).tip_position


def structured(robot: kc.System, it: Made) -> Any:
    model = kc.fit(robot, [it.motion])
    # nothing is missing: the motion is the robot's own
    assert abs(float(model.residual.stretch)) < 1e-6
    assert all(abs(each.coefficient) < 1e-2 for each in kc.learning.explain(model) if each.part == "stress")
    return model.residual.stretch


def estimated(robot: kc.System, it: Made, method: Any) -> Any:
    states = kc.estimate_states(it.seen, robot, method, dt=DT)
    tip = np.linalg.norm(states.tip_position - it.motion.tip_position, axis=-1)
    assert np.max(tip) < 0.02 * float(robot.length)
    assert len(kc.recordings.estimate_parts(it.seen, robot, method, dt=DT)) == 1
    return states.y


def stepped(robot: kc.System, it: Made) -> Any:
    stepper = kc.solvers.Stepper(robot, DT, initial=it.rest)
    for control in it.controls[:2]:
        tip = stepper.step(control).tip_position
    np.testing.assert_allclose(tip[0], it.motion.tip_position[2], atol=1e-7)
    return tip


def followed(robot: kc.System, it: Made) -> Any:
    path = kc.statics.equilibrium_path(robot, it.controls[0], it.controls[1], points=3, with_stability=False)
    return path.trajectory.y


def reached(robot: kc.System, it: Made) -> Any:
    low, high = it.limits
    found = kc.inverse_kinematics(robot, it.rest.tip_position[0], low=low, high=high, starts=1)
    assert found.converged
    return found.control


def identified(robot: kc.System, it: Made, measured: bool) -> Any:
    name = name_of_a_parameter(robot)
    data: Any = it.motion
    if measured:  # they begin unloaded
        data = kc.recordings.Measurements.of(
            kc.simulate(robot, it.controls, DT, space="lobatto4"), (0.5, 1.0)
        )
    found = kc.identify(robot, [data], parameters=[name])
    assert type(found.robot) is type(robot)
    value, true = (value_at(nominal_model(one), name) for one in (found.robot, robot))
    np.testing.assert_allclose(value, true, rtol=1e-3)
    return value


def predicted(robot: kc.System, it: Made) -> Any:
    found = evaluate(robot, it.seen, space="lobatto2")  # the scheme of the simulation
    assert found.failed is None and found.tip_rmse < 1e-6
    return found.tip_rmse


def controlled(robot: kc.System, it: Made) -> Any:
    tip, (low, high) = kc.estimation.TipPosition(), it.limits
    mean = 0.5 * (low + high)
    goal = kc.equilibrium(robot, mean).tip_position[0]
    limits = kc.control.ControlLimits(np.minimum(0.0, mean - np.abs(mean)), mean + np.abs(mean))
    controller = kc.control.PredictiveController(
        kc.estimation.KalmanObserver(robot, DT, tip), tip, limits, horizon=6, knots=3
    )
    plant = kc.control.SimulatedPlant(robot, DT, kc.control.Sensor(tip))
    log = kc.control.run_loop(controller, plant, kc.control.constant(goal), 1.5)
    assert log.tip_distance[-5:].max() < 0.2 * np.linalg.norm(goal - robot.rest(robot.length)[0][:3])
    return log.tip


#: function by name: called with a robot and with what it `Made`, it returns numbers
FUNCTIONS: dict[str, Callable[[Any, Made], Any]] = {
    "simulate": lambda robot, it: it.motion.y,
    "equilibrium": lambda robot, it: it.rest.y,
    "equilibria": lambda robot, it: kc.solvers.equilibria(robot, it.controls[:2], initial=it.rest).y,
    "stability": lambda robot, it: kc.statics.stability(it.rest).unstable_directions,
    "equilibrium_path": followed,
    "configuration": lambda robot, it: kc.statics.configuration(robot, it.controls[0]).jacobian,
    "compliance": lambda robot, it: kc.statics.configuration(robot, it.controls[0]).compliance,
    "workspace": lambda robot, it: kc.workspace(robot, *it.limits, 2).position,
    "inverse_kinematics": reached,
    "Stepper": stepped,
    "fit, structured": structured,
    "fit, network": lambda robot, it: fitted(robot, it, NETWORK),
    "identify, states": lambda robot, it: identified(robot, it, False),
    "identify, poses": lambda robot, it: identified(robot, it, True),
    "estimate_states": lambda robot, it: estimated(robot, it, "best"),
    "estimate_states, paper": lambda robot, it: estimated(robot, it, "paper"),
    "evaluate": predicted,
    "predictive control": controlled,
}
#: they compile for long
SLOW = {
    "stability",
    "equilibrium_path",
    "identify, poses",
    "fit, network",
    "predictive control",
}
#: kinds for which every other function is called each time
OFTEN = {"model of a model"}
#: functions that are not called each time for a model of a model: they compile as long again
LONG_FOR_MODELS = {"estimate_states", "estimate_states, paper", "configuration", "compliance", "workspace"}
#: functions that are called each time for a user's own system
OWN = {"simulate", "equilibrium", "estimate_states", "fit, structured", "configuration", "evaluate"}
#: functions that need a capability, and the words of the error that names it
LACKING = {
    **{
        (name, kind): (kc.recordings.RecordingError, "has a length that controls change")
        for name in ("estimate_states", "estimate_states, paper")
        for kind in ("tubes", "fed catheter")
    },
    **{
        (name, "gripper"): (kc.recordings.RecordingError, "estimation is for rods with p, h, q, w, n, m")
        for name in ("estimate_states", "estimate_states, paper")
    },
    ("stability", "gripper"): (ValueError, "its motions have more than 4000 history terms"),
    ("compliance", "gripper"): (ValueError, "the robot's tip has no force n or moment m"),
    ("fit, network", "gripper"): (EngineError, "more than 180000 operations; use smaller laws"),
}


def calls() -> Iterator[Any]:
    for kind in ROBOTS:
        for name in FUNCTIONS:
            often = (kind in OFTEN and name not in SLOW | LONG_FOR_MODELS) or (kind == "own" and name in OWN)
            quick = kind in OFTEN and name == "equilibrium"
            marks = [] if quick else [pytest.mark.slow if often else pytest.mark.campaign]
            yield pytest.param(name, kind, marks=marks, id=f"{name}-{kind}")


@pytest.mark.parametrize(("name", "kind"), list(calls()))
def test_every_function_takes_every_robot(name, kind):
    if (name, kind) in LACKING:
        error, words = LACKING[name, kind]
        with pytest.raises(error, match=words):
            FUNCTIONS[name](ROBOTS[kind], made(kind))
        return
    found = np.asarray(FUNCTIONS[name](ROBOTS[kind], made(kind)), dtype=float)
    assert found.size and np.all(np.isfinite(found))


def shown(kind: str) -> kc.Trajectory:
    """Rows that need no simulation: the robot at rest, then leaning over."""
    robot = ROBOTS[kind]
    s = np.linspace(0.0, 1.0, robot.nodes) * float(robot.length)
    y, z = (np.stack([np.asarray(robot.rest(at)[k]) for at in s]) for k in (0, 1))
    y, z = (np.tile(each, (4, 1, 1)) for each in (y, z))
    y[..., :2] += 0.1 * s[:, None] * np.arange(4)[:, None, None]
    rows = np.zeros(4, dtype=int)
    return kc.Trajectory(
        robot, None, DT * np.arange(4), y, z, np.zeros((4, robot.control_layout.size)), rows, 0.0 * rows, rows
    )


@pytest.mark.parametrize("kind", ROBOTS)
def test_files_figures_and_the_viewer_take_every_robot(kind, tmp_path):
    robot, trajectory = ROBOTS[kind], shown(kind)
    own = "own" in kind
    trajectory.save(tmp_path / "a.nc")
    again = kc.load_trajectory(tmp_path / "a.nc", system=robot if own else None)
    np.testing.assert_array_equal(again.y, trajectory.y)
    same(again.system, robot)
    if isinstance(robot, kc.KNODE):
        robot.save(tmp_path / "a.model")
        same(kc.load_model(tmp_path / "a.model", knowledge=CANE if own else None), robot)
        kc.learning.Ensemble([robot]).save(tmp_path / "members")
        same(kc.learning.load_ensemble(tmp_path / "members", knowledge=CANE if own else None)[0], robot)
    for draw in ("shape", "path", "tips", "states", "overview", "tensions"):
        assert getattr(kc.figures, draw)(trajectory).axes
    kc.viewer.export_scene(trajectory, tmp_path / "a.html")
    assert drawing.drawing(robot, np.arange(robot.nodes))["model"] is isinstance(robot, kc.KNODE)
    assert len(drawing.sliders(robot)) == robot.control_layout.size
    text = ";".join(f"{name}=constant:1.0" for name in kc.controls.labels(robot.control_layout))
    assert kc.controls.parse(text, 3, DT, robot).shape == (3, robot.control_layout.size)


def same(found: kc.System, expected: kc.System) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_change_of_a_model_is_one_of_its_robot():
    nested = ROBOTS["model of a model"]
    changed = nested.replace(youngs_modulus=1e9, nodes=7)
    assert isinstance(changed, kc.KNODE) and nominal_model(changed).youngs_modulus == 1e9
    assert changed.nodes == changed.knowledge.nodes == nominal_model(changed).nodes == 7
    assert nominal_model(nested) is ROBOT and nominal_model(ROBOT) is ROBOT
    longer = [Structured(np.array(stretch), None, None, None) for stretch in (0.1, 0.2)]
    both = kc.KNODE(kc.KNODE(ROBOT, longer[0]), longer[1])
    assert float(both.length) == pytest.approx(1.32 * float(ROBOT.length))


def test_what_is_missing_is_named():
    with pytest.raises(kc.robots.RobotFileError, match="KNODE"):
        kc.save_robot(MODEL, "a.yaml")
    with pytest.raises(TypeError, match="allowed is a KNODE"):
        kc.learning.explain(CANE)


class Pull(Residual):
    """A residual of a user: the load on n, and a strain."""

    size: Any

    def correction(self, knowledge, s, t, y, y_t, z, z_t, control):
        return jnp.zeros(len(y) + len(z)).at[7].set(self.size).at[len(y) + 4].set(self.size * y[10])


@functools.cache
def residuals() -> dict[str, Residual]:
    rng = np.random.default_rng(5)
    empty = terms(ROBOT, rng.uniform(1.0, 5.0, (8, 4)))
    stress = {}
    for curved, forms in (("linear", LINEAR), ("curved", CURVED)):
        layout = kc.robots.Layout(*((name, 3, "", name) for name in ("v", "u", "v_t", "u_t")))
        plain = expansion(layout, rng.normal(size=(50, 12)), dict.fromkeys(layout.names, forms), 6)
        weights = 1e-5 * rng.normal(size=np.shape(plain.weights))
        stress[curved] = dataclasses.replace(plain, weights=weights)
    return {
        "nothing": Nothing(),
        "network": MODEL.residual,
        "terms": empty.with_coefficients(
            {name: 0.1 * rng.normal(size=np.shape(part)) for name, part in empty.coefficients().items()}
        ).clamped(),
        **{name: Structured(np.array(0.02), each, None, None) for name, each in stress.items()},
        "a user's": Pull(np.array(0.1)),
    }


def models() -> Iterator[Any]:
    """Residuals with nominal models. Long runs have the curved expansion of all of them, others of one."""
    for name in residuals():
        for kind, nominal in (("robot", ROBOT), ("own", CANE), ("model", MODEL)):
            long = name == "curved" and kind != "robot"
            marks = [pytest.mark.campaign] if long else [pytest.mark.slow] if name == "curved" else []
            yield pytest.param(name, nominal, marks=marks, id=f"{name}-{kind}")


@pytest.mark.parametrize(("name", "nominal"), list(models()))
def test_the_parts_of_a_model_s_equations_agree(name, nominal):
    """`strains` and `rates` are `derivatives`; the law is zero there, with the derivative it states."""
    if name == "terms" and nominal is CANE:
        pytest.skip("these are terms of a robot with four tendons")
    model = with_network(nominal, 3) if name == "network" else kc.KNODE(nominal, residuals()[name])
    rng = np.random.default_rng(7)
    y = np.concatenate([np.zeros(3), [1.0, 0.1, 0.2, 0.0], 0.1 * rng.normal(size=12)])
    history = History(20.0, *(0.1 * rng.normal(size=size) for size in (19, 6, 19)))
    control = rng.uniform(1.0, 3.0, nominal.control_layout.size)
    step = 1e-3 * rng.normal(size=6)

    @jax.jit  # one program, instead of one for each operation
    def parts(y, control, history):
        point = Point(0.1, 0.0, y, control, history)
        y_s, z = semi_discrete.derivatives(model, point)
        strains, rates = semi_discrete.strains(model, point), semi_discrete.rates(model, point, z)
        matrix = semi_discrete.law(model, point).matrix(z)
        residuals = [semi_discrete.law_residual(model, point, there) for there in (z, z + step)]
        return y_s, z, strains, rates, matrix, *residuals

    y_s, z, strains, rates, matrix, law, moved = parts(y, control, history)
    np.testing.assert_allclose(strains, z, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(rates, y_s, rtol=1e-9, atol=1e-10)
    size = np.abs(matrix) @ np.abs(z)
    assert np.all(np.abs(law) < 1e-9 * size + 1e-12)
    if semi_discrete.law(model, Point(0.1, 0.0, y, control, history)).linear:
        np.testing.assert_allclose(moved, matrix @ step, rtol=1e-6, atol=1e-9 * np.max(size))
