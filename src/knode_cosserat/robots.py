"""Robots: their classes and files, and the parts, parameters and layouts of one's own."""

from knode_cosserat.rods import ends, loads, routing, surroundings
from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.law import Evolution, InternalState, MaterialLaw, MaxwellBranch, Viscoelastic
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parallel_robot import ParallelRobot
from knode_cosserat.rods.parameters import ParameterError, parameter
from knode_cosserat.rods.parts import Effect, RodPoint, Wrench
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.robot_file import RobotFileError, catalog, load_robot, robot_schema, save_robot
from knode_cosserat.rods.rod import Rod, SlenderRod
from knode_cosserat.rods.section import Differences, FunctionSection, Sleeve, Stretch
from knode_cosserat.rods.system import Scales, System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRobot
from knode_cosserat.rods.tendons import EarlyAnchors, LoadCells, Reels, RibSpacing, TendonFriction, Vibration

__all__ = [
    "Differences",
    "Drawing",
    "EarlyAnchors",
    "Effect",
    "Ends",
    "Evolution",
    "Field",
    "FunctionSection",
    "InternalState",
    "Layout",
    "LoadCells",
    "MaterialLaw",
    "MaxwellBranch",
    "Observed",
    "ParallelRobot",
    "ParameterError",
    "Reels",
    "Relaxation",
    "RibSpacing",
    "RobotFileError",
    "Rod",
    "RodPoint",
    "RoutedTendonRobot",
    "Scales",
    "Sleeve",
    "SlenderRod",
    "Stretch",
    "System",
    "TendonFriction",
    "TendonRobot",
    "Vibration",
    "Viscoelastic",
    "Wrench",
    "catalog",
    "ends",
    "load_robot",
    "loads",
    "parameter",
    "robot_schema",
    "routing",
    "save_robot",
    "surroundings",
]
