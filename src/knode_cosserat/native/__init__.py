"""Models outside of Python: C code around machine code of the engine, for controllers and other simulators."""

from knode_cosserat._lazy import make_lazy

make_lazy(
    __name__,
    {
        "Exported": "knode_cosserat.native.export",
        "ExportError": "knode_cosserat.native.export",
        "export": "knode_cosserat.native.export",
    },
)
