"""Export of a model as a functional mock-up unit (FMU): FMI 3.0 or 2.0, for co-simulation."""

from __future__ import annotations

import dataclasses
import functools
import platform
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from knode_cosserat._files.writing import replacing
from knode_cosserat._units import unit_of
from knode_cosserat.engine.native import TARGETS
from knode_cosserat.native.files import Exported, ExportError, filled
from knode_cosserat.rods.system import System

#: versions of FMI
VERSIONS = ("2.0", "3.0")
COMPILERS = ("cc", "gcc", "clang")
#: no rounding of sums and products together: numbers are those of `simulate`
FLAGS = (
    "-std=gnu11",
    "-O2",
    "-ffp-contract=off",
    "-fPIC",
    "-shared",
    "-fvisibility=hidden",
    "-Wl,-Bsymbolic",
    "-s",
)


class Variable(NamedTuple):
    """A variable of an FMU; `places` are rod, node and number in y of each of its numbers."""

    name: str
    causality: str
    description: str
    unit: str = ""
    shape: tuple[int, ...] = ()
    places: tuple[tuple[int, int, int], ...] = ()
    kind: str = "Real"
    variability: str = "continuous"
    start: str = ""
    low: float = -np.inf
    high: float = np.inf

    @property
    def size(self) -> int:
        """Count of its numbers."""
        return int(np.prod(self.shape))

    @property
    def is_calculated(self) -> bool:
        """True if it is an output."""
        return self.causality == "output"


@dataclasses.dataclass(frozen=True)
class Packer:
    """Path of an FMU, its version of FMI, and the compiler for its processor."""

    path: Path
    fmi: str
    processor: str
    compiler: str

    @classmethod
    def of(cls, path: Path, fmi: str, target: str) -> Packer:
        """Find a compiler.

        Raises:
            ExportError: an unknown version of FMI; no C compiler, or another system than Linux.
        """
        if fmi not in VERSIONS:
            meant = next((f". Did you mean {each}?" for each in VERSIONS if each[0] == fmi.strip()[:1]), "")
            raise ExportError(f"export: fmi is {fmi!r}; allowed are {' and '.join(VERSIONS)}{meant}")
        own = platform.machine()
        if platform.system() != "Linux":
            raise ExportError(
                f"export: FMUs are made on Linux, not {platform.system()}; export C code, to a folder"
            )
        processor = (TARGETS[target].triple.partition("-")[0] if target in TARGETS else "") or own
        names = COMPILERS if processor == own else (f"{processor}-linux-gnu-gcc",)
        compiler = next(filter(None, map(shutil.which, names)), None)
        if compiler is None:
            wanted = " or ".join(names)
            raise ExportError(
                f"export: an FMU needs a C compiler, and there is no {wanted}: install gcc, or export C "
                "code, to a folder"
            )
        return cls(path, fmi, processor, compiler)

    def write(self, exported: Exported, model: System) -> Exported:
        """Write the FMU of exported C code, and return what is written."""
        description = Description(exported, model, self.fmi)
        values = {**exported.values, **description.code()}
        source, library = description.source, f"{exported.name}.so"
        for template in ("fmu.c", source):
            (exported.folder / template).write_text(filled(template, values), encoding="utf-8")
        self._compile(exported.folder, source, f"{exported.name}.o", "-lm", "-o", library)
        is_common = self.fmi == "2.0" and self.processor == "x86_64"
        binaries = "linux64" if is_common else f"{self.processor}-linux"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(self.path) as temporary,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            archive.writestr("modelDescription.xml", description.text())
            archive.write(exported.folder / library, f"binaries/{binaries}/{library}")
        return dataclasses.replace(exported, folder=self.path.parent, files=(self.path.name,))

    def _compile(self, folder: Path, *arguments: str) -> None:
        done = subprocess.run([self.compiler, *FLAGS, *arguments], cwd=folder, capture_output=True, text=True)
        if done.returncode:
            lines = done.stderr.splitlines()
            shown = next((line for line in lines if "error" in line), f"status {done.returncode}")
            raise ExportError(f"export: {self.compiler} failed: {shown}")


