"""Robots: their classes and files, and the parts, parameters and layouts of one's own.

Parts are in modules: `chambers`, `ends`, `fluids`, `loads`, `magnets`, `routing`, `section`, `surroundings`,
`tendons`, `tubes`; the forms of a material's law are in `law`, and drawings of parts in `shapes`.
"""

from knode_cosserat.part_check import CheckLine, PartCheckError, PartReport, check
from knode_cosserat.rods import (
    chambers,
    ends,
    fluids,
    law,
    loads,
    magnets,
    routing,
    section,
    shapes,
    surroundings,
    tendons,
    tubes,
)
from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.assembly import Assembly, RigidBody
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.frame import SpinningFrame
from knode_cosserat.rods.insertion import Insertion
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parallel_robot import ParallelRobot
from knode_cosserat.rods.parameters import Doubt, ParameterError, parameter
from knode_cosserat.rods.parts import Effect, Wrench
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.robot_file import RobotFileError, robot_schema
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.section import Stretch
from knode_cosserat.rods.system import Discontinuities, Scales, System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRobot

__all__ = [
    "Assembly",
    "Camera",
    "CheckLine",
    "Discontinuities",
    "Doubt",
    "Drawing",
    "Effect",
    "Ends",
    "Insertion",
    "Layout",
    "Observed",
    "ParallelRobot",
    "ParameterError",
    "PartCheckError",
    "PartReport",
    "Relaxation",
    "RigidBody",
    "RobotFileError",
    "RoutedTendonRobot",
    "Scales",
    "SlenderRod",
    "SpinningFrame",
    "Stretch",
    "System",
    "TendonRobot",
    "Wrench",
    "chambers",
    "check",
    "ends",
    "fluids",
    "law",
    "loads",
    "magnets",
    "parameter",
    "robot_schema",
    "routing",
    "section",
    "shapes",
    "surroundings",
    "tendons",
    "tubes",
]
