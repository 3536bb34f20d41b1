"""Programs of scalar operations, interpreted here with NumPy, agree with JAX."""

import dataclasses
import functools
import re

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.engine.program import FOLDED, EngineError, Program
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured.residual import CURVED, Structured, expansion
from knode_cosserat.learning.terms import terms
from knode_cosserat.recordings.virtual import virtual_robot
from knode_cosserat.rods.strands import strand_count, strand_of
from knode_cosserat.rods.system import unknown_count
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.space import LOBATTO2
from tests.engine.networks import PAPER, with_committee, with_network

#: operations on arrays that are not those of `FOLDED`
OF_ARRAYS = {
    "select": lambda p, no, yes: np.where(p, yes, no),
    "logistic": scipy.special.expit,
    "erf": scipy.special.erf,
}


def interpreted(program, outputs, inputs):
    """Return the values of nodes, from those of inputs by name."""
    found = {}
    for node in program.needed(outputs):
        name, *rest = program.operations[node]
        if name == "constant":
            found[node] = program.values[node]
        elif name == "input":
            found[node] = inputs[rest[0]]
        elif name == "result":
            found[node] = found[rest[0]][rest[1]]
        elif name == "loop":
            found[node] = looped(program.loops[node], found)
        elif name == "stack":
            found[node] = np.array([found[each] for each in rest])
        elif name == "inputs":
            scalars = range(rest[0], rest[0] + rest[1])
            found[node] = np.array([inputs[program.operations[each][1]] for each in scalars])
        elif name == "view":
            found[node] = found[rest[0]].ravel()[rest[1].all()]
        elif name == "sum":
            found[node] = np.sum(found[rest[0]], axis=-1)
        elif name == "spread":
            found[node] = np.zeros(rest[2])
            np.add.at(found[node].reshape(-1), rest[1].all(), found[rest[0]])
        elif name == "entry":
            found[node] = found[rest[0]].flat[rest[1]]
        elif node in program.shapes:
            found[node] = OF_ARRAYS.get(name, FOLDED[name])(*(found[each] for each in rest))
            assert found[node].shape == program.shapes[node]
        else:
            found[node] = FOLDED[name](*(found[each] for each in rest))
            assert program.is_boolean(node) == isinstance(found[node], (bool, np.bool_))
    return [found[int(node)] for node in outputs]


def looped(loop, outer):
    inputs = {name: outer[node] for name, node in loop.inputs}
    names = [loop.program.operations[node][1] for node in loop.state]
    state = [outer[node] for node in loop.initial]
    for _ in range(200):
        own = inputs | dict(zip(names, state, strict=True))
        goes_on, *following = interpreted(loop.program, [loop.condition, *loop.next], own)
        if not goes_on:
            return state
        state = following
    raise AssertionError("the loop does not end")


def evaluated(function, *arguments):
    """Return a program of a function of arrays, its inputs and outputs, and a function of outputs' values."""
    program = Program()
    nodes = [program.inputs(f"x{k}", np.shape(each), 1, in_memory=True) for k, each in enumerate(arguments)]
    outputs = program.evaluate(jax.make_jaxpr(function)(*arguments), nodes)

    def values(outputs, *arguments):
        inputs = {}
        for k, each in enumerate(arguments):
            inputs |= {f"x{k}[{i}]": value for i, value in enumerate(np.ravel(each).tolist())}
        with np.errstate(all="ignore"):
            return np.array(interpreted(program, np.ravel(outputs).tolist(), inputs)).reshape(
                np.shape(outputs)
            )

    return program, nodes, outputs, values


def gradients(program, outputs, cotangents, inputs):
    """Return the nodes of the cotangents of inputs: of scalars, plus those of arrays of them in memory."""
    arrays = {k: array for k, each in enumerate(inputs) if (array := program.known_inputs(each)) is not None}
    scalars = np.concatenate([each.ravel() for each in inputs])
    found = program.gradient(outputs, program.constants(cotangents), [*scalars, *arrays.values()])
    sizes = np.cumsum([each.size for each in inputs])
    parts = np.split(np.array(found[: len(scalars)], dtype=np.int64), sizes)[:-1]
    for k, node in zip(arrays, found[len(scalars) :], strict=True):
        entries = program.entries(node, inputs[k].shape).ravel()
        parts[k] = [program.apply("add", int(a), int(b)) for a, b in zip(parts[k], entries, strict=True)]
    return [np.reshape(part, each.shape) for part, each in zip(parts, inputs, strict=True)]


