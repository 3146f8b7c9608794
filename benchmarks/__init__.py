"""Benchmarks, each run as ``python -m benchmarks.<name>``: the workbench beside other tools at equal accuracy, never asserted in tests."""
