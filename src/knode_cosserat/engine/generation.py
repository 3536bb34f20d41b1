"""LLVM's code generator: quick code, and final code, which this file generates as a program of its own.

The package is not imported here, so that the program starts at once.
"""

import hashlib
import os
import secrets
import sys

import llvmlite.binding as llvm

#: levels of the code generator: the final code takes three times as long to generate, and half as long to run
QUICK, FINAL = 0, 1


def machine_of(level: int, **options: str) -> llvm.TargetMachine:
    """Return this computer as a target of the code generator, with its options."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=cpu, features=features, opt=level, **options)


def generate(text: str, level: int) -> bytes:
    """Return a module in LLVM's assembly language as machine code of this computer."""
    return emit(llvm.parse_assembly(text), machine_of(level))


def emit(module: llvm.ModuleRef, machine: llvm.TargetMachine) -> bytes:
    """Return a module as machine code.

    Programs come without repetition, and loops are written with their vectors: LLVM's general passes take
    three times as long and make steps no faster. Variables are turned into registers.
    """
    passes = llvm.create_new_module_pass_manager()
    passes.add_sroa_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def main(target: str, quick: str) -> None:
    """Write the final code of a module, read from standard input, to a file of `ProgramCache`.

    The file of the quick code is removed.
    """
    if hasattr(os, "nice"):
        os.nice(5)
    code = generate(sys.stdin.read(), FINAL)
    folder, name = os.path.split(target)
    # as `_files.writing` names them, and removes what killed processes left
    temporary = os.path.join(folder, f".{name}.{secrets.token_hex(6)}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(code + hashlib.sha256(code).digest())
        os.replace(temporary, target)
    finally:
        for path in (temporary, quick):
            if os.path.exists(path):
                os.unlink(path)


if __name__ == "__main__":
    main(*sys.argv[1:])
