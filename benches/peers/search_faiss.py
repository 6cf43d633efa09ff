"""Exact top-100 search with faiss on the CPU, for comparison with `cargo bench --bench search`.

    python3 -m venv /tmp/peers && /tmp/peers/bin/pip install faiss-cpu==1.15.1 numpy
    /tmp/peers/bin/python benches/peers/search_faiss.py [SIZE...]

Random unit vectors of length 256, one query at a time, median of all queries, on two threads.
"""

import os
import statistics
import sys
import time

import faiss
import numpy as np

DIM, NEAREST, QUERIES = 256, 100, 31


def unit(generator, count):
    vectors = generator.standard_normal((count, DIM), dtype=np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def median_ms(index, queries):
    index.search(queries[:1], NEAREST)
    times = []
    for query in queries:
        start = time.perf_counter()
        index.search(query[None], NEAREST)
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def main():
    faiss.omp_set_num_threads(min(2, os.cpu_count()))
    generator = np.random.default_rng(1)
    queries = unit(generator, QUERIES)
    for size in [int(size) for size in sys.argv[1:]] or [10_000, 100_000, 1_000_000]:
        vectors = unit(generator, size)
        flat = faiss.IndexFlatL2(DIM)
        flat.add(vectors)
        print(f"{size:>9}  FlatL2 {median_ms(flat, queries):8.3f} ms", end="  ", flush=True)
        truth = flat.search(queries, NEAREST)[1]
        del flat
        half = faiss.IndexScalarQuantizer(DIM, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_L2)
        half.add(vectors)
        found = half.search(queries, NEAREST)[1]
        recall = np.mean([len(set(a) & set(b)) / NEAREST for a, b in zip(truth, found)])
        print(f"SQfp16 {median_ms(half, queries):8.3f} ms (recall {recall:.4f})", flush=True)


if __name__ == "__main__":
    main()