#: names of places in the values of an export
_PLACES = ("rods", "nodes", "tip_rod", "position", "orientation", "force", "moment")
#: variables that are no numbers of y, in the order of fmu.c
_OTHERS = (
    Variable(
        "position_error", "output", "estimated error of positions by the grid; -1: not known", "m",
        variability="discrete",
    ),
    Variable(
        "result", "output", "0: solved; 1: solved, but the grid is too coarse", kind="Integer",
        variability="discrete",
    ),
    Variable(
        "settled", "parameter", "start at rest, in equilibrium under the inputs, not without controls",
        kind="Boolean", variability="fixed", start="false",
    ),
    Variable("time", "independent", "time", "s"),
)  # fmt: skip


def _inputs(model: System) -> Iterator[Variable]:
    layout = model.control_layout
    fields = [field for field in layout.fields for _ in range(field.size)]
    for label, field in zip(layout.labels, fields, strict=True):
        start = repr(float(np.clip(0.0, field.low, field.high)))
        yield Variable(
            label,
            "input",
            field.meaning,
            field.unit,
            start=start,
            low=float(field.low),
            high=float(field.high),
        )


def _outputs(at: dict[str, int]) -> Iterator[Variable]:
    """Yield the outputs that are numbers of y."""
    tip, rods = (at["tip_rod"], at["nodes"] - 1), range(at["rods"])
    several = (at["rods"],) if at["rods"] > 1 else ()

    def number(name: str, rod: int, node: int, count: int = 3) -> list[tuple[int, int, int]]:
        return [(rod, node, at[name] + k) for k in range(count)]

    def output(
        name: str, meaning: str, unit: str, shape: tuple[int, ...], places: list[tuple[int, int, int]]
    ) -> Variable:
        return Variable(name, "output", meaning, unit, shape, tuple(places))

    yield output("tip_position", "position of the tip", "m", (3,), number("position", *tip))
    if at["orientation"] >= 0:
        turn = number("orientation", *tip, 4)
        yield output("tip_orientation", "orientation of the tip, a quaternion, scalar first", "", (4,), turn)
    nodes = [place for rod in rods for node in range(at["nodes"]) for place in number("position", rod, node)]
    shape = (*several, at["nodes"], 3)
    yield output("node_positions", "positions of nodes, from base to tip", "m", shape, nodes)
    for name, unit in (("force", "N"), ("moment", "N m")):
        if at[name] >= 0:
            meaning = f"internal {name} of the rod at its base, in the base's frame"
            bases = [place for rod in rods for place in number(name, rod, 0)]
            yield output(f"base_{name}", meaning, unit, (*several, 3), bases)