def check(function, *arguments, tolerance=1e-12):
    """Compare values and Jacobians by all (float) arguments with JAX."""
    arguments = [np.asarray(each) for each in arguments]
    program, nodes, outputs, values = evaluated(function, *arguments)
    flat = [node for array in outputs for node in array.ravel().tolist()]
    moving = [k for k, each in enumerate(arguments) if each.dtype == float]

    @jax.jit
    def by_jax(*arguments):
        return function(*arguments), [jax.jacfwd(function, k)(*arguments) for k in moving]

    expected, slopes = by_jax(*arguments)
    expected = np.concatenate([np.ravel(np.asarray(each, dtype=float)) for each in jax.tree.leaves(expected)])
    np.testing.assert_allclose(values(flat, *arguments), expected, rtol=tolerance, atol=tolerance)
    for k, own in zip(moving, slopes, strict=True):
        found = values(program.jacobian(flat, nodes[k].ravel()), *arguments)
        exact = np.concatenate([np.reshape(part, (-1, arguments[k].size)) for part in jax.tree.leaves(own)])
        np.testing.assert_allclose(found, exact, rtol=tolerance, atol=tolerance)
        cotangents = np.random.default_rng(k).normal(size=len(flat))
        [pulled] = gradients(program, flat, cotangents, [nodes[k]])
        found = values(pulled, *arguments)
        size = np.max(np.abs(cotangents) @ np.abs(exact), initial=1.0)
        np.testing.assert_allclose(found.ravel(), cotangents @ exact, atol=tolerance * size)
    return program


# the equations of systems

STRING = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=21)


def with_friction():
    from knode_cosserat.rods.tendons import TendonFriction

    return kc.robots.RoutedTendonRobot.like(PAPER, friction=TendonFriction(wobble=0.6, curvature=0.1))


def with_reel():
    length, radius = 0.7144, 0.675e-3
    return kc.robots.RoutedTendonRobot(
        length=length,
        radius=radius,
        density=0.034 / (length * np.pi * radius**2),
        youngs_modulus=207e9,
        bending_damping=5e-4,
        drag=1e-4,
        gravity=(9.81, 0.0, 0.0),
        tendon_offset=0.01506,
        tendon_angles=(np.pi / 2,),
        tendon_compliance=1e-4,
        drive="reel",
        nodes=200,
    )


def with_curved_law():
    rng = np.random.default_rng(5)
    layout = kc.robots.Layout(*((name, 3, "", name) for name in ("v", "u", "v_t", "u_t")))
    plain = expansion(layout, rng.normal(size=(50, 12)), {"u": CURVED}, 6)
    law = dataclasses.replace(plain, weights=1e-5 * rng.normal(size=np.shape(plain.weights)))
    return KNODE(PAPER, Structured(np.array(0.02), law, None, None))


def with_terms():
    rng = np.random.default_rng(0)
    empty = terms(PAPER, rng.uniform(1.0, 5.0, (8, 4)))
    numbers = {name: 0.1 * rng.normal(size=np.shape(part)) for name, part in empty.coefficients().items()}
    return KNODE(PAPER, empty.with_coefficients(numbers).clamped())


SYSTEMS = {name: functools.partial(kc.load_robot, name) for name in kc.catalog()} | {
    "HangingString": lambda: STRING,
    "virtual robot": virtual_robot,
    "friction": with_friction,
    "reel and slack": with_reel,
    "curved law": with_curved_law,
    "terms": with_terms,
    "network": lambda: with_network(3),
    "large network": lambda: with_network(64, history=True),
    "committee": with_committee,
}


def point_of(system, rng):
    """Return random arguments of the equations: parameters, c0, t, control, s, y, record, unknowns."""
    strand = strand_of(system)
    ny, nz = strand.y_layout.size, strand.z_layout.size
    y, record = 0.1 * rng.normal(size=ny), 0.1 * rng.normal(size=ny + nz + (ny if strand.mixed else 0))
    for name in {"h", "n"} & set(strand.y_layout.names):
        y[strand.y_layout.slice(name)] += [1.0, 0.0, 0.0, 0.0] if name == "h" else 0.5
    leaves = [np.asarray(leaf, dtype=float) for leaf in jax.tree.leaves(system)]
    control, s = rng.uniform(4.0, 8.0, system.control_layout.size), 0.3 * np.max(system.length)
    unknowns = rng.normal(size=unknown_count(system))
    return leaves, np.array([30.0, 0.2]), control, np.array(s), y, record, unknowns


