"""Models outside of Python: C code around machine code of the engine, for controllers and simulators."""

from knode_cosserat.native.export import export
from knode_cosserat.native.files import Exported, ExportError

__all__ = ["ExportError", "Exported", "export"]
