"""Fit of a KNODE from trajectories and an imperfect nominal model."""

from __future__ import annotations

import dataclasses
import functools
import logging
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from knode_cosserat.learning.config import FitConfig, FitError, NetworkOptions
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.origins import origin_of
from knode_cosserat.learning.residual import Residual, network
from knode_cosserat.learning.structured.fit import residuals_of
from knode_cosserat.learning.training import rollouts
from knode_cosserat.learning.training.checkpoint import Checkpoints, Identity
from knode_cosserat.learning.training.descent import SegmentRun, standardised
from knode_cosserat.learning.training.runs import ProgressMonitor, Run, run_all
from knode_cosserat.rods.passport import Passport
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.segments import Dataset, samples, strand_samples
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

log = logging.getLogger(__name__)

#: the default training configuration
BEST = FitConfig()
#: part of the nominal model's error below which a gain is reported as little
LITTLE = 0.2
#: errors below this are those of the solver
SOLVED = 1e-8


def fit_states(
    knowledge: System,
    trajectories: Sequence[Trajectory],
    config: FitConfig = BEST,
    *,
    held_out: Sequence[Trajectory] = (),
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 100,
    log_dir: str | Path | None = None,
    progress: bool = False,
    verify: bool | None = None,
) -> Any:
    """Learn the model error of an imperfect nominal model from trajectories.

    Args:
        knowledge: the imperfect nominal model.
        trajectories: motions of the real robot, at the nodes of the nominal model; all have equal weight.
        config: settings of the fit.
        held_out: held-out trajectories from rest. The model's error on them is reported; with `stop_after`
            in the config it also decides when to stop.
        checkpoint: folder for checkpoints. The same call resumes from them, and the result is the same, bit
            for bit. Residuals that are solved in closed form, in milliseconds, are solved again.
        checkpoint_every: epochs (or updates) between two checkpoints.
        log_dir: folder for metrics as TensorBoard event files, with one subfolder for each seed.
        progress: show a progress bar with the loss and the time left.
        verify: simulate the first trajectory with the nominal model and with each fitted model, and warn if a
            model cannot be simulated or gained little. None: for systems that are not of this package, whose
            residuals nothing else has tried.

    Returns:
        A `KNODE`, or an `Ensemble` with one member for each seed if `config.seed` holds several. Its
        `passport` says what it learned from, the held-out errors, the range of controls and strains, versions
        and date. Its `about.facts` has "config", "seed" and "seconds". Each stage of gradient training,
        "segments" and "rollouts", has the "loss" before every step, the "learning_rate", and the
        "held_out_error" (step, m) at every check. The final "held_out_error" (m) is that of the model.
        "rollout_errors" are those of the nominal model and of the model, if they were verified
        (`rollout_errors`). An interruption of the training by Ctrl-C is a `KeyboardInterrupt`, whose `best`
        is the model so far; its facts have "interrupted".

    Raises:
        DataError: trajectories that do not fit the nominal model or each other, are too short or not finite.
        FitError: training cannot start or continue; the last good checkpoint is kept.
        CheckpointError: a checkpoint belongs to another fit, or is damaged.
        WatchError: metrics are requested and tensorboardX is not installed.
    """
    began = time.perf_counter()
    _check(knowledge, config, held_out, checkpoint_every)
    trajectories, held_out = _listed("trajectories", trajectories), _listed("held_out", held_out)
    dataset = _samples(knowledge, trajectories, config)
    initial = _initial(knowledge, trajectories, config, dataset)
    held_out_error = rollouts.held_out_error(knowledge, held_out)
    kept = None
    if checkpoint is not None:
        kept = Checkpoints(checkpoint, Identity.of(knowledge, trajectories, held_out, config))
    learned = {seed: KNODE(knowledge, it) for seed, it in zip(config.seeds, initial, strict=True)}
    histories: dict[int, dict[str, Any]] = {seed: {} for seed in config.seeds}
    interrupted: KeyboardInterrupt | None = None
    stages: list[Callable[[KNODE, int], Run]] = []
    if config.segments and dataset:
        stages.append(functools.partial(SegmentRun, config.segments, dataset, held_out_error))
    if config.rollouts:
        batches = rollouts.trajectory_batches(knowledge, trajectories, config.rollouts)
        stages.append(functools.partial(rollouts.RolloutRun, config.rollouts, batches, held_out_error))
    with ProgressMonitor(progress, log_dir) as watch:
        for stage in stages:
            runs = [stage(model, seed) for seed, model in learned.items()]
            try:
                run_all(runs, kept, checkpoint_every, watch)
            except KeyboardInterrupt as stop:
                interrupted = stop
            for run in runs:
                learned[run.seed] = KNODE(knowledge, run.residual())
                histories[run.seed][run.stage] = run.report()
            if interrupted:
                break
    origins = [origin_of(it, f"trajectory {k}") for k, it in enumerate(trajectories)]
    passport = Passport.of("fit", origins, knowledge, trajectories)
    if verify is None:
        verify = not type(nominal_model(knowledge)).__module__.startswith("knode_cosserat.")
    models = []
    for seed, model in learned.items():
        about: dict[str, Any] = {"config": config.to_dict(), "seed": seed, **histories[seed]}
        if interrupted:
            about["interrupted"] = True
        own = passport
        if held_out_error:
            about["held_out_error"] = held_out_error(model)
            unseen = [
                origin_of(it, f"held-out trajectory {k}", learned=False, held_out_error=error)
                for k, it in enumerate(held_out)
                for error in [
                    about["held_out_error"]
                    if len(held_out) == 1
                    else rollouts.held_out_error(knowledge, [it])(model)  # type: ignore[misc]
                ]
            ]
            own = dataclasses.replace(passport, origins=(*passport.origins, *unseen))
        if verify:
            about["rollout_errors"] = list(rollout_errors(knowledge, model, trajectories[0]))
        about["seconds"] = time.perf_counter() - began
        models.append(KNODE(knowledge, model.residual, About(about), own))
        log.info("learned from %d trajectories in %.2f s, seed %s", len(trajectories), about["seconds"], seed)
    found = Ensemble(models) if isinstance(config.seed, tuple) else models[0]
    if interrupted:
        interrupted.best = found  # type: ignore[attr-defined]
        raise interrupted
    return found