@pytest.mark.parametrize("name", SYSTEMS)
def test_equations_agree_with_jax(name):
    system, rng = SYSTEMS[name](), np.random.default_rng(1)
    tree = jax.tree.structure(system)
    leaves, *rest = point_of(system, rng)
    count = len(leaves)

    def equations(*arguments):
        parameters, (times, control, s, y, record, unknowns) = arguments[:count], arguments[count:]
        own = jax.tree.unflatten(tree, list(parameters))
        problem = StepProblem(own, times[1], control, times[0], record[None], LOBATTO2)
        f, z = problem.point_rates(s, y, record)
        whole = jnp.concatenate([record] * strand_count(system))[None]
        ends = dataclasses.replace(problem, history=jnp.zeros((1, whole.shape[1])))
        base = ends.base(unknowns)
        y_tip = jnp.concatenate([y] * strand_count(system))
        tip = system.tip(times[1], control, y_tip, times[0] * y_tip)
        return f, z, base, tip

    arguments = [*leaves, *rest]
    moving = [k for k in range(len(arguments)) if k not in (count, count + 2)]
    sizes = [np.abs(each) if k < count else 1.0 for k, each in enumerate(arguments)]
    directions = [0.1 * sizes[k] * rng.normal(size=arguments[k].shape) for k in moving]

    @jax.jit
    def by_jax(arguments, directions):
        def along(*moved):
            values = list(arguments)
            for k, each in zip(moving, moved, strict=True):
                values[k] = each
            return equations(*values)

        own = [arguments[k] for k in moving]
        return jax.vmap(lambda *each: jax.jvp(along, own, list(each)), out_axes=(None, 0))(*directions)

    # two directions: of all arguments, and of y alone
    of_y = moving.index(count + 3)
    both = [np.stack([each, each if k == of_y else 0.0 * each]) for k, each in enumerate(directions)]
    exact, products = by_jax(list(map(jnp.asarray, arguments)), list(map(jnp.asarray, both)))

    program, nodes, outputs, values = evaluated(equations, *arguments)
    tangents = [program.inputs(f"x{len(arguments) + k}", each.shape, 1) for k, each in enumerate(directions)]
    seeds = {
        int(a): int(b)
        for k, own in zip(moving, tangents, strict=True)
        for a, b in zip(nodes[k].ravel(), own.ravel(), strict=True)
    }
    moved = np.concatenate([each.ravel() for each in directions])
    for output, value, along in zip(outputs, exact, products, strict=True):
        product = program.derivative(output.tolist(), seeds)
        cotangents = rng.normal(size=output.size)
        pulled = gradients(program, output.tolist(), cotangents, [nodes[k] for k in moving])
        terms = values(np.concatenate([each.ravel() for each in pulled]), *arguments) * moved
        total, size = cotangents @ along[0], np.sum(np.abs(terms)) + np.sum(np.abs(cotangents * along[0]))
        assert abs(np.sum(terms) - total) <= 1e-12 * size
        slopes = values(program.jacobian(output.tolist(), nodes[count + 3].tolist()), *arguments)
        found = values([*output, *product], *arguments, *directions)
        for own, expected in zip(
            [*np.split(found, 2), slopes @ directions[of_y]], [value, *along], strict=True
        ):
            assert np.max(np.abs(own - expected)) < 1e-12 * np.max(np.abs(expected), initial=1e-300)


# operations


