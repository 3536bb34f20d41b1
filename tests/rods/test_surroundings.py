"""What rods touch: distances from points, the force's slope, and energy that friction only takes."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from knode_cosserat.robots import loads, surroundings

vectors = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, directions)
def test_the_distance_from_a_plane(p, point, normal):
    away, along = normal / np.linalg.norm(normal), np.linalg.svd(normal[None])[2][1]
    distance, out = surroundings.Plane(point=point, normal=normal).distance(p)
    foot = p - float(distance) * np.asarray(out)
    np.testing.assert_allclose(out, away, atol=1e-12)
    assert np.dot(foot - point, normal) == pytest.approx(0.0, abs=1e-9)
    # of any length, and through any of its points
    same = surroundings.Plane(point=point + along, normal=7.0 * normal).distance(p)[0]
    assert float(same) == pytest.approx(float(distance), abs=1e-9)


@pytest.mark.parametrize("length", [2e-9, 1e-5, 1e3])
def test_a_direction_is_of_any_length(length):
    normal = length * np.array([0.6, 0.0, 0.8])
    distance, out = surroundings.Plane(normal=normal).distance(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(out, [0.6, 0.0, 0.8], rtol=1e-15)
    assert float(distance) == pytest.approx(0.8, rel=1e-15)
    assert float(surroundings.Cylinder(axis=normal).distance(np.array([0.0, 0.0, 1.0]))[0]) == pytest.approx(
        0.5
    )


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, st.floats(0.05, 1.5), st.booleans())
def test_the_distance_from_a_sphere(p, center, radius, inside):
    length = np.linalg.norm(p - center)
    if length < 1e-3:
        return
    distance, out = surroundings.Sphere(center=center, radius=radius, inside=inside).distance(p)
    sign = -1.0 if inside else 1.0
    assert float(distance) == pytest.approx(sign * (length - radius), abs=1e-9)
    # on the surface, along the normal
    foot = p - float(distance) * np.asarray(out)
    assert np.linalg.norm(foot - center) == pytest.approx(radius, rel=1e-9)
    np.testing.assert_allclose(out, sign * (p - center) / length, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, directions, st.floats(0.05, 1.5), st.booleans(), st.floats(-3.0, 3.0))
def test_the_distance_from_a_cylinder(p, point, axis, radius, inside, shift):
    unit = axis / np.linalg.norm(axis)
    to_axis = np.linalg.norm(np.cross(p - point, unit))
    if to_axis < 1e-3:
        return
    pipe = surroundings.Cylinder(point=point, axis=axis, radius=radius, inside=inside)
    distance, out = pipe.distance(p)
    sign = -1.0 if inside else 1.0
    assert float(distance) == pytest.approx(sign * (to_axis - radius), abs=1e-9)
    assert np.dot(out, unit) == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.norm(out) == pytest.approx(1.0, rel=1e-9)
    assert float(pipe.distance(p + shift * unit)[0]) == pytest.approx(float(distance), abs=1e-9)


MOVING = loads.Motion(
    *map(
        jnp.asarray,
        ([0.05, 0.02, 0.1035], np.eye(3), [0.02, -0.01, -0.03], [0.3, 0.1, 0.2], np.zeros(3), np.zeros(3)),
    )
)
OBSTACLES = [
    each(stiffness=1e4, smoothing=1e-3, damping=2.0, friction=0.4, slip=1e-2, **where)
    for each, where in (
        (surroundings.Plane, {"point": [0.0, 0.0, 0.1]}),
        (surroundings.Sphere, {"radius": 0.115}),
        (surroundings.Sphere, {"radius": 0.118, "inside": True}),
        (surroundings.Cylinder, {"radius": 0.102}),
    )
]


@pytest.mark.parametrize(
    "obstacle", OBSTACLES, ids=lambda each: each.kind + "-in" * getattr(each, "inside", 0)
)
@pytest.mark.parametrize("depth", [-0.004, 0.0, 0.004])
def test_the_force_of_contact_is_smooth(obstacle, depth):
    """Its slope in place, velocity and spin, in front of the surface, on it and beneath."""
    _, out = obstacle.distance(MOVING.p)
    distance, _ = obstacle.distance(MOVING.p)
    start = jnp.concatenate([MOVING.p - (distance - 0.005 + depth) * out, MOVING.q, MOVING.w])

    def wrench(x):
        motion = MOVING._replace(p=x[:3], q=x[3:6], w=x[6:])
        return jnp.concatenate(obstacle.wrench(motion, 0.005))

    slope = np.asarray(jax.jacfwd(wrench)(start))
    assert np.abs(wrench(start)[:3]).max() > 1e-3
    for k, h in enumerate(np.repeat([1e-5, 1e-5, 1e-5], 3)):
        values = [np.asarray(wrench(start.at[k].add(j * h))) for j in (-2, -1, 1, 2)]
        expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
        np.testing.assert_allclose(slope[:, k], expected, rtol=1e-5, atol=1e-5 * np.abs(slope).max())


def test_the_force_is_a_spring_and_friction_is_coulombs():
    plane = surroundings.Plane(stiffness=1e4, smoothing=1e-5, friction=0.5, slip=1e-4)
    still = MOVING._replace(p=jnp.array([0.0, 0.0, 0.004]), q=jnp.zeros(3), w=jnp.zeros(3))
    force, _ = plane.wrench(still, 0.005)
    np.testing.assert_allclose(force, [0.0, 0.0, 10.0], rtol=1e-9)
    sliding = still._replace(q=jnp.array([0.3, -0.4, 0.0]))
    force, moment = plane.wrench(sliding, 0.005)
    np.testing.assert_allclose(force, [-3.0, 4.0, 10.0], rtol=1e-6)
    np.testing.assert_allclose(moment, np.cross([0.0, 0.0, -0.005], force), rtol=1e-9)
    # a rod that rolls does not slide
    rolling = sliding._replace(w=jnp.array([0.4 / 0.005, 0.3 / 0.005, 0.0]))
    np.testing.assert_allclose(plane.wrench(rolling, 0.005)[0], [0.0, 0.0, 10.0], atol=1e-9)
    away = still._replace(p=jnp.array([0.0, 0.0, 0.006]))
    np.testing.assert_allclose(plane.wrench(away, 0.005)[0], 0.0, atol=1e-12)


def test_what_comes_faster_is_pushed_harder_and_what_leaves_is_not_held():
    plane = surroundings.Plane(stiffness=1e4, smoothing=1e-5, damping=2.0)
    at = MOVING._replace(p=jnp.array([0.0, 0.0, 0.004]), w=jnp.zeros(3))
    force = [
        float(plane.wrench(at._replace(q=jnp.array([0.0, 0.0, v])), 0.005)[0][2]) for v in (-0.1, 0.1, 2.0)
    ]
    np.testing.assert_allclose(force, [12.0, 8.0, 0.0], atol=1e-9)