def _check(knowledge: Any, config: Any, held_out: Any, checkpoint_every: Any) -> None:
    if not isinstance(knowledge, System):
        raise FitError(f"knowledge is a {type(knowledge).__name__}; allowed is a robot or another System")
    if is_traced(knowledge) or np.ndim(knowledge.length):
        raise FitError("knowledge is a batch or inside jit, grad or vmap; allowed is one robot")
    if not isinstance(config, FitConfig):
        raise FitError(f"config is a {type(config).__name__}; allowed is a FitConfig")
    if isinstance(checkpoint_every, bool) or not isinstance(checkpoint_every, int) or checkpoint_every < 1:
        raise FitError(f"checkpoint_every is {checkpoint_every!r}; allowed is a whole number from 1")
    for name in ("segments", "rollouts"):
        stage = getattr(config, name)
        if stage is not None and stage.stop_after is not None and not held_out:
            raise FitError(f"{name}.stop_after is {stage.stop_after}, but there are no held_out trajectories")


def _listed(name: str, trajectories: Any) -> list[Trajectory]:
    if isinstance(trajectories, Trajectory) or not isinstance(trajectories, Iterable):
        raise FitError(f"{name} is a {type(trajectories).__name__}; allowed is a list of trajectories")
    return list(trajectories)


def _samples(knowledge: System, trajectories: Sequence[Trajectory], config: FitConfig) -> Dataset | None:
    """Return the samples of training, if it needs them."""
    options, training = config.residual, config.segments
    if training is None and not (
        isinstance(options, NetworkOptions) and (options.standardised or options.history)
    ):
        return None
    if training is not None and training.data_noise:
        trajectories = [_noisy(one, training.data_noise, k) for k, one in enumerate(trajectories)]
    nodes = None if training is None else training.nodes
    return strand_samples(knowledge, samples(knowledge, trajectories, nodes))


def _initial(
    knowledge: System, trajectories: Sequence[Trajectory], config: FitConfig, dataset: Any
) -> list[Residual]:
    """Return the residual of each seed before gradient training."""
    options, strand = config.residual, strand_of(knowledge)
    if isinstance(options, NetworkOptions):
        # of a row in the midst of a motion
        c0 = dataset.tips.c0[-1] if options.history else None
        networks = [network(strand, options, jax.random.key(seed), c0) for seed in config.seeds]
        return [standardised(net, strand, dataset) if options.standardised else net for net in networks]
    return list(residuals_of(knowledge, trajectories, options, config.seeds))


def _noisy(trajectory: Trajectory, size: float, number: int) -> Trajectory:
    """Return a trajectory with noise, the same for all seeds, which differ in initial weights."""
    if not isinstance(trajectory, Trajectory):
        return trajectory
    rng = np.random.default_rng(number)
    y, z = (
        np.asarray(part) + size * rng.normal(size=np.shape(part)) for part in (trajectory.y, trajectory.z)
    )
    return dataclasses.replace(trajectory, y=y, z=z)


# gain of a model over the nominal one


def rollout_errors(nominal: System, model: System, trajectory: Trajectory) -> tuple[float, float]:
    """Return the errors of both simulations of a trajectory; warn of failures and of a small gain.

    They are the root mean squares of y's errors in natural units, of simulations from the trajectory's first
    rows; infinite if a step of the simulation is not solved.
    """
    first = 1 if trajectory.time[0] == 0.0 else min(3, len(trajectory.time) - 1)
    settings = trajectory.settings or Settings()
    scale, errors = np.asarray(nominal.scales().y), []
    for system in (nominal, model):
        with warnings.catch_warnings():
            # the training data have the same grid
            warnings.simplefilter("ignore")
            motion = simulate(
                system,
                np.asarray(trajectory.control)[first:],
                trajectory.dt,
                time=settings.time or "bdf2",
                space=settings.space,
                start=settings.start,
                initial=trajectory[:first],
                on_failure="return",
            )
        apart = (np.asarray(motion.y)[1:] - np.asarray(trajectory.y)[first:]) / scale
        errors.append(float(np.sqrt(np.mean(apart**2))) if motion.all_valid else float("inf"))
    if np.isinf(errors[1]):
        warnings.warn(
            "the fitted model cannot be simulated over its first training trajectory: a step has no "
            "solution. Use another residual, more trajectories, or less noise",
            stacklevel=3,
        )
    elif errors[1] > (1.0 - LITTLE) * max(errors[0], SOLVED):
        warnings.warn(
            "the fit gained little: over its first training trajectory the model's error is "
            f"{100.0 * errors[1] / max(errors[0], SOLVED):.3g} % of the nominal model's. Its residual may "
            "not have the missing effect, or the error is in the length, the base or the tip, which it "
            "leaves alone",
            stacklevel=3,
        )
    return errors[0], errors[1]
