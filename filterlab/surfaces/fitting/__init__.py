"""From scanned points to a smooth surface: covers of them by balls with local quadrics.

points ──scans──▶ normals, ends, strays ──covering──▶ balls, graphs of second order, cuts ──▶ Slim
"""

from filterlab.surfaces.fitting.fit import check_settings, fit_slim

__all__ = ["check_settings", "fit_slim"]