def test_simplification():
    program = Program()
    x, y, zero, one = (*program.inputs("x", (2,), 1).tolist(), program.constant(0.0), program.constant(1.0))
    apply = program.apply
    p = apply("lt", x, y)
    for a, b in [
        (apply("add", x, zero), x),
        (apply("sub", x, zero), x),
        (apply("mul", x, one), x),
        (apply("mul", x, zero), zero),
        (apply("sub", x, x), zero),
        (apply("neg", apply("neg", x)), x),
        (apply("div", zero, x), zero),
        (apply("select", p, x, x), x),
        (apply("not", apply("not", p)), p),
        (apply("and", p, program.constant(True)), p),
        (apply("or", p, program.constant(False)), p),
        (apply("add", x, y), apply("add", y, x)),
        (apply("sub", x, apply("neg", y)), apply("add", x, y)),
        (apply("select", apply("not", p), x, y), apply("select", p, y, x)),
        (apply("add", program.constant(2.0), program.constant(3)), program.constant(5.0)),
        (apply("pow", x, program.constant(2.0)), apply("mul", x, x)),
        (apply("eq", apply("select", p, zero, one), one), p),
        (apply("neg", apply("sub", x, y)), apply("neg", apply("sub", x, y))),
    ]:
        assert a == b
    # x != x tests for NaN
    assert program.operations[apply("ne", x, x)][0] == "ne"
    assert program.levels[apply("add", x, one)] == 1 and program.levels[one] == 0
    assert program.is_constant(one, 1.0) and not program.is_constant(program.constant(True), 1.0)


def test_known_nodes_end_the_search():
    program, _, (out,), _ = evaluated(lambda x: jnp.sin(x * x) + 1.0, 0.5)
    product = program.arguments(program.arguments(int(out))[0])[0]
    assert {program.operations[node][0] for node in program.needed([int(out)], {product})} == {
        "mul",
        "sin",
        "constant",
        "add",
    }


@pytest.mark.parametrize(
    "matrix",
    [
        np.array([[0.0, 2.0, 1.0], [1.0, 1.0, 0.0], [3.0, 0.0, 1.0]]),
        np.array([[1e-20, 1.0], [1.0, 1.0]]),
        np.random.default_rng(0).normal(size=(6, 6)),
        np.random.default_rng(0).normal(size=(8, 8)) + 8.0 * np.eye(8),
    ],
)
def test_linear_systems_are_solved_with_pivoting(matrix):
    right = np.arange(1.0, len(matrix) + 1.0)
    check(jnp.linalg.solve, matrix, right)
    check(jnp.linalg.inv, matrix)
    check(jnp.linalg.slogdet, matrix)


def test_triangular_systems_need_no_exchanges():
    program, *_ = evaluated(lambda A, b: jnp.linalg.solve(jnp.tril(A), b), np.eye(3), np.ones(3))
    assert not any(name == "select" for name, *_ in program.operations)


def test_factorisations():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(2, 3, 3))
    check(lambda A: jnp.linalg.cholesky(A @ jnp.swapaxes(A, 1, 2) + jnp.eye(3)), A)
    B = rng.normal(size=(3, 2))
    for lower in (False, True):
        for options in ({}, {"trans": 1}, {"unit_diagonal": True}):
            solve = functools.partial(jax.scipy.linalg.solve_triangular, lower=lower, **options)
            check(solve, A[0] + 3.0 * np.eye(3), B)
    triangle = A[0] + 3.0 * np.eye(3)
    check(lambda A, B: jax.lax.linalg.triangular_solve(A, B, lower=True), triangle, B.T)


@jax.custom_jvp
def backwards(x):
    return x


backwards.defjvp(lambda primals, tangents: (primals[0], -tangents[0]))


@jax.custom_jvp
def root(x):
    """Return √x by Newton's method: a loop that is not differentiated."""

    def going(state):
        return jnp.abs(state[0] ** 2 - x) > 1e-14 * x

    return jax.lax.while_loop(going, lambda state: (0.5 * (state[0] + x / state[0]), state[1] + 1), (x, 0))[0]


@root.defjvp
def _root_tangent(primals, tangents):
    found = root(*primals)
    return found, jnp.linalg.solve(2.0 * found * jnp.eye(1), jnp.reshape(tangents[0], 1))[0]


def test_custom_rules():
    check(lambda x: backwards(x) + x * x, 0.7)
    check(lambda x, y: root(x * y) * root(y), 2.0, 3.0)
    check(jax.grad(lambda x: root(x) ** 3), 2.0)
    check(lambda x: jax.lax.stop_gradient(x) * x, 0.7)
    # the loop of a rule is shared with that of the function
    assert len(check(root, 2.0).loops) == 1
    # second derivatives
    program, ((x,),), (out,), values = evaluated(lambda x: root(x[0]), np.array([2.0]))
    slope = program.jacobian([int(out)], [x])[0]
    (curvature,) = program.jacobian(slope, [x])[0]
    assert values(curvature, [2.0]) == pytest.approx(-0.25 * 2.0**-1.5, rel=1e-12)


