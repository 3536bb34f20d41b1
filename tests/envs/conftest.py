"""An environment of a small robot, whose programs the tests share."""

import pytest

pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'knode-cosserat[rl]'")

#: periods of an episode
STEPS = 12


@pytest.fixture(scope="session")
def robot():
    # JAX must not be imported before the tests' settings
    import knode_cosserat as kc

    return kc.load_robot("delrin-tendon-robot").replace(nodes=6)


@pytest.fixture(scope="session")
def environment(robot):
    """Everything at once: parameters that change within episodes, delayed commands, noisy measurements."""
    from knode_cosserat import envs

    randomisation = envs.Randomisation(
        {"youngs_modulus": envs.Factor(0.7, 1.3), "drag": envs.Factor(0.5, 2.0)},
        change=0.5,
        delay=(0, 2),
        noise=1e-4,
    )
    return envs.make("follow", robot, randomisation=randomisation, duration=0.05 * STEPS)


@pytest.fixture(scope="session")
def vector(environment):
    from knode_cosserat import envs

    made = envs.VectorEnv(environment, 4)
    yield made
    made.close()


@pytest.fixture
def keys():
    import jax
    import numpy as np

    return np.asarray(jax.random.split(jax.random.PRNGKey(0), 2))
