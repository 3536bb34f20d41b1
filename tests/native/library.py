"""An exported model as a shared library, called from Python."""

import ctypes
import shutil
import subprocess

import numpy as np

import knode_cosserat as kc

#: warnings that exported code has none of
STRICT = ["-std=c11", "-Wall", "-Wextra", "-pedantic", "-Werror"]


class Library:
    """Functions of an exported model; results are codes, or arrays with them."""

    def __init__(self, model, folder, dt, name="arm", compiler="cc", **options):
        self.exported = kc.export(model, folder, dt, name=name, **options)
        self.name, self.dt, self.controls = name, dt, model.control_layout.size
        path = folder / f"{name}.so"
        command = [compiler, *STRICT, "-O2", "-shared", "-fPIC", f"{name}.c", f"{name}.o", "-lm", "-o", path]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        self._library = ctypes.CDLL(str(path))
        self.robot = self.empty("robot")

    def function(self, name):
        """Return a function of the library."""
        return getattr(self._library, f"{self.name}_{name}")

    def empty(self, kind):
        """Return memory for a structure, aligned to 64 bytes."""
        size = self.function(f"{kind}_size")
        size.restype = ctypes.c_size_t
        raw = np.zeros(size() + 64, np.uint8)
        return raw[-raw.ctypes.data % 64 :][: size()]

    def call(self, name, *arguments):
        """Call a function of the robot: arrays by their address, numbers as they are."""
        kinds = {int: ctypes.c_int, float: ctypes.c_double}
        given = [
            ctypes.c_void_p(each.ctypes.data if isinstance(each, np.ndarray) else None)
            if type(each) not in kinds
            else kinds[type(each)](each)
            for each in (self.robot, *arguments)
        ]
        return self.function(name)(*given)

    def start(self):
        self.call("start")

    def step(self, control, dt=None):
        return self.call("step", np.array(control, float), float(self.dt if dt is None else dt))

    def equilibrium(self, control):
        return self.call("equilibrium", np.array(control, float))

    def tip(self):
        found = np.full(3, np.nan)
        assert self.call("tip", found) >= 0
        return found

    def pose(self, rod, node):
        p, h = np.full(3, np.nan), np.full(4, np.nan)
        return self.call("pose", rod, node, p, h), p, h

    def pose_at(self, rod, place):
        p, h = np.full(3, np.nan), np.full(4, np.nan)
        return self.call("pose_at", rod, float(place), p, h), p, h

    def predict(self, steps, controls):
        """Return the result, the tips and the tangents of a prediction."""
        count = max(steps, 1)
        tips, tangents = np.full((count, 3), np.nan), np.full((count, 3, self.controls), np.nan)
        memory = self.empty("prediction")
        return self.call("predict", memory, steps, np.array(controls, float), tips, tangents), tips, tangents

    def move(self, controls):
        """Return the tips after all steps under controls."""
        found = []
        for control in controls:
            assert self.step(control) >= 0
            found.append(self.tip())
        return np.array(found)


def has(*programs):
    return all(map(shutil.which, programs))
