"""Export of a model as a functional mock-up unit (FMU): FMI 3.0 or 2.0, for co-simulation."""

from __future__ import annotations

import dataclasses
import functools
import platform
import re
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat._units import unit_of
from knode_cosserat.engine.native import TARGETS
from knode_cosserat.native.export import Exported, ExportError, _filled, export
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Errors, NewtonOptions
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.schemes.time import TimeScheme

#: versions of FMI, by their first digit
VERSIONS = {"2": "2.0", "3": "3.0"}
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


def export_fmu(
    model: System,
    path: str | Path,
    dt: float,
    *,
    fmi: str = "3.0",
    name: str | None = None,
    target: str = "native",
    time: str | TimeScheme = "sdirk2",
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    errors: Errors = True,
    horizon: int = 20,
) -> Exported:
    """Write a model as an FMU for co-simulation, for Linux; this needs a C compiler.

    The steps are those of `simulate` with the same arguments. Inputs are the controls, held in each step.
    Outputs are the tip's position and orientation, the nodes' positions, the base's force and moment, the
    estimated error of positions, and the result.

    Args:
        model: one robot, or a learned model.
        path: of the file, which ends in `.fmu`.
        dt: internal time step (s); communication steps are whole multiples of it.
        fmi: version of FMI, "3.0" or "2.0".
        name: the model's identifier; by default that of the file.
        target: the computer on which it runs, as in `export`; with another processor than this computer's, a
            cross compiler is needed.
        time: scheme in time, as in `simulate`.
        space: scheme along the rod.
        newton: options of Newton's method.
        errors: which errors are estimated.
        horizon: most internal steps of a communication step of which derivatives are known.

    Raises:
        ExportError: as in `export`; an unknown version of FMI; no C compiler, or another system than Linux.
        EngineError: the engine does not cover the model.
        SimulationError: the equilibrium in which it starts was not found.
        TargetError: an unknown target.
    """
    check_arguments(export_fmu, locals())
    path = Path(path)
    if path.suffix != ".fmu":
        raise ExportError(f"export: the file of an FMU ends in .fmu, not {path.name!r}")
    if fmi not in VERSIONS.values():
        versions = " and ".join(VERSIONS.values())
        raise ExportError(f"export: fmi is {fmi!r}; allowed are {versions}{_meant(fmi)}")
    processor = TARGETS[target].triple.partition("-")[0] if target in TARGETS else ""
    processor = processor or platform.machine()
    compiler = _compiler(processor)
    name = re.sub(r"\W", "_", path.stem) if name is None else name
    with tempfile.TemporaryDirectory() as folder:
        exported = export(
            model, folder, dt, name=name, target=target, time=time, space=space, newton=newton,
            errors=errors, horizon=horizon,
        )  # fmt: skip
        write_fmu(exported, path, Description(exported, model, fmi), compiler, processor)
    return dataclasses.replace(exported, folder=path.parent, files=(path.name,))


def write_fmu(
    exported: Exported, path: Path, description: Description, compiler: str, processor: str
) -> None:
    """Write an FMU of exported C code."""
    values = {**exported.values, **description.code()}
    source, library = description.source, f"{exported.name}.so"
    for template in ("fmu.c", source):
        (exported.folder / template).write_text(_filled(template, values))
    _compile(compiler, exported.folder, [source, f"{exported.name}.o", "-lm", "-o", library])
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description.text())
        archive.write(
            exported.folder / library, f"binaries/{_binaries(processor, description.fmi)}/{library}"
        )


def _meant(fmi: str) -> str:
    meant = VERSIONS.get(fmi.strip()[:1])
    return f". Did you mean {meant}?" if meant else ""


def _compiler(processor: str) -> str:
    """Return the path of a C compiler for a processor."""
    if platform.system() != "Linux":
        raise ExportError(
            f"export: FMUs are made on Linux, not {platform.system()}; export C code, to a folder"
        )
    own = processor == platform.machine()
    names = COMPILERS if own else (f"{processor}-linux-gnu-gcc",)
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        wanted = " or ".join(names) if own else names[0]
        raise ExportError(
            f"export: an FMU needs a C compiler, and there is no {wanted}: install gcc, or export C code, "
            "to a folder"
        )
    return found


def _compile(compiler: str, folder: Path, arguments: Sequence[str]) -> None:
    done = subprocess.run([compiler, *FLAGS, *arguments], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines()
        raise ExportError(f"export: {compiler} failed: {lines[0] if lines else done.returncode}")


def _binaries(processor: str, fmi: str) -> str:
    """Return the folder of a library in an FMU."""
    return "linux64" if fmi == "2.0" and processor == "x86_64" else f"{processor}-linux"


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
        ElementTree.SubElement(root, "CoSimulation", modelIdentifier=self.exported.name, **flags)
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
                ElementTree.SubElement(parent, "Unit", name=name), "BaseUnit", **exponents, **factor
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
                ElementTree.SubElement(parent, "Unknown", index=output, **own)


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
