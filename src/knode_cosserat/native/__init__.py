"""Models outside of Python: C code around machine code of the engine, for controllers and simulators."""

from knode_cosserat.native.export import Exported, ExportError, export

__all__ = ["ExportError", "Exported", "export"]
