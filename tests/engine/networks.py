"""Models of the paper's robot with large networks."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np

import knode_cosserat as kc
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual, network

PAPER = kc.load_robot("delrin-tendon-robot")


def with_network(hidden, history=False):
    """Return a model with one hidden layer, as in the paper."""
    options = kc.learning.NetworkOptions(hidden=hidden, convex=False, history=history)
    net = network(PAPER, options, jax.random.key(0), c0=30.0)
    return KNODE(PAPER, dataclasses.replace(net, output_scale=np.full(25, 1e-3)))


class Committee(Residual):
    """Mean of several networks of y and the place, with two hidden layers each."""

    #: weights (networks, units, inputs) and biases (networks, units) of each layer
    layers: list[tuple[jax.Array, jax.Array]]
    scale: jax.Array

    def correction(self, knowledge, s, t, y, y_t, z, z_t, control):
        def outputs(layers):
            (first, a), (second, b), (third, c) = layers
            hidden = jax.nn.silu(first @ jnp.append(y, s) + a)
            return jnp.tanh(third @ jax.nn.softplus(second @ hidden + b) + c)

        added = self.scale * jnp.mean(jax.vmap(outputs)(self.layers), axis=0)
        return jnp.concatenate([added, jnp.zeros_like(z)])


def with_committee():
    """Return a model with the mean of three networks, with layers of 40 and 48 units."""
    rng, ny = np.random.default_rng(1), PAPER.y_layout.size
    sizes = (ny + 1, 40, 48, ny)
    layers = [
        (rng.normal(size=(3, after, before)) / np.sqrt(before), rng.normal(size=(3, after)))
        for before, after in itertools.pairwise(sizes)
    ]
    return KNODE(PAPER, Committee(layers, np.array(1e-3)))
