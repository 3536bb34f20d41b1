# %% [markdown]
# # Learn what the physics misses
#
# The model of a robot always has errors. From a few seconds of motion `fit` learns them: not as a black box in place of
# the physics, but as readable corrections of its equations.

# %% tags=["parameters"]
steps = 100
rows = 30

# %%
import knode_cosserat as kc

DT = 0.05
robot = kc.load_robot("delrin-tendon-robot")  # stands for the real robot
nominal = robot.replace(length=0.4, youngs_modulus=10e9)  # what we believe: too short, and too stiff

# %% [markdown]
# Two short training motions. For a real robot these are [estimated from a recording](recording_to_control.ipynb).

# %%
data = [kc.simulate(robot, kc.controls.sine(period, rows, DT), DT) for period in (0.5, 1.0)]
model = kc.fit(nominal, data)

# %% [markdown]
# ## Learned terms
#
# Terms are in SI units. The length is corrected by a factor, and the stress by one term for each axis, as expected for a
# wrong modulus. `fit` does not know which parameters are wrong.

# %%
for finding in kc.learning.explain(model):
    print(finding)
print(f"length: {0.4 * (1 + kc.learning.explain(model)[0].coefficient):.6f} m, and truly {robot.length} m")

# %% [markdown]
# ## Test on held-out controls
#
# These tensions were not used for learning, and are larger than the training tensions. A model is a system like any
# other: the same call simulates it.

# %%
unseen = kc.controls.random(steps, low=4.0, high=9.0, seed=1, hold=8)
truth, before, after = (kc.simulate(each, unseen, DT) for each in (robot, nominal, model))
for label, found in (("before", before), ("after", after)):
    rmse, mse = kc.metrics.tip_rmse(found, truth), kc.metrics.pose_mse(found, truth)
    print(f"{label:7} tip RMSE {rmse:.1e} m, pose MSE {mse:.1e}e-3")

# %%
kc.figures.compare(truth, {"before": before, "after": after})

# %%
kc.figures.error(truth, {"before": before, "after": after})

# %% [markdown]
# These data are simulated and noise-free, and the residual can represent the truth exactly; on a real robot an
# error remains. Results for 33 other imperfections: [How it learns](../learning.md).
#
# ## Save the model
#
# The file holds weights, the nominal model and the passport. Reading it runs no code.

# %%
model.save("model")
again = kc.simulate(kc.load_model("model"), unseen, DT)
print("the same after loading:", bool((again.position == after.position).all()))
