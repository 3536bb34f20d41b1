# %% [markdown]
# # From a recording to a model, and to closed-loop control
#
# A **virtual** robot is recorded: a simulation with effects that the model does not have
# (friction of the tendons, ribs, a stiffer base, motors with a lag, noisy sensors). Its bags have the paper's format
# and say that they are simulated. With your own robot, start at *Read the recording*.

# %% tags=["parameters"]
seconds = 4.0
points = 24

# %%
import numpy as np

import knode_cosserat as kc
from knode_cosserat.recordings.virtual import record_virtual

truths = {signal: record_virtual(f"{signal[5:]}.bag", signal, seconds) for signal in ("sine:1.5", "sine:1.0")}

# %% [markdown]
# ## Read the recording
#
# Poses and tensions have different rates, noise and lost frames; `sampled` resamples them on one time grid.

# %%
config = kc.recordings.RecordingConfig.paper_robot()
recording = kc.load_recording("1.5.bag", config)
unseen = kc.load_recording("1.0.bag", config).sampled(0.025, mean=True)
print("bodies:", ", ".join(body.name for body in recording.bodies), "| simulated:", recording.simulated)

# %% [markdown]
# ## Estimate the states
#
# Motion capture measures a few poses. Velocities, loads and curvature along the rod are estimated; here the tip's
# velocity beside the true velocity of the simulated robot.

# %%
crude = kc.load_robot("delrin-tendon-robot")
states = kc.estimate_states(recording, crude, dt=0.05)
kc.figures.states({"truth": truths["sine:1.5"], "estimated": states}, ("q", "w"))

# %% [markdown]
# ## A model from measured poses alone
#
# Realistic tendons bend the rod. Stiffness and damping are identified by whole simulations, and the other recording
# tests the result. (Without names of parameters, `kc.identify` finds friction as well, and takes longer.)

# %%
nominal = kc.robots.RoutedTendonRobot.like(crude)
measured = recording.sampled(0.025, mean=True)
found = kc.identify(nominal, [measured], parameters=["youngs_modulus", "bending_damping"])
print(found)

# %% [markdown]
# The line "not explained" is a warning: friction and ribs are missing, so the residual is not noise, and the intervals are too
# narrow. The test is the prediction of the held-out recording:

# %%
before, after = (kc.simulate(each, unseen.control[:-1], 0.025) for each in (nominal, found.robot))
for label, each in (("before", before), ("after", after)):
    off = np.sqrt(np.mean(np.sum((each.tip_position - unseen.tip_position) ** 2, axis=1)))
    print(f"{label:7} tip RMSE {100 * off:.2f} cm on the unseen recording")
kc.figures.prediction_against_measurement(after, unseen)

# %% [markdown]
# ## Control: which tensions follow a path?
#
# Inverse kinematics with the calibrated model, for x and y of the tip along a circle: each point starts from the last,
# with the smallest tensions that reach it.

# %%
turn = np.linspace(0.0, 2.0 * np.pi, points)
wanted = 0.15 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
reached = kc.inverse_kinematics(
    found.robot, wanted, low=3.0, high=10.0, pose=lambda robot, y: (robot.y_layout.get(y, "p")[:2], None)
)
print(
    f"{np.sum(reached.converged)} of {points} reached; tensions {reached.control.min():.2f} to "
    f"{reached.control.max():.2f} N"
)

# %% [markdown]
# Does the robot follow the path if these tensions are held one after the other? The dynamic model shows its lag
# behind the path:

# %%
moved = kc.simulate(found.robot, np.repeat(reached.control, 4, axis=0), 0.05)
kc.figures.path({"wanted": wanted, "the model in motion": np.asarray(moved.tip_position)[8:, :2]})

# %% [markdown]
# ## Closed loop
#
# Tensions from inverse kinematics are slow, and an error of the model stays. A predictive controller corrects both:
# it measures the tip, estimates the rod's state, and predicts one second ahead. The robot is a robot with other
# stiffness and damping than the model, as a robot is after a while; the controller adapts Young's modulus.

# %%
dt, tip = 0.05, kc.estimation.TipPosition()
aged = found.robot.replace(youngs_modulus=0.85 * float(found.robot.youngs_modulus))
observer = kc.estimation.KalmanObserver(found.robot, dt, tip, adapt=["youngs_modulus"])
controller = kc.control.PredictiveController(observer, tip, kc.control.ControlLimits(0.0, 12.0, 40.0))
plant = kc.control.SimulatedPlant(aged, dt, kc.control.Sensor(tip, noise=1.0))
log = kc.control.run_loop(controller, plant, kc.control.circle(0.1, period=3.0), 2.0 * seconds)
print(log)
kc.figures.closed_loop(log)