def test_loops_are_not_differentiated():
    def double(x):
        return jax.lax.while_loop(lambda x: x < 100.0, lambda x: 2.0 * x, x)

    program, (x,), (out,), values = evaluated(double, 3.0)
    assert values(out, 3.0) == 192.0
    with pytest.raises(EngineError, match=r"test_program.py:\d+: a while loop is differentiated"):
        program.jacobian([int(out)], [int(x)])
    [loop] = program.loops.values()
    assert loop.kinds == ["f"]


def test_indices_and_shapes():
    x, rng = np.array([3.0, 1.0, 4.0, 1.5]), np.random.default_rng(3)
    table = rng.normal(size=(4, 2))
    check(lambda x: x[jnp.argmin(x)] + x[jnp.argmax(x)], x)
    check(lambda x, t: t[jnp.argmin(x)], x, table)
    check(lambda x, i: x[i], x, 2)
    check(lambda x, i: x[i], x, -1)
    check(lambda x, i: x[i], x, np.array([3, 0, 7]))
    check(lambda x, i: x.at[i].get(mode="clip"), x, np.array([3, 0, 7]))
    check(lambda x, i: x.at[i].set(2.0 * x[0]).at[1].add(x[2]).at[i - 1].multiply(3.0), x, 2)
    check(lambda x, i: x.at[jnp.array([0, 2, i])].add(x[:3], mode="drop"), x, 9)
    check(lambda t, i: jax.lax.dynamic_slice(t, (i, 0), (2, 2)), table, 1)
    check(lambda t, i: jax.lax.dynamic_update_slice(t, t[:1] * 2.0, (i, 0)), table, 3)
    check(lambda x: jnp.pad(x, 1).at[jnp.array([0, 2])].set(7.0)[::-1], x)
    check(lambda x: jax.lax.pad(x, 2.0, [(-1, 2, 1)]), x)
    check(lambda x: (jnp.cumsum(x), jnp.cumprod(x[::-1]), jnp.sort(x), jnp.split(x, 2), jnp.roll(x, 1)), x)
    check(
        lambda x: (jnp.diag(x), jnp.trace(jnp.outer(x, x)), jnp.linalg.norm(x), jnp.prod(x), jnp.tile(x, 2)),
        x,
    )
    check(lambda t: (t.T @ t, jnp.einsum("ij,kj->ik", t, t), jnp.max(t, axis=0), jnp.min(t)), table)
    check(lambda x, i: jax.lax.switch(i, [jnp.sin, jnp.cos, jnp.exp], x), x, 1)
    check(lambda x: jax.lax.cond(x[0] > 2.0, jnp.sin, jnp.cos, x), x)
    check(lambda x: jax.lax.scan(lambda c, y: (c * y, c + y), 1.0, x, reverse=True), x)
    check(lambda x: jax.lax.fori_loop(0, 3, lambda k, y: y * x[k], 1.0), x)
    check(lambda x: jax.lax.associative_scan(jnp.add, x), x)
    check(lambda x: jnp.interp(x, jnp.arange(5.0), jnp.arange(5.0) ** 2), x)
    check(lambda x, i: (i // 2 + x, i % 3 * x, jnp.where(i > 1, x, 0.0), x.astype(int) * x), x, 5)
    check(lambda x, p, q: jnp.where(p ^ q, x, jnp.where(p == q, 2.0 * x, 0.0)), x, True, True)


def test_scalar_functions():
    x = np.array([-1.7, -0.5, 0.0, 0.5, 2.5])
    check(lambda x: [f(x) for f in (jnp.abs, jnp.sign, jnp.floor, jnp.ceil, jnp.round)], x)
    check(lambda x: [f(x) for f in (jnp.sinh, jnp.cosh, jnp.arcsinh, jnp.cbrt, jnp.exp2)], x[[0, 1, 3, 4]])
    check(lambda x: [f(x) for f in (jax.scipy.special.erf, jax.nn.sigmoid, jnp.tan, jnp.arctan)], x)
    check(lambda x: [f(0.3 * x) for f in (jnp.arcsin, jnp.arccos, jnp.arctanh, jnp.log1p, jnp.expm1)], x)
    check(
        lambda x: (jnp.arccosh(x), jnp.log(x), x**2.5, 2.0**x, x**-3, x**0.5, jax.lax.rsqrt(x)), x[4:] + 1.0
    )
    check(lambda x: (jnp.clip(x, -0.5, 0.5), jax.lax.clamp(-0.5, x, 0.5), jnp.maximum(x, 0.0)), x)
    check(
        lambda x: (jnp.arctan2(x, x + 2.0), jnp.fmod(x, 0.7), jnp.hypot(x, x + 1.0), jnp.logaddexp(x, 1.0)), x
    )


def test_missing_numbers():
    def seen(x):
        return jnp.isnan(x), jnp.nan_to_num(x), jnp.max(x), jnp.min(x), jnp.argmin(x), jnp.argmax(x)

    x = np.array([1.0, np.nan, 0.0])
    _, _, outputs, values = evaluated(seen, x)
    for output, expected in zip(outputs, seen(x), strict=True):
        np.testing.assert_array_equal(values(output, x), expected)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda x: jnp.linalg.eigvalsh(jnp.outer(x, x)),
            "eigh is not covered by the engine; use a closed form",
        ),
        (lambda x: jnp.fft.fft(x).real, "fft is not covered by the engine; write it with other functions"),
        (lambda x: x.astype(int) & 1, "and of integers is not covered"),
    ],
)
def test_one_line_names_what_is_not_covered(function, message):
    with pytest.raises(EngineError, match=rf"test_program.py:\d+: {re.escape(message)}") as caught:
        evaluated(function, np.arange(50.0))
    assert "\n" not in str(caught.value) and caught.value.code == "engine"


