"""Elastic rod: section and material along the rod, and the law of its strains.

`rod` adds loads, boundary conditions and contact. Symbols follow the paper's table of notations:

    p  position (m)            h  orientation, quaternion, scalar first     R  its rotation matrix
    n  internal force (N)      m  internal moment (N·m), both in the global frame
    q  velocity (m/s)          w  angular velocity ω (1/s), both in the material frame
    v  rate of p along s       u  curvature (1/m), both in the material frame
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import MaterialLaw, Viscoelastic
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import parameter, slot
from knode_cosserat.rods.section import (
    ALONG,
    CircularSection,
    Differences,
    Material,
    SectionChange,
    differences_at,
    shear_modulus,
)
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import dot, rotation_matrix


class ElasticRod(System):
    """A round rod with stiffness and damping, which may vary along it, and the paper's constitutive law."""

    y_layout: ClassVar[Layout] = Layout(
        ("p", 3, "m", "position, global frame"),
        ("h", 4, "1", "orientation, quaternion, scalar first"),
        ("n", 3, "N", "internal force, global frame", "h", "N/m"),
        ("m", 3, "N m", "internal moment, global frame", "h", "N"),
        ("q", 3, "m/s", "velocity, material frame"),
        ("w", 3, "rad/s", "angular velocity, material frame"),
    )
    z_layout: ClassVar[Layout] = Layout(
        ("v", 3, "1", "rate of position along the rod, material frame", "", "N"),
        ("u", 3, "1/m", "curvature, material frame", "", "N m"),
    )

    length: Any = parameter("m", "length of the rod", low=1e-3, high=20.0)
    radius: Any = parameter("m", "radius of the rod", low=1e-6, high=0.5)
    density: Any = parameter("kg/m3", "density of the rod, ribs spread over it included", low=1.0, high=100e3)
    youngs_modulus: Any = parameter("Pa", "Young's modulus", low=1e3, high=2e12)
    shear_modulus: Any = parameter(
        "Pa", "shear modulus; by default E / 2.6", low=1e2, high=1e12, default=None
    )
    shear_damping: Any = parameter(
        "N s", "Bse, damping of shear and extension", shape="matrix", low=0.0, high=1e6, default=0.0
    )
    bending_damping: Any = parameter(
        "N m2 s", "Bbt, damping of bending and twisting", shape="matrix", low=0.0, high=1e4, default=0.0
    )
    shear_stiffness: Any = parameter(
        "N", "Kse; by default diag(GA, GA, EA)", shape="matrix", low=1e-9, high=1e15, default=None
    )
    bending_stiffness: Any = parameter(
        "N m2", "Kbt; by default diag(EI, EI, 2GI)", shape="matrix", low=1e-15, high=1e9, default=None
    )
    sections: tuple[SectionChange, ...] = slot(
        "where the section differs", SectionChange, many=True, default=()
    )

    @abc.abstractmethod
    def section_controls(self, control: Any) -> list[Any]:
        """Return the control of each section."""

    # derived quantities

    @property
    def section(self) -> CircularSection:
        """The rod's cross-section outside `sections`."""
        return CircularSection(self.radius)

    @property
    def mass_per_length(self) -> Any:
        """ρA (kg/m)."""
        return self.density * self.section.area

    @property
    def G(self) -> Any:
        """Shear modulus (Pa): the parameter, or by default from Young's modulus."""
        return shear_modulus(self.youngs_modulus) if self.shear_modulus is None else self.shear_modulus

    @property
    def Kse(self) -> Float[Any, "3 3"]:
        """Stiffness of shear and extension (N): the parameter, or by default from moduli and section."""
        if self.shear_stiffness is not None:
            return self.shear_stiffness
        return self.section.shear_stiffness(self.youngs_modulus, self.G)

    @property
    def Kbt(self) -> Float[Any, "3 3"]:
        """Stiffness of bending and twisting (N·m²): the parameter, or by default from moduli and section."""
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        return self.section.bending_stiffness(self.youngs_modulus, self.G)

    @property
    def v_star(self) -> np.ndarray:
        """v of the unloaded rod: along z, unstretched."""
        return ALONG

    @property
    def u_star(self) -> np.ndarray:
        """u of the unloaded rod (1/m) outside `sections`: straight."""
        return np.zeros(3)

    def material(self, s: Any, control: Any) -> Material:
        """Return section and material at arclength s (m)."""
        plain = Material(
            self.Kse, self.shear_damping, self.Kbt, self.bending_damping, self.u_star,
            self.mass_per_length, self.density * self.section.inertia, self.radius,
        )  # fmt: skip
        if not self.sections:
            return plain
        found = self.differences(s, control)
        area = found.radius * found.radius
        return Material(
            plain.Kse * (area * found.stiffness), plain.Bse * area,
            plain.Kbt * (area * area * found.stiffness), plain.Bbt * (area * area), found.curvature,
            plain.rhoA * area, plain.rhoJ * (area * area), plain.radius * found.radius,
        )  # fmt: skip

    def differences(self, s: Any, control: Any) -> Differences:
        """Return the sections' changes at s (m)."""
        return differences_at(self.sections, s / self.length, self.section_controls(control))

    # the law of the strains

    def stresses(self, y: Float[Any, " y"]) -> tuple[Float[Any, "3"], Float[Any, "3"]]:
        """Return Rᵀn (N) and Rᵀm (N·m)."""
        R = rotation_matrix(self.y_layout.get(y, "h"))
        return dot(R.T, self.y_layout.get(y, "n")), dot(R.T, self.y_layout.get(y, "m"))

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the law of v and u; linear by default."""
        return self.linear_law(s, y, control)

    def linear_law(self, s: Any, y: Float[Any, " y"], control: Any) -> MaterialLaw:
        """Return the linear law of v and u (paper eq. 12, constitutive law of the rod).

        K (z - z*) + B z_t = Rᵀ (n, m), for each of shear and extension, bending and twisting.
        """
        material = self.material(s, control)
        n, m = self.stresses(y)
        bent = m if not self.sections else m + dot(material.Kbt, material.u_star)
        v = Viscoelastic(material.Kse, material.Bse, n + material.Kse @ self.v_star)
        return MaterialLaw({"v": v, "u": Viscoelastic(material.Kbt, material.Bbt, bent)})
