"""What scripts/benchmark.py runs: cases, engines, and the report that compares them.

Kept free of imports: the process that starts Ceres imports this package and must stay small.
"""
