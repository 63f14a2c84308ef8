"""Autonomy: the plug-in that a student writes, the wiring and hosts that run it, and the reference modules."""

from .module import Input, Module, ModuleError, Output, Param

__all__ = ["Input", "Module", "ModuleError", "Output", "Param"]
