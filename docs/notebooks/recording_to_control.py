# %% [markdown]
# # From a recording to a model, and to control
#
# No robot is at hand, so a **virtual** one is recorded: a simulation with things that the model is not told of
# (friction of the tendons, ribs, a stiffer base, motors with a lag, noisy sensors). Its bags have the paper's format
# and say that they are simulated. With a robot of your own, begin at *Read it*.

# %% tags=["parameters"]
seconds = 4.0
points = 24

# %%
import numpy as np

import knode_cosserat as kc
from knode_cosserat.recordings.virtual import record_virtual

truths = {signal: record_virtual(f"{signal[5:]}.bag", signal, seconds) for signal in ("sine:1.5", "sine:1.0")}

# %% [markdown]
# ## Read it
#
# Poses and tensions come at different rates, with noise and lost frames; `sampled` puts them on one grid in time.

# %%
config = kc.RecordingConfig.paper_robot()
recording = kc.load_recording("1.5.bag", config)
unseen = kc.load_recording("1.0.bag", config).sampled(0.025, mean=True)
print("bodies:", ", ".join(body.name for body in recording.bodies), "| simulated:", recording.simulated)

# %% [markdown]
# ## What was not measured
#
# Motion capture sees a few poses. Velocities, loads and curvature along the whole rod are estimated; here the tip's
# velocity beside what the virtual robot truly did.

# %%
crude = kc.load_robot("delrin-tendon-robot")
states = kc.estimate_states(recording, crude, dt=0.05)
kc.figures.states({"truth": truths["sine:1.5"], "estimated": states}, ("q", "w"))

# %% [markdown]
# ## A model from measured poses alone
#
# Tendons as they are bend the rod. Stiffness and damping are found through whole simulations, and the other recording
# shows what that is worth. (`kc.identify` finds friction as well, and takes longer.)

# %%
knowledge = kc.RoutedTendonRobot.like(crude)
measured = recording.sampled(0.025, mean=True)
found = kc.calibrate(knowledge, [measured], ["youngs_modulus", "bending_damping"], by="rollouts")
print(found)

# %% [markdown]
# The last line is honest: friction and ribs are missing, so that what is left is no noise, and the intervals are too
# narrow. The prediction is what counts:

# %%
before, after = (kc.simulate(each, unseen.held_tension[:-1], 0.025) for each in (knowledge, found.robot))
for label, each in (("before", before), ("after", after)):
    off = np.sqrt(np.mean(np.sum((each.tip_position - unseen.tip_position) ** 2, axis=1)))
    print(f"{label:7} tip RMSE {100 * off:.2f} cm on the unseen recording")
kc.figures.prediction_against_measurement(after, unseen)

# %% [markdown]
# ## Control: which tensions follow a path?
#
# Inverse kinematics with the model that was found, for x and y of the tip along a circle: each point from the last,
# and of all tensions that reach it the least.

# %%
turn = np.linspace(0.0, 2.0 * np.pi, points)
wanted = 0.15 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
reached = kc.inverse_kinematics(
    found.robot, wanted, low=3.0, high=10.0, pose=lambda robot, y: (robot.positions(y)[:2], None)
)
print(
    f"{np.sum(reached.converged)} of {points} reached; tensions {reached.control.min():.2f} to "
    f"{reached.control.max():.2f} N"
)

# %% [markdown]
# Does the robot go there if these tensions are simply held, one after the other? The dynamic model says how far it is
# behind:

# %%
moved = kc.simulate(found.robot, np.repeat(reached.control, 4, axis=0), 0.05)
kc.figures.path({"wanted": wanted, "the model in motion": np.asarray(moved.tip_position)[8:, :2]})
