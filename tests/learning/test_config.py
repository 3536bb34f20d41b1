"""Settings of a fit: what is allowed, and to JSON and back."""

import dataclasses
import json

import pytest

from knode_cosserat.learning.config import (
    ConfigError,
    FitConfig,
    NetworkOptions,
    RolloutTraining,
    StructuredOptions,
    Training,
)

CONFIGS = [
    FitConfig(),
    FitConfig.paper(seed=3, history=True),
    FitConfig.paper(seed=(0, 1, 2)),
    FitConfig.network(hidden=7),
    FitConfig(
        StructuredOptions(), Training(nodes=(1, 2), stop_after=10), RolloutTraining(compared=("p",)), (4,)
    ),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_to_json_and_back(config):
    assert FitConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert hash(FitConfig.from_dict(config.to_dict())) == hash(config)


def test_presets():
    """The paper's training, number by number."""
    paper = FitConfig.paper()
    assert paper.residual == NetworkOptions(hidden=512, history=False, convex=True, standardised=False)
    training = paper.segments
    assert (training.epochs, training.learning_rate, training.nodes) == (1000, 0.01, (3, 5, 7, 9))
    assert (training.schedule, training.patience, training.factor) == ("plateau", 80, 0.5)
    assert (training.loss, training.data_noise, training.weight_decay) == ("paper", 0.0, 0.0)
    assert paper.rollouts is None and paper.seeds == (0,)
    assert FitConfig.paper(seed=(1, 2)).seeds == (1, 2)
    assert FitConfig() == FitConfig(StructuredOptions())
    assert len(set(CONFIGS)) == len(CONFIGS)


def test_the_papers_training_on_recordings():
    """As its section on the real robot has it, but quaternions keep their lengths."""
    same, own = FitConfig.paper(2, history=True), FitConfig.paper_recordings(2)
    assert (own.segments.weight_decay, own.segments.data_noise) == (0.1, 0.01)
    assert own.residual == dataclasses.replace(same.residual, unit_quaternions=True)
    assert own.residual.history and own.seed == 2
    own = dataclasses.replace(own, residual=same.residual)
    changed = dataclasses.replace(own.segments, weight_decay=0.0, data_noise=0.0)
    assert dataclasses.replace(own, segments=changed) == same


def test_values_take_one_form():
    assert Training(nodes=[3, 5]).nodes == (3, 5)
    assert isinstance(Training(learning_rate=1).learning_rate, float)
    assert FitConfig.paper(seed=[1, 2]).seed == (1, 2)


WRONG = [
    (lambda: Training(epochs=0), "Training.epochs is 0; allowed is a whole number from 1 to 10000000"),
    (lambda: Training(epochs=10.5), "Training.epochs is 10.5"),
    (lambda: Training(epochs=True), "Training.epochs is True"),
    (
        lambda: Training(learning_rate=0.0),
        "Training.learning_rate is 0.0; allowed is a number above 0 up to 10",
    ),
    (lambda: Training(learning_rate=float("nan")), "Training.learning_rate is nan"),
    (lambda: Training(learning_rate="fast"), "Training.learning_rate is 'fast'"),
    (lambda: Training(schedule="step"), "is 'step'; allowed is plateau or cosine or constant"),
    (lambda: Training(nodes=()), r"Training.nodes is \(\); allowed is different node numbers"),
    (lambda: Training(nodes=(3, 3)), "Training.nodes is"),
    (lambda: Training(nodes=(0,)), "Training.nodes is"),
    (lambda: Training(nodes=5), "or None: all"),
    (lambda: Training(data_noise=-1.0), "Training.data_noise is -1.0"),
    (lambda: Training(stop_after=0), "or None: never"),
    (lambda: RolloutTraining(compared="p"), "RolloutTraining.compared is 'p'"),
    (lambda: RolloutTraining(clip=0), "RolloutTraining.clip is 0"),
    (lambda: NetworkOptions(hidden=-3), "NetworkOptions.hidden is -3"),
    (lambda: NetworkOptions(convex=1), "NetworkOptions.convex is 1; allowed is true or false"),
    (lambda: FitConfig(seed=-1), "FitConfig.seed is -1; allowed is a whole number from 0 to 4294967295"),
    (lambda: FitConfig(seed=()), "FitConfig.seed is"),
    (lambda: FitConfig(seed=(1, 1)), "FitConfig.seed is"),
    (lambda: FitConfig(seed=([1],)), "FitConfig.seed is"),
    (lambda: FitConfig(seed="0"), "FitConfig.seed is '0'"),
    (
        lambda: FitConfig(residual=None),
        "FitConfig.residual is None; allowed is StructuredOptions or NetworkOptions",
    ),
    (lambda: FitConfig(segments=100), "FitConfig.segments is 100; allowed is a Training"),
    (lambda: FitConfig(NetworkOptions()), "has a network residual but no segments or rollouts"),
    (lambda: FitConfig.from_dict({"sed": 1}), "the key 'sed' is unknown; allowed is .* did you mean seed"),
    (lambda: FitConfig.from_dict([1]), r"FitConfig is \[1\]; allowed is a mapping"),
    (
        lambda: FitConfig.from_dict({"residual": {"kind": "tree"}}),
        "residual: the kind is 'tree'; allowed is structured, network",
    ),
    (lambda: FitConfig.from_dict({"residual": {"hidden": 3}}), "the kind is None"),
    (
        lambda: FitConfig.from_dict({"segments": {"epoch": 3}}),
        "segments: the key 'epoch' is unknown.*mean epochs",
    ),
    (lambda: FitConfig.from_dict({"segments": 3}), "FitConfig.segments is 3"),
    (lambda: FitConfig.from_dict({3: 4}), "the key 3 is unknown"),
]


@pytest.mark.parametrize(("make", "message"), WRONG)
def test_what_is_not_allowed(make, message):
    with pytest.raises(ConfigError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