# random expressions

UNARY = [
    jnp.sin, jnp.cos, jnp.tanh, jnp.abs, jnp.negative, lambda x: jnp.exp(0.3 * x),
    lambda x: jnp.sqrt(1.0 + x * x),
    lambda x: 1.0 / (2.0 + jnp.sin(x)), jax.nn.sigmoid, lambda x: x**3, lambda x: jnp.log1p(x * x),
]  # fmt: skip
BINARY = [
    jnp.add,
    jnp.subtract,
    jnp.multiply,
    jnp.maximum,
    jnp.minimum,
    lambda x, y: x / (1.0 + y * y),
    lambda x, y: jnp.where(x < y, x, 2.0 * y),
    jnp.arctan2,
    lambda x, y: x * 0.0 + y,
    lambda x, y: -x - (-y),
]


@hypothesis.given(
    values=st.lists(
        st.floats(-2.0, 2.0).filter(lambda x: abs(x) > 1e-3), min_size=3, max_size=3, unique=True
    ),
    steps=st.lists(
        st.tuples(st.integers(0, 20), st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=8
    ),
)
@hypothesis.settings(max_examples=12, deadline=None, derandomize=True)
def test_random_expressions(values, steps):
    def expression(x):
        known = [*x, 1.0, 0.5]
        for which, a, b in steps:
            a, b = known[a % len(known)], known[b % len(known)]
            both = which >= len(UNARY)
            known.append(BINARY[which - len(UNARY)](a, b) if both else UNARY[which](a))
        return jnp.stack([jnp.asarray(each) for each in known[5:]])

    # ties of max and min, and poles of atan2, have no derivative
    with np.errstate(all="ignore"):
        hypothesis.assume(np.all(np.isfinite(jax.jacfwd(expression)(jnp.array(values)))))
    check(expression, np.array(values), tolerance=1e-9)


#: functions of what users' laws have: scalars, vectors and matrices; each takes one or two of the kinds named
OF_SHAPES = [
    ("v v", jnp.dot), ("v v", jnp.vdot), ("v v", jnp.inner), ("v v", jnp.outer), ("v v", jnp.cross),
    ("v v", lambda x, y: jnp.einsum("i,i->", x, y)), ("v v", lambda x, y: jnp.tensordot(x, y, 1)),
    ("v v", lambda x, y: jnp.where(jnp.vdot(x, y) > 0.0, x, y)),
    ("v v", lambda x, y: jnp.stack([x, y, x - y])), ("v v", jnp.subtract), ("s s", jnp.multiply),
    ("v v", lambda x, y: jnp.concatenate([x[:1], y[1:]])), ("v v", jnp.kron),
    ("m v", jnp.matmul), ("v m", jnp.matmul), ("m v", lambda A, x: jnp.linalg.solve(4.0 * jnp.eye(3) + A, x)),
    ("m v", lambda A, x: jnp.einsum("i,ij,j", x, A, x)), ("m v", lambda A, x: A.at[1].add(x)),
    ("m m", jnp.matmul), ("m m", lambda A, B: jnp.einsum("ij,ij->", A, B)), ("m m", jnp.vdot),
    ("m m", lambda A, B: jnp.einsum("ij,kj->ik", A, B)), ("m m", lambda A, B: jnp.tensordot(A, B, 2)),
    ("v", lambda x: jnp.sqrt(jnp.sum(x**2) + 1.0)), ("v", lambda x: jnp.linalg.norm(x + 3.0)),
    ("v", jnp.sum), ("v", jnp.mean), ("v", jnp.prod), ("v", jnp.max), ("v", jnp.cumsum), ("v", jnp.flip),
    ("v", lambda x: jnp.roll(x, 1)), ("v", lambda x: jnp.clip(x, -0.9, 1.1)), ("v", jnp.diag),
    ("v", lambda x: jnp.interp(x[0], jnp.array([-1.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 1.5]))),
    ("v", lambda x: jnp.linalg.inv(jnp.eye(3) + jnp.outer(x, x))), ("v", lambda x: x[::-1] * x[0]),
    ("m", jnp.trace), ("m", jnp.diagonal), ("m", lambda A: A.T), ("m", jnp.linalg.det), ("m", jnp.var),
    ("m", lambda A: jnp.sum(A, axis=0)), ("m", lambda A: jnp.min(A, axis=1)), ("m", lambda A: A[:, 1]),
    ("m", lambda A: jnp.linalg.norm(A + 3.0)), ("m", lambda A: jnp.ravel(A)[2:5]), ("s", jnp.square),
    ("s s", jnp.add), ("s v", jnp.multiply), ("s m", jnp.multiply),
    ("m m", jnp.add), ("s", lambda a: a * jnp.ones(3)), ("s", lambda a: jnp.tanh(a) * jnp.eye(3)),
]  # fmt: skip


def check_shapes(steps, values, is_batch):
    """Compare functions `OF_SHAPES`, of what is known or found before by its number, with JAX."""

    def expression(x):
        known = {"s": [x[0]], "v": [x[:3], x[3:]], "m": [jnp.outer(x[3:], x[:3]) + 0.5 * jnp.eye(3)]}
        found = []
        for (kinds, function), *which in steps:
            own = [known[kind] for kind in kinds.split()]
            made = function(*(values[k % len(values)] for values, k in zip(own, which, strict=False)))
            found.append(jnp.ravel(made))
            kind = {(): "s", (3,): "v", (3, 3): "m"}.get(made.shape)
            if kind:
                known[kind].append(made)
        return jnp.concatenate(found)

    x, function = np.array(values), expression
    if is_batch:
        x, function = np.stack([x, 0.7 * x[::-1]]), jax.vmap(expression)
    with np.errstate(all="ignore"):
        exact = jax.jit(jax.jacfwd(function))(jnp.array(x))
    if not np.all(np.abs(exact) < 1e4):
        hypothesis.reject()
    check(function, x, tolerance=1e-9)


@pytest.mark.parametrize("is_batch", [False, True])
def test_functions_of_vectors_and_matrices(is_batch):
    """Each by itself, in value and derivative, and as JAX batches them."""
    check_shapes([(form, 0, 1) for form in OF_SHAPES], [0.3, -0.7, 0.45, 0.9, 0.2, -0.55], is_batch)


@hypothesis.given(
    values=st.lists(
        st.floats(-1.0, 1.0).filter(lambda x: abs(x) > 1e-2), min_size=6, max_size=6, unique=True
    ),
    steps=st.lists(
        st.tuples(st.sampled_from(OF_SHAPES), st.integers(0, 9), st.integers(0, 9)), min_size=3, max_size=8
    ),
    is_batch=st.booleans(),
)
@hypothesis.settings(max_examples=8, deadline=None, derandomize=True)
def test_random_expressions_of_vectors_and_matrices(values, steps, is_batch):
    check_shapes(steps, values, is_batch)
