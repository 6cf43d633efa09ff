"""How long a run takes, for the peers that extraction and decoding are compared with."""

import statistics
import time


def measure(run, pixels, repetitions):
    """Milliseconds per image of `run(pixels)` after a first run that does not count: median, least, and the CPU time
    of all threads."""
    run(pixels)
    times, busy = [], time.process_time()
    for _ in range(repetitions):
        start = time.perf_counter()
        run(pixels)
        times.append((time.perf_counter() - start) * 1e3 / len(pixels))
    busy = (time.process_time() - busy) * 1e3 / len(pixels) / repetitions
    return {"median_ms": round(statistics.median(times), 2), "least_ms": round(min(times), 2), "cpu_ms": round(busy, 2)}
