# %% [markdown]
# # Learn what the physics misses
#
# A model is never quite right. From a few seconds of motion `fit` learns what it misses: not a black box instead of
# the physics, but a correction within its equations, which can be read.

# %% tags=["parameters"]
steps = 100
rows = 30

# %%
import knode_cosserat as kc

DT = 0.05
robot = kc.load_robot("delrin-tendon-robot")  # stands for the real robot
knowledge = robot.replace(length=0.4, youngs_modulus=10e9)  # what we believe: too short, and too stiff

# %% [markdown]
# Two short motions to learn from. On a real robot these are [estimated from a recording](recording_to_control.ipynb).

# %%
data = [kc.simulate(robot, kc.controls.sine(period, rows, DT), DT) for period in (0.5, 1.0)]
model = kc.fit(knowledge, data)

# %% [markdown]
# ## What it learned
#
# Terms in SI units. The length is corrected by a factor, and the stress by one term for each axis, as is right for a
# wrong modulus. It was not told which parameters are wrong.

# %%
for finding in kc.explain(model):
    print(finding)
print(f"length: {0.4 * (1 + kc.explain(model)[0].coefficient):.6f} m, and truly {robot.length} m")

# %% [markdown]
# ## Does it hold elsewhere?
#
# On tensions that it has never seen, larger than those that it learned from. A model is a system like any other: it
# is simulated by the same call.

# %%
unseen = kc.controls.random(steps, low=4.0, high=9.0, seed=1, hold=8)
truth, before, after = (kc.simulate(each, unseen, DT) for each in (robot, knowledge, model))
for label, found in (("before", before), ("after", after)):
    print(
        f"{label:7} tip RMSE {kc.tip_rmse(found, truth):.1e} m, pose MSE {kc.pose_mse(found, truth):.1e}e-3"
    )

# %%
kc.figures.compare(truth, {"before": before, "after": after})

# %%
kc.figures.error(truth, {"before": before, "after": after})

# %% [markdown]
# These data are simulated and without noise, and the truth is within what the residual can say; on a real robot the
# error does not fall to nothing. How far learning goes in 33 other cases: [How it learns](../learning.md).
#
# ## Keep it
#
# The file holds weights, knowledge and where all came from. Reading it runs no code.

# %%
model.save("model")
again = kc.simulate(kc.load_model("model"), unseen, DT)
print("the same after loading:", bool((again.position == after.position).all()))
