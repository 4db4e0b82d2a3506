"""Solve a traverse folder with this package and print time, memory and cost as JSON, in a new process."""

import argparse
import json
import time
from pathlib import Path

from benchmarks.memory import peak_memory_mb
from pancam_graph import SolveOptions, read_traverse, solve
from pancam_graph.cli import run


def main() -> int:
    """Read, solve once cold, then as often as asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("traverse", type=Path)
    parser.add_argument("--landmarks", required=True)
    parser.add_argument("--rig", required=True)
    parser.add_argument("--repeats", type=int, required=True, help="warm solves after the first one")
    arguments = parser.parse_args()
    begin = time.perf_counter()
    traverse = read_traverse(arguments.traverse)
    read_s = time.perf_counter() - begin
    options = SolveOptions(rig=arguments.rig, landmarks=arguments.landmarks, loss="none")
    begin = time.perf_counter()
    solution = solve(traverse, options)
    first_s = time.perf_counter() - begin
    memory_mb = peak_memory_mb()
    warm = [solve(traverse, options).seconds for _ in range(arguments.repeats)]
    measured = {
        "seconds": [s.solve for s in warm],
        "initialise_s": min((s.initialise for s in warm), default=None),
        "read_s": read_s,
        "first_s": first_s,
        "iterations": solution.iterations,
        "cost_final": solution.cost_final,
        "rms_px": solution.rms_final_px,
        "memory_mb": memory_mb,
        "detail": "" if solution.converged else f"not converged: {solution.stop_reason}",
    }
    print(json.dumps(measured))
    return 0


if __name__ == "__main__":
    run(main)
