"""Scene perception: what is in view, where, and what is in whose way."""

from thinkgrasp.perception.geometric import GeometricPerception

__all__ = ["GeometricPerception"]
