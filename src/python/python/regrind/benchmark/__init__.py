"""Regrind beside other programs on the same points in one run: ``python -m regrind.benchmark``.

Every error is one from the exact least squares on a surface in closed form, which no contender knows. docs/benchmark.md of
the project says how the cases are made, how a contender is added, and how its settings are chosen.
"""
