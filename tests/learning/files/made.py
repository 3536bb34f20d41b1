"""Models to be saved, of every kind, and what tests of their files have in common."""

import dataclasses
import re
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from examples.hanging_string import HangingString
from knode_cosserat.learning.knode import KNODE, About, ModelFileError
from knode_cosserat.learning.residual import Network, Residual, input_layout
from knode_cosserat.learning.structured.residual import (
    CURVED,
    Load,
    Structured,
    expansion,
    loaded,
)
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.system import unknown_count

# few nodes and tensions that no other test has: what is compiled here was not compiled before
ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=5, youngs_modulus=10e9 / 3)
#: knowledge that no robot file can name
STRING = HangingString(length=1.0, density=0.1, stiffness=1e3, nodes=5)
TENSIONS = kc.controls.sine(1.0, 6, 0.05)


def fails(*parts, error=ModelFileError):
    """One line that has all the parts, in order."""
    return pytest.raises(error, match=r"^(?!.*\n).*" + ".*".join(map(re.escape, parts)))


def network(knowledge=ROBOT, hidden=3, seed=0, number=np.asarray):
    rng = np.random.default_rng(seed)
    inputs, outputs = input_layout(knowledge, False).size, knowledge.y_layout.size + knowledge.z_layout.size
    shapes = ((hidden, inputs), (hidden,), (outputs, hidden), (outputs,), (inputs,))
    arrays = [number(1e-2 * rng.normal(size=shape)) for shape in shapes]
    return Network(*arrays, number(np.ones(inputs)), number(np.full(outputs, 1e-2)))


def structured(knowledge=ROBOT, seed=0):
    rng = np.random.default_rng(seed)
    y, z = knowledge.y_layout, knowledge.z_layout
    rates = kc.robots.Layout(*((f"{field.name}_t", field.size, "", "rate") for field in z.fields))

    def law(layout, outputs, **forms):
        found = expansion(layout, rng.normal(size=(9, layout.size)), forms, outputs)
        return dataclasses.replace(found, weights=1e-4 * rng.normal(size=found.weights.shape))

    balanced = loaded(knowledge).size
    load = Load(
        law(Observed.of(knowledge).layout, balanced), law(Observed.of(knowledge).ambient_layout, balanced)
    )
    tip = Load(None, law(Observed.of(knowledge).ambient_layout, unknown_count(knowledge)))
    assert y.size > balanced
    return Structured(np.asarray(0.01 * seed), law(z + rates, z.size, u=CURVED), load, tip)


class Odd(NamedTuple):
    """What a residual may hold beside arrays."""

    name: str
    power: int = 2


class Bag(eqx.Module):
    """Leaves of many kinds."""

    leaves: Any
    label: Any = eqx.field(static=True, default="none")


class Pull(Residual):
    """A user's residual: a constant force, and much that does nothing."""

    force: Any
    bag: Bag | None
    options: Any = eqx.field(static=True)

    def __init__(self, force):
        rng = np.random.default_rng(1)
        self.force = np.full(3, force)
        self.bag = Bag(
            {
                "a": [np.float32([1.5, np.nan]), np.zeros((0, 3)), 2.0, 7],
                "$b": (rng.normal(size=(2, 3, 4)).transpose(2, 0, 1), np.arange(3, dtype=np.int8)),
                "c": np.array([True, False]),
                "d": np.array([-0.0, np.inf, 5e-324]),
                "e": np.float64(0.1),
            }
        )
        self.options = (Odd("x"), (1.5, None, True), "text")

    def balance(self, knowledge, s, t, y, y_t, z, z_t, control):
        y_s = knowledge.balance(s, t, y, y_t, z, z_t, control)
        return y_s.at[knowledge.y_layout.slice("n")].add(self.force)


def models():
    nothing = Structured(np.asarray(-0.0), None, None, None)
    return {
        "network": KNODE(ROBOT, network()),
        "structured": KNODE(ROBOT, structured(seed=1)),
        "nothing": KNODE(ROBOT, nothing),
        "single precision": KNODE(ROBOT, network(number=np.float32)),
        "jax arrays": KNODE(ROBOT, network(number=jnp.asarray)),
        "a model of a model": KNODE(KNODE(ROBOT, network()), network(seed=1), About({"second": True})),
        "a user's": KNODE(ROBOT, Pull(0.1)),
    }


MODELS = models()
YOURS = [Pull, Bag, Odd]


def assert_same(a, b):
    """Of one structure and equal to the last bit, the sign of zeros and the payload of NaN included."""
    assert type(a) is type(b)
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if isinstance(one, np.ndarray | np.generic | jax.Array):
            one, other = np.asarray(one), np.asarray(other)
            assert (one.dtype, one.shape) == (other.dtype, other.shape)
            assert one.tobytes() == other.tobytes()
        else:
            assert type(one) is type(other) and one == other
