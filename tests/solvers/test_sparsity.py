"""Which elements of an input enter: never fewer than by the derivatives, and exactly those where possible."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.solvers.problem import no_history
from knode_cosserat.solvers.semi_discrete import Point, derivatives, unpacked_history
from knode_cosserat.solvers.space import LOBATTO2
from knode_cosserat.solvers.sparsity import nonzero_columns

SIZE = 7


def found_in(function, *others):
    return nonzero_columns(jax.make_jaxpr(function)(jnp.ones(SIZE), *others), 0).tolist()


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda y: y[2], [2]),
        (lambda y: (2.0 * y)[1:6:2], [1, 3, 5]),
        (lambda y: jnp.stack([y[0], jnp.sin(y)[4]]) * 3.0, [0, 4]),
        (lambda y: jnp.concatenate([y[5:], y[:1]])[1:], [0, 6]),
        (lambda y: y[:6].reshape(2, 3).T[2], [2, 5]),
        (lambda y: jnp.where(y[0] > 0.0, y[1], y[2]), [0, 1, 2]),
        (lambda y: jnp.flip(y)[0] + jnp.split(y[:6], 2)[1][0], [3, 6]),
        (lambda y: jnp.broadcast_to(y[:, None], (SIZE, 2))[3, 1], [3]),
        (lambda y: jax.jit(lambda x: x[1:] * x[:-1])(y)[0], [0, 1]),
        (lambda y: jnp.zeros(3), []),
    ],
)
def test_moved_and_single_elements_are_kept_apart(function, expected):
    assert found_in(function) == expected


@pytest.mark.parametrize(
    "function",
    [
        lambda y: jnp.linalg.norm(y[2:4]),
        lambda y: jnp.linalg.solve(jnp.outer(y[:2], y[:2]) + jnp.eye(2), y[3:5]),
        lambda y: jax.lax.fori_loop(0, 3, lambda _, x: jnp.tanh(x @ x * x), y[1:4]),
        lambda y: jax.lax.cond(y[0] > 0.0, lambda x: x[1] ** 2, lambda x: x[2], y),
        lambda y: jnp.cumsum(y)[3] + jnp.sort(y[4:])[0],
        lambda y: jax.nn.relu(y[6]) * y[jnp.array([0, 2])].sum(),
        lambda y: y.at[3].set(0.0)[2:5] @ jnp.ones(3),
    ],
)
def test_never_fewer_than_the_derivatives_say(function):
    y = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.5, SIZE))
    slopes = np.abs(np.asarray(jax.jacfwd(function)(y))).reshape(-1, SIZE).max(axis=0)
    assert set(np.flatnonzero(slopes)) <= set(found_in(function))


class Tethered(kc.robots.SlenderRod):
    """A rod that a spring pulls back to its axis: its position enters."""

    def balance(self, s, t, y, y_t, z, z_t, control):
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        return self.y_layout.replaced(y_s, ("n",), self.y_layout.get(y_s, "n") + self.y_layout.get(y, "p"))


def fields_that_enter(robot):
    """Names of the fields of y that enter."""
    layout = robot.y_layout

    def equations(y, x, control):
        history = unpacked_history(robot, jnp.ones(()), x)
        return derivatives(robot, Point(0.1, 0.0, y, control, history))

    x = jnp.zeros(no_history(robot, LOBATTO2).shape[1])
    closed = jax.make_jaxpr(equations)(robot.rest(0.1)[0], x, jnp.zeros(robot.control_size))
    found = set(nonzero_columns(closed, 0).tolist())
    return {name for name in layout.names if found & set(layout.indices((name,)).tolist())}


def test_of_a_rod_everything_enters_but_its_position():
    rod = {"length": 0.5, "radius": 1e-3, "density": 1e3, "youngs_modulus": 1e8}
    assert fields_that_enter(kc.robots.SlenderRod(**rod)) == set("hnmqw")
    assert fields_that_enter(kc.load_robot("delrin-tendon-robot")) == set("hnmqw")
    assert fields_that_enter(Tethered(**rod)) == set("phnmqw")
