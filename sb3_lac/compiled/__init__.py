"""Updates as one compiled graph, behind one hook, ``compiled_update()``. Private names of PyTorch stay in here."""

from sb3_lac.compiled.update import CompiledUpdate, compiled_update

__all__ = ["CompiledUpdate", "compiled_update"]
