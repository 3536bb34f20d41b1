"""The engine's code of one robot for other programs: machine code of any computer, and its data.

The functions are those of `Core.run` and `TangentCore.run`, on the grid of the robot alone. A third one makes
a motion at rest from a solved equilibrium.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from knode_cosserat.engine.codegen import LANES, literal
from knode_cosserat.engine.core import Core
from knode_cosserat.engine.counts import counts_of
from knode_cosserat.engine.generation import emit, machine_of
from knode_cosserat.engine.machine_code import level_of_code
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.engine.tangents import TangentCore
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Settings


class TargetError(KnodeCosseratError, ValueError):
    """A computer for which no code can be made."""

    code = "target"


@dataclasses.dataclass(frozen=True)
class Target:
    """A computer for which code is made."""

    triple: str
    cpu: str
    #: numbers of a vector; zero: those of this computer
    lanes: int = 0
    #: true if a product and a sum are rounded together, in one instruction
    fuses: bool = True


#: code that a linker puts at any address
LINKED = {"reloc": "pic", "codemodel": "small"}
#: computers by their names
TARGETS = {
    "native": Target("", ""),
    "x86-64": Target("x86_64-unknown-linux-gnu", "x86-64", 2, fuses=False),
    "x86-64-v3": Target("x86_64-unknown-linux-gnu", "x86-64-v3", 4),
    "x86-64-v4": Target("x86_64-unknown-linux-gnu", "x86-64-v4", 8),
    "aarch64": Target("aarch64-unknown-linux-gnu", "generic", 2),
}


class NativeCore(Core):
    """The time loop of one robot, and a function that begins a motion in a solved equilibrium."""

    def _write(self) -> None:
        super()._write()
        self._write_settle()

    def _write_settle(self) -> None:
        """The state of a motion at rest, from the equilibrium that was solved last in the same memory."""
        f = self._now = self.module.function("settle", ["memory", "motion"], exported=True)
        newest, *earlier = self.records
        for record in earlier:
            self._write_each(record, "count", lambda x: x, newest)
        for array in (self.rate, *self.errors, self.error_rate, *self.time_errors):
            self._write_each(array, array.where, lambda: 0.0)
        for y in self.past:
            self._write_each(y, "ends", lambda x: x, self.y)
        for k in range(3):
            self._put(float(k == 0), self.weights, k)
        self._put(0.0, self.t0, 0)
        for inside, outside in self._each_packed_vector([*itertools.chain(*self.motion)], f.arguments[1]):
            f.store(f.load(inside, 0, self.L), outside, 0)

    def _compiled(self) -> str:
        return self.module.text


class NativeTangents(TangentCore):
    """The tangents of solved steps by their controls."""

    def _compiled(self) -> str:
        return self.module.text


@dataclasses.dataclass
class NativeCode:
    """Code of one robot for a target, and where its numbers are in memory."""

    target: Target
    core: NativeCore
    tangents: NativeTangents
    #: prefix of all symbols
    name: str

    @classmethod
    def of(cls, system: System, settings: Settings, target: str, name: str) -> NativeCode:
        """Write the code of a robot.

        Raises:
            EngineError: the engine does not cover the system or the settings.
            TargetError: an unknown target, or one that this installation of LLVM does not know.
        """
        if target not in TARGETS:
            raise TargetError(f"target is {target!r}; allowed is {', '.join(TARGETS)}")
        pattern, own = Pattern.of(system), TARGETS[target]
        token = LANES.set(own.lanes or None)
        try:
            core = NativeCore(pattern.system, settings, False)
            masks = [np.zeros(shape, bool) for shape, _ in pattern.zeros]
            tangents = NativeTangents(pattern.system, settings, masks)
            core.counts = tangents.counts = counts_of(pattern.system, settings.space)
        finally:
            LANES.reset(token)
        return cls(own, core, tangents, name)

    def object_file(self, tables: Mapping[str, np.ndarray]) -> bytes:
        """Return an object file with the functions and tables of numbers, double or int64."""
        texts = (
            self._renamed(self.core._functions, ("run", "settle"), ""),
            self._renamed(self.tangents._functions, ("run",), "_tangents"),
        )
        machine = self._machine(level_of_code())
        first, *others = map(llvm.parse_assembly, [*texts, _tables(self.name, tables)])
        for each in others:
            first.link_in(each)
        first.triple = machine.triple
        return emit(first, machine)

    def _renamed(self, text: str, names: Iterable[str], suffix: str) -> str:
        """Return code with functions under names of this robot, and all others inside of the object."""
        for line in (each for each in text.split("\n") if each.startswith("define void @")):
            own = line.split("@")[1].split("(")[0]
            is_used = own in names
            linkage, new = ("hidden", f"{self.name}_{own}{suffix}") if is_used else ("internal", own)
            text = text.replace(line, line.replace(f"define void @{own}(", f"define {linkage} void @{new}("))
        return text if self.target.fuses else text.replace("@llvm.fma.", "@llvm.fmuladd.")

    def _machine(self, level: int) -> Any:
        if not self.target.triple:
            return machine_of(level, **LINKED)
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        try:
            found = llvm.Target.from_triple(self.target.triple)
        except RuntimeError as error:
            raise TargetError(f"target: this LLVM has no {self.target.triple} ({error})") from None
        return found.create_target_machine(cpu=self.target.cpu, opt=level, **LINKED)


def _tables(prefix: str, tables: Mapping[str, np.ndarray]) -> str:
    """Return constants in LLVM's assembly language."""
    found = []
    for name, values in tables.items():
        whole = values.dtype.kind == "i"
        kind = "i64" if whole else "double"
        inside = ", ".join(f"{kind} {int(each) if whole else literal(each)}" for each in values.ravel())
        found.append(f"@{prefix}_{name} = hidden constant [{values.size} x {kind}] [{inside}], align 64")
    return "\n".join(found)
