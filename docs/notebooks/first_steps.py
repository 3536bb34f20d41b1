# %% [markdown]
# # First steps
#
# Simulate a tendon-driven continuum robot, plot it, and compare an imperfect model with it. Everything here runs in
# seconds. The first call of each kind also compiles; compiled programs are kept on disk.

# %% tags=["parameters"]
steps = 100

# %%
import knode_cosserat as kc

# %% [markdown]
# A robot is a file: from the catalog, or your own YAML. Its parameters have units and ranges, and
# `robot.replace(name=value)` changes any of them.

# %%
robot = kc.load_robot("delrin-tendon-robot")
print("in the catalog:", ", ".join(kc.catalog()))
print(f"length {robot.length} m, modulus {robot.youngs_modulus:.3g} Pa, {robot.nodes} nodes")

# %% [markdown]
# Controls are an array, here four tensions in N for every step. Row 0 of the result is the robot at rest, row i is
# the state after control i.

# %%
tensions = kc.controls.sine(period=1.5, steps=steps, dt=0.05)
truth = kc.simulate(robot, tensions, dt=0.05)
print("positions", truth.position.shape, "m; all steps solved:", truth.all_valid)

# %%
kc.figures.overview(truth)

# %% [markdown]
# Every step has a result (`truth.result`) and a residual (`truth.residual`, in natural units).

# %%
print(
    "largest residual", f"{truth.residual.max():.0e}", "after at most", truth.iterations.max(), "corrections"
)

# %% [markdown]
# ## An imperfect model
#
# The same robot with almost twice the stiffness. Tip DTW and pose MSE measure its error, and the
# figure shows it over time.

# %%
stiff = kc.simulate(robot.replace(youngs_modulus=5e9), tensions, dt=0.05)
print(
    f"tip DTW {kc.metrics.tip_dtw(stiff, truth):.2f} m, pose MSE {kc.metrics.pose_mse(stiff, truth):.2f}e-3"
)
kc.figures.compare(truth, {"too stiff": stiff})

# %% [markdown]
# ## Equilibria and files
#
# `equilibrium` finds a static shape. Trajectories are labelled netCDF files, which any tool can read.
# `kc.figures.animate(truth, "truth.gif")` writes an animation.

# %%
rest = kc.equilibrium(robot, [7.0, 5.0, 5.0, 7.0])
print("tip at rest:", rest.tip_position[0].round(4), "m")
truth.save("truth.nc")
print("the same after loading:", bool((kc.load_trajectory("truth.nc").position == truth.position).all()))

# %% [markdown]
# Next: [learn what a model misses](learn_what_is_missed.ipynb), or go
# [from a recording to control](recording_to_control.ipynb).
