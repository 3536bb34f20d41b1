"""Study of environments and sweeps: rates, checks, and learned policies against predictive control."""

from __future__ import annotations

import importlib.util
import statistics
import tempfile
import time as clock
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.sweeps import measure_sweep
from knode_cosserat import controls
from knode_cosserat.control import Sensor, run_loop
from knode_cosserat.control.loop import _COMPILATIONS
from knode_cosserat.envs import (
    Environment,
    Factor,
    PolicyController,
    Randomisation,
    TaskError,
    animate_episode,
    controller_scores,
    make,
    policy_scores,
)
from knode_cosserat.envs.tasks import TASKS, Tip
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.figures.style import PALETTE, new_figure, width_of
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRod
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.simulate import simulate
from studies import stand_in
from studies.elastica.plant import ElasticaPlant
from studies.elastica.rod import ElasticaRod
from studies.ppo import Policy, PolicyTraining
from studies.report import (
    Report,
    check_row,
    checks_table,
    markdown_table,
    write_report,
)
from studies.runner import Job, Product, file_bytes, run

#: episodes at once, and periods, of the rate; a rate is the median of so many rounds
EPISODES, PERIODS, ROUNDS = 1024, 40, 5
#: part of the reference score that a policy must reach
ENOUGH = 0.9


def jobs(quick: bool) -> list[Job]:
    """Return the study's jobs."""
    made = [
        Job("rate", rate, {"episodes": EPISODES}),
        *(Job(f"task-{name}", task, {"task": name, "episodes": 1 if quick else 20}) for name in TASKS),
        Job("ppo", ppo, {"seconds": 120.0 if quick else 900.0, "episodes": 2 if quick else 20}),
        Job("sweep", sweep, {"rollouts": 4096 if quick else 1_000_000}),
    ]
    if not quick and stand_in.is_available():
        made.append(Job("stand-in", real, {"seconds": 300.0, "episodes": 5}))
    return made


def rerun(out: Path, quick: bool = False, **how: Any) -> Report:
    """Run the study, and write environments.json, environments.md, and what PPO has learned.

    The learned policy is written as follow.npz, with a figure of its rewards and an animation. Interrupted
    runs are continued.

    Args:
        out: the folder; an earlier run in it is continued.
        quick: shorter trainings and sweeps, and no test robot.
        how: as `runner.run` has it.

    Raises:
        TaskError: Gymnasium is missing.
    """
    if importlib.util.find_spec("gymnasium") is None:
        raise TaskError("the study needs Gymnasium: pip install '.[rl]'")
    facts = run(jobs(quick), out, **how)
    made = checks(facts)
    figures = {"ppo": curve_figure(facts["ppo"])}
    return write_report(out, "environments", made, as_markdown(made, facts), figures)


