"""A tendon robot on the flange of an arm: MuJoCo moves the arm, the package the robot, each feels the other.

Both are solved together in each step. The wrench on the flange is that of a sensor under the robot's motors:
its weight, its inertia, its vibration after the arm has stopped; the pull of its tendons is internal.
"""

import matplotlib.pyplot as plt
import numpy as np

import knode_cosserat as kc
from knode_cosserat.mujoco import RodOnSite

ARM = """<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <default><geom type="capsule" size="0.05" contype="0" conaffinity="0"/></default>
  <worldbody><body name="upper" pos="0 0 1">
    <joint name="shoulder" axis="0 1 0" armature="0.5"/> <geom fromto="0 0 0 0.5 0 0" mass="4"/>
    <body name="fore" pos="0.5 0 0">
      <joint name="elbow" axis="0 1 0" armature="0.3"/> <geom fromto="0 0 0 0.4 0 0" mass="2"/>
      <site name="flange" pos="0.4 0 0" quat="0 0 1 0"/>
    </body></body></worldbody>
  <actuator>
    <position joint="shoulder" kp="2000" kv="200"/> <position joint="elbow" kp="1000" kv="100"/>
  </actuator>
</mujoco>"""


def main(out: str = "on_an_arm.png", seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the wrench on the flange (rows, 6) and the tips of the robot (rows, 3), every 10 ms."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    robot = RodOnSite(kc.load_robot("delrin-routed-tendon-robot"), model, data, "flange", substeps=2)
    rows, shapes = [], []
    for k in range(round(seconds / robot.dt)):
        part = np.clip((data.time - 0.2) / 0.6, 0.0, 1.0)
        data.ctrl[:] = np.array([-1.4, 1.9]) * part * part * (3.0 - 2.0 * part)
        robot.step([8.0, 8.0, 0.0, 0.0] if data.time > 1.8 else np.zeros(4))
        rows.append(np.concatenate([[data.time], robot.wrench, robot.state.tip_position[0]]))
        if k % 15 == 14:
            joints = data.body("upper").xpos, data.body("fore").xpos, data.site("flange").xpos
            shapes.append((np.array(joints), np.array(robot.state.position[0])))
    found = np.array(rows)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.6), layout="constrained")
    for k, (arm, rod) in enumerate(shapes):
        shade = 0.15 + 0.85 * (k + 1) / len(shapes)
        left.plot(arm[:, 0], arm[:, 2], "o-", color="#888888", alpha=shade, linewidth=3)
        left.plot(rod[:, 0], rod[:, 2], color="#c04000", alpha=shade)
    left.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", title="every 0.15 s")
    right.plot(found[:, 0], found[:, [1, 3, 5]], label=["force x [N]", "force z [N]", "moment y [N m]"])
    right.set(xlabel="time [s]", title="wrench of the robot on the flange")
    right.legend()
    figure.savefig(out)
    return found[:, 1:7], found[:, 7:]


if __name__ == "__main__":
    main()
