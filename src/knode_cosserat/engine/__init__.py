"""Equations compiled to vector code: programs, code generator, time loop (see docs/engine.md)."""
