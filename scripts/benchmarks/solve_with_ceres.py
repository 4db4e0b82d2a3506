"""Solve a problem file with the Ceres program and print what it took, as JSON. Run in a process of its own.

This process imports next to nothing: the peak memory of a child that Linux reports counts, besides the
child's own, what its starter held when it started it.
"""

import argparse
import json
import os
import sys
import tempfile
import time

_FUNCTION_TOLERANCE = "1e-6"
"""The program's own default, which its next argument needs before it."""


def solve(program: str, peer: str, solver: str, threads: int, rig: str) -> tuple[dict[str, float], float]:
    """Run the program once: what it printed and `process_s`, and the most memory it took in megabytes."""
    with tempfile.TemporaryFile() as output:
        command = [program, peer, solver, str(threads), _FUNCTION_TOLERANCE, rig]
        out = [(os.POSIX_SPAWN_DUP2, output.fileno(), 1)]
        begin = time.perf_counter()
        child = os.posix_spawn(program, command, os.environ, file_actions=out)
        _, status, usage = os.wait4(child, 0)
        process_s = time.perf_counter() - begin
        output.seek(0)
        text = output.read().decode()
    if status != 0:
        sys.stderr.write(f"{program}: ended with status {os.waitstatus_to_exitcode(status)}\n")
        sys.exit(2)
    memory_mb = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
    return {**json.loads(text), "process_s": process_s}, memory_mb


def main() -> None:
    """Try each solver once, then repeat the fastest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program")
    parser.add_argument("peer")
    parser.add_argument("--solvers", nargs="+", required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--rig", choices=("held", "estimated"), required=True)
    parser.add_argument(
        "--repeats", type=int, required=True, help="solves with the fastest solver, first one included"
    )
    arguments = parser.parse_args()
    program = os.path.abspath(arguments.program)  # noqa: PTH100  pathlib would enlarge this process

    def run(solver: str) -> tuple[dict[str, float], float]:
        return solve(program, arguments.peer, solver, arguments.threads, arguments.rig)

    tried = {s: run(s) for s in arguments.solvers}
    best = min(tried, key=lambda s: tried[s][0]["seconds"])
    fastest, memory_mb = tried[best]
    again = [run(best)[0] for _ in range(arguments.repeats - 1)]
    others = ", ".join(f"{s} {r['seconds']:.3g} s" for s, (r, _) in tried.items() if s != best)
    measured = {
        "seconds": [fastest["seconds"], *(r["seconds"] for r in again)],
        "iterations": fastest["iterations"],
        "cost_final": fastest["final_cost"],
        "memory_mb": memory_mb,
        "process_s": min(r["process_s"] for r in (fastest, *again)),
        "detail": f"{best} Schur, {arguments.threads} threads" + (f"; {others}" if others else ""),
    }
    sys.stdout.write(json.dumps(measured) + "\n")


if __name__ == "__main__":
    main()