@dataclasses.dataclass(frozen=True)
class Description:
    """Description of a model for a version of FMI, and the numbers of its variables in the C code."""

    exported: Exported
    model: System
    fmi: str

    @functools.cached_property
    def variables(self) -> list[Variable]:
        """Variables in the order of their numbers."""
        places = {name: int(self.exported.values[name]) for name in _PLACES}
        return [*_inputs(self.model), *_outputs(places), *_OTHERS]

    @property
    def source(self) -> str:
        """File of the functions of FMI."""
        return f"fmi{self.fmi[0]}.c"

    @property
    def token(self) -> str:
        """Identity of model and description."""
        return f"{{{self.exported.values['digest']}-{self.fmi}}}"

    def code(self) -> dict[str, str]:
        """Return what the templates of the FMU are filled with."""
        inputs = [each for each in self.variables if each.causality == "input"]
        places = [place for each in self.variables for place in each.places]
        sizes = [
            size
            for each in self.variables
            for size in ([1] * each.size if self.fmi == "2.0" else [each.size] + [0] * (each.size - 1))
        ]
        return {
            "fmi": self.fmi, "source": self.source, "token": self.token, "places": str(len(places)),
            "sizes": ", ".join(map(str, sizes)),
            "place_table": ", ".join(f"{{{rod}, {node}, {number}}}" for rod, node, number in places),
            "input_names": " ".join(f'"{each.name}",' for each in inputs),
            "input_units": " ".join(f'"{each.unit}",' for each in inputs),
        }  # fmt: skip

    def text(self) -> bytes:
        """Return modelDescription.xml."""
        values, is_3 = self.exported.values, self.fmi == "3.0"
        root = ElementTree.Element(
            "fmiModelDescription", fmiVersion=self.fmi, modelName=self.exported.name,
            description=values["description"], generationTool=f"KNODE-Cosserat {values['version']}",
            generationDateAndTime=f"{values['date']}T00:00:00Z", variableNamingConvention="structured",
        )  # fmt: skip
        root.set("instantiationToken" if is_3 else "guid", self.token)
        states, derivatives = ("State", "Derivatives") if is_3 else ("state", "Derivative")
        flags = {
            "canHandleVariableCommunicationStepSize": "false", f"canGetAndSetFMU{states}": "true",
            f"canSerializeFMU{states}": "true", f"providesDirectional{derivatives}": "true",
        }  # fmt: skip
        if is_3:
            flags["fixedInternalStepSize"] = values["dt_exact"]
        else:
            flags["canNotUseMemoryManagementFunctions"] = "true"
        ElementTree.SubElement(root, "CoSimulation", flags, modelIdentifier=self.exported.name)
        self._add_units(root)
        categories = ElementTree.SubElement(root, "LogCategories")
        ElementTree.SubElement(categories, "Category", name="logStatusError", description="errors")
        ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=values["dt_exact"])
        (self._add_arrays if is_3 else self._add_scalars)(root)
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)

    def _add_units(self, root: ElementTree.Element) -> None:
        parent = ElementTree.SubElement(root, "UnitDefinitions")
        for name in sorted({each.unit for each in self.variables} - {""}):
            unit = unit_of(name)
            exponents = {
                base: str(power)
                for base, power in zip(("m", "kg", "s", "A", "rad"), unit.dimension, strict=True)
                if power
            }
            factor = {} if unit.factor == 1.0 else {"factor": repr(unit.factor)}
            ElementTree.SubElement(
                ElementTree.SubElement(parent, "Unit", name=name), "BaseUnit", exponents | factor
            )

    def _add_arrays(self, root: ElementTree.Element) -> None:
        """Add the variables and the structure of FMI 3.0."""
        types = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean"}
        variables = ElementTree.SubElement(root, "ModelVariables")
        structure = ElementTree.SubElement(root, "ModelStructure")
        reference, outputs = 0, []
        for each in self.variables:
            known = {"name": each.name, "valueReference": str(reference), **_common(each), **_numeric(each)}
            element = ElementTree.SubElement(variables, types[each.kind], known)
            for size in each.shape:
                ElementTree.SubElement(element, "Dimension", start=str(size))
            outputs += [str(reference)] * each.is_calculated
            reference += each.size
        for output in outputs:
            ElementTree.SubElement(structure, "Output", valueReference=output, dependencies="")
        for output in outputs:
            ElementTree.SubElement(structure, "InitialUnknown", valueReference=output)

    def _add_scalars(self, root: ElementTree.Element) -> None:
        """Add the variables and the structure of FMI 2.0: each number of an array is one."""
        root.set("numberOfEventIndicators", "0")
        variables = ElementTree.SubElement(root, "ModelVariables")
        structure = ElementTree.SubElement(root, "ModelStructure")
        reference, outputs = 0, []
        for each in self.variables:
            for index in np.ndindex(each.shape):
                place = f"[{','.join(str(k + 1) for k in index)}]" if index else ""
                known = {"name": each.name + place, "valueReference": str(reference), **_common(each)}
                element = ElementTree.SubElement(variables, "ScalarVariable", known)
                ElementTree.SubElement(element, each.kind, _numeric(each))
                reference += 1
                outputs += [str(reference)] * each.is_calculated
        for name in ("Outputs", "InitialUnknowns"):
            parent = ElementTree.SubElement(structure, name)
            own = {"dependencies": ""} if name == "Outputs" else {}
            for output in outputs:
                ElementTree.SubElement(parent, "Unknown", own, index=output)


def _common(variable: Variable) -> dict[str, str]:
    """Return attributes of a variable of any kind."""
    found = {
        "causality": variable.causality,
        "variability": variable.variability,
        "description": variable.description,
    }
    initial = {"output": "calculated", "parameter": "exact"}.get(variable.causality)
    return found | ({"initial": initial} if initial else {})


def _numeric(variable: Variable) -> dict[str, str]:
    """Return unit, start and limits of a variable."""
    found = {"unit": variable.unit, "start": variable.start}
    found |= {
        name: repr(limit)
        for name, limit in (("min", variable.low), ("max", variable.high))
        if np.isfinite(limit)
    }
    return {name: value for name, value in found.items() if value}
