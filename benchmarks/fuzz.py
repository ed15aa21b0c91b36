"""Look for files that a reader does not take or refuse as it should; what is found is kept in `fuzz-findings/`."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from fuzzing import MEMORY, Readers, hostile, judged, memory, seeds


def main():
    """Try each kind `--count` times."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=10_000, help="inputs of each kind")
    options.add_argument("--kinds", nargs="*", default=None)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    good, findings = seeds(), 0
    with tempfile.TemporaryDirectory() as folder:
        readers = Readers(folder)
        for kind in given.kinds or good:
            began, told = time.perf_counter(), set()
            for i in range(given.count):
                content = hostile(kind, good[kind], random.Random(f"{kind} {given.seed} {i}"))
                wrong = judged(readers, kind, content)
                if wrong and wrong not in told:
                    told.add(wrong)
                    findings += 1
                    kept = Path("fuzz-findings")
                    kept.mkdir(exist_ok=True)
                    (kept / f"{kind}-{given.seed}-{i}").write_bytes(content)
                    print(f"{kind} {i}: {wrong}", flush=True)
            seconds = time.perf_counter() - began
            print(
                f"{kind}: {given.count} inputs, {len(told)} findings, {seconds:.0f} s, {memory():.0f} MiB", flush=True
            )
    sys.exit(1 if findings or memory() > MEMORY else 0)


if __name__ == "__main__":
    main()