def checks(facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of the study with their limits: check, value, limit, ok."""
    found, learned, swept = facts["rate"], facts["ppo"], facts["sweep"]
    tasks = [facts[f"task-{name}"] for name in TASKS]
    least = [
        (f"steps/s of {EPISODES} episodes", found["rate"], 60_000.0),
        ("the same, relative to a batch of simulations", found["ratio"], 0.6),
        ("PPO on follow: score relative to predictive control", learned["ratio"], ENOUGH),
        ("sweep: parallel efficiency, by core time", swept["parallel_efficiency"]["cores"], 0.9),
    ]
    most = [
        ("programs compiled after the first reset", found["compiled"], 0),
        ("bits that differ between two runs of one seed", found["different"], 0),
        ("tasks that Gymnasium's check refuses", sum(bool(each["refused"]) for each in tasks), 0),
        ("PPO on follow: time until then (s)", learned["until"], 900.0),
        ("sweep: 10^6 rollouts of 20 steps (s)", swept["seconds_for_a_million"], 900.0),
        ("sweep: files that differ after five kills", int(not swept["identical"]), 0),
    ]
    made = [check_row(*each, least=True) for each in least] + [check_row(*each) for each in most]
    if "stand-in" in facts:
        # a published figure: any loss is allowed
        gap = facts["stand-in"]["gap"]
        made.append(check_row("policy on the test robot: lost part of its score", gap, 1.0))
    return made


def as_markdown(made: Sequence[Mapping[str, Any]], facts: Mapping[str, Any]) -> str:
    """Return the tables of the study."""
    scores = [[name, f"{facts[f'task-{name}']['score']:.3f}"] for name in TASKS]
    history = facts["ppo"]["curve"]
    shown = np.unique(np.linspace(0, len(history) - 1, 12).astype(int))
    curve = [
        [f"{steps:,}", f"{seconds:.0f}", f"{reward:.3f}"]
        for steps, seconds, reward in (history[k] for k in shown)
    ]
    parts = [
        "# Environments and sweeps\n",
        checks_table(made),
        "\n## Predictive control: mean reward of an episode\n",
        markdown_table(["task", "score"], scores),
        "\n## PPO on follow: mean reward with exploration\n",
        markdown_table(["steps", "seconds", "reward"], curve),
    ]
    return "\n".join(parts) + "\n"


def rate(settings: Any) -> Product:
    """Measure the rate of steps against a batch of simulations of the same motions; count compilations."""
    from knode_cosserat.envs import VectorEnv

    count = settings["episodes"]
    environment, robot = make("follow"), load_robot("delrin-tendon-robot")
    vector, random = VectorEnv(environment, count), np.random.default_rng(0)
    period, scale = random.uniform(0.8, 3.0, count), random.uniform(0.8, 1.2, count)
    tension = np.stack(
        [a * controls.sine(p, PERIODS, environment.dt) for p, a in zip(period, scale, strict=True)]
    )
    actions = 2.0 * tension / 10.0 - 1.0

    def stepped(seed: int) -> tuple[float, bytes]:
        vector.reset(seed=seed)
        began = clock.perf_counter()
        for k in range(PERIODS):
            seen = vector.step(actions[:, k])[0]
        return clock.perf_counter() - began, seen.tobytes()

    before = _COMPILATIONS.count
    first, second = stepped(1)[1], stepped(1)[1]
    compiled = _COMPILATIONS.count - before
    simulate(robot, tension, environment.dt)
    pairs = []
    for _ in range(ROUNDS):
        began = clock.perf_counter()
        simulate(robot, tension, environment.dt)
        pairs.append((stepped(1)[0], clock.perf_counter() - began))
    steps = count * PERIODS
    ours, raw = (statistics.median(each) for each in zip(*((a, b - a) for a, b in pairs), strict=True))
    different = sum((a ^ b).bit_count() for a, b in zip(first, second, strict=True))
    vector.close()
    return Product(
        {
            "rate": steps / ours,
            "raw": steps / raw,
            "ratio": raw / ours,
            "compiled": compiled,
            "different": different,
        },
        {},
    )


def task(settings: Any) -> Product:
    """Check a task by Gymnasium's checker, and score the predictive controller."""
    from gymnasium.utils.env_checker import check_env

    from knode_cosserat.envs import SingleEnv

    environment, refused = make(settings["task"]), ""
    try:
        with warnings.catch_warnings():
            # it warns that observations have no bounds
            warnings.simplefilter("ignore", UserWarning)
            check_env(SingleEnv(environment), skip_render_check=True)
    except Exception as error:
        refused = str(error) or type(error).__name__
    scores = controller_scores(environment, keys(settings["episodes"]))
    return Product({"score": float(scores.mean()), "scores": scores.tolist(), "refused": refused}, {})


def keys(count: int) -> np.ndarray:
    """Return the keys of the episodes on which everything is scored; no training has them."""
    return np.asarray(jax.random.split(jax.random.PRNGKey(2024), count))


def ppo(settings: Any) -> Product:
    """Train a policy on follow, and compare its score with that of the predictive controller."""
    environment = make("follow")
    reference = float(controller_scores(environment, keys(settings["episodes"])).mean())
    training = PolicyTraining(environment)
    held_out, until = keys(64), float("inf")

    def report(progress: Any) -> None:
        nonlocal until
        if not np.isfinite(until) and len(training.history) % 10 == 0:
            score = float(policy_scores(environment, training.policy, held_out).mean())
            until = progress.seconds if score >= ENOUGH * reference else until

    history = training.run(settings["seconds"], report)
    score = float(policy_scores(environment, training.policy, held_out).mean())
    curve = [list(history[k]) for k in np.unique(np.linspace(0, len(history) - 1, 200).astype(int))]
    facts = {
        "reference": reference,
        "score": score,
        "ratio": score / reference,
        "until": until if np.isfinite(until) else 1e9,
        "curve": curve,
    }
    gif = file_bytes(
        "episode.gif", lambda path: animate_episode(environment, training.policy, held_out[0], path)
    )
    return Product(facts, {"follow.npz": saved(training.policy), "follow.gif": gif})


def curve_figure(facts: Mapping[str, Any]) -> Any:
    """Return the figure of PPO's mean reward over time, with the score of predictive control."""
    with new_figure(width_of(1), 2.4) as figure:
        axes = figure.subplots()
        steps, seconds, reward = np.array(facts["curve"]).T
        axes.plot(seconds, reward, color=PALETTE[0], label="PPO while it explores")
        axes.plot(seconds[-1], facts["score"], "o", color=PALETTE[0], label="its policy, held-out episodes")
        axes.axhline(facts["reference"], color="0.3", ls="--", label="predictive control")
        axes.set(xlabel=f"time (s), {steps[-1]:,.0f} periods in all", ylabel="mean reward", ylim=(0.0, 1.05))
        axes.legend(loc="lower right")
    return figure


def saved(policy: Policy) -> bytes:
    """Return the file of a policy."""
    return file_bytes("policy.npz", policy.save)


def real(settings: Any) -> Product:
    """Train a policy for randomised robots, and report what it loses on the test robot."""
    randomisation = Randomisation(
        {"youngs_modulus": Factor(0.7, 1.3), "bending_damping": Factor(0.2, 2.0)}, delay=(0, 2), noise=5e-4
    )
    nominal = load_robot("delrin-tendon-robot")
    assert isinstance(nominal, TendonRod)
    # the tendons of the test robot are routed ones, not those of the model of the paper
    environment = make("follow", RoutedTendonRobot.like(nominal), randomisation=randomisation)
    rod = stand_in.true_rod(nominal)
    training = PolicyTraining(environment)
    training.run(settings["seconds"])
    chosen = keys(settings["episodes"])
    own = policy_scores(environment, training.policy, chosen)
    there = np.array([_on_stand_in(environment, training.policy, key, rod) for key in chosen])
    facts = {
        "score": float(own.mean()),
        "real": float(there.mean()),
        "gap": float(1.0 - there.mean() / own.mean()),
    }
    return Product(facts, {"follow-real.npz": saved(training.policy)})


def _on_stand_in(environment: Environment, policy: Policy, key: Any, rod: ElasticaRod) -> float:
    """Return the mean reward of a policy on PyElastica's robot, for the goal of a key."""
    state, _ = environment.reset(key)
    sensor = Sensor(BodyPositions(environment.spec.output.fractions, sigma=5e-4), noise=1.0)
    plant = ElasticaPlant(rod, environment.dt, sensor)
    controller = PolicyController(environment, policy, state)
    log = run_loop(controller, plant, environment.reference(state), environment.steps * environment.dt)
    rewards = [_reward(environment, state.goal, t, tip) for t, tip in zip(log.time, log.tip, strict=True)]
    return float(np.mean(rewards))


def _reward(environment: Environment, goal: Any, t: float, tip: Any) -> float:
    """Return the reward of a position of the tip (m) at a time (s), away from obstacles."""
    tangent = environment.arrays.survey.frame[2]
    length = nominal_model(environment.robot).length
    error = environment.task.error(goal, t, Tip(tip, tangent))
    return float(environment.task.reward(error, np.inf, length))


def sweep(settings: Any) -> Product:
    """Measure a sweep, five times killed and undisturbed."""
    with tempfile.TemporaryDirectory() as folder:
        return Product(measure_sweep(folder, settings["rollouts"]), {})
